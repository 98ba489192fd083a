"""Evaluation of descriptors: recalls under each grouping, and the leakage of a grouping."""
