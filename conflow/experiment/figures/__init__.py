"""Pictures of demonstrations, of what a model makes, and of how guidance and solver act on it."""

from conflow.experiment.figures.workspace import COLLISION, ROBOTS, demonstrations, page, save, sources

__all__ = ["COLLISION", "ROBOTS", "demonstrations", "page", "save", "sources"]
