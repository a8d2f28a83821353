"""What vehicle and water are: pure JAX."""
