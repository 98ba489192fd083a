"""Whole experiments: the demo and its city, comparisons of methods, reports."""
