"""Numerical parity with the public torch implementations."""
