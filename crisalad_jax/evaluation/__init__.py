"""Evaluation of descriptors: recall and leakage under each grouping of images into batches."""
