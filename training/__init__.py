"""Data windows, losses, fitting, evaluation: pure JAX."""
