"""A map as a web service: places that photographs show, asked over HTTP or in a browser."""

from crisalad_jax.retrieval.serve.server import serve_map as serve_map
