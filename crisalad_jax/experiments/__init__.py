"""End-to-end experiments: the demo, comparisons of methods, reports."""
