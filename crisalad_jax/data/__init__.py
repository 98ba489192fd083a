"""Pictures and data sets: numpy and OpenCV only, never jax."""
