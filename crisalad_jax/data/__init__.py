"""Images and data sets, using only numpy and OpenCV: this package does not import jax."""
