"""Entropic transport; `crisalad_jax.sinkhorn` is its public interface."""
