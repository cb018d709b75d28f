"""The world: the robots' geometry, their demonstrations, and the constraints on them. Imports nothing else of ours."""
