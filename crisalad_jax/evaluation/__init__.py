"""Evaluation of descriptors: recall under each grouping of images into batches, and its leakage."""
