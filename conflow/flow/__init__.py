"""The method: source, path, correction, network, sampler. Imports torch alone; a constraint arrives as an argument."""
