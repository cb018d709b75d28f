"""Lightning and MLflow around the method: config, data, training, metrics, tracking, pictures."""
