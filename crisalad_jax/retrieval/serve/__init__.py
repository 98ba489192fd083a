"""Serve a map over HTTP and to browsers, to find the places that photographs show."""

from crisalad_jax.retrieval.serve.server import serve_map as serve_map
