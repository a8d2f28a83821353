"""What training makes small: every objective of the paper and its baselines."""
