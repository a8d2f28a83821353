"""Training objectives of the paper and its baselines."""
