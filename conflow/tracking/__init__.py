"""A run's life in MLflow: store, liveness, signals, checkpoints, resumption. Knows nothing of training."""
