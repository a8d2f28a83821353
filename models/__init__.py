"""Models of vehicle, water and sensors: pure JAX."""
