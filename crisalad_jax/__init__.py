"""CriSALAD visual place recognition in pure JAX."""
