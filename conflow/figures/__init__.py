"""Pictures of demonstrations, of what a model makes, and of how guidance and solver act on it."""
