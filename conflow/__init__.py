"""ConFlow: flow matching for robot motion with the constraint inside the training."""

__version__ = "0.1.0"
