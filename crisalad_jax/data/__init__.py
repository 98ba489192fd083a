"""Images and data sets; this package does not import JAX."""
