"""Images and data sets, with numpy and OpenCV alone: this package does not import jax."""
