"""Whole experiments: the demo, comparisons of methods, reports."""
