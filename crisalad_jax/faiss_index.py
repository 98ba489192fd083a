"""Approximate search with faiss: the public API of `crisalad_jax.retrieval.faiss_index`."""

from crisalad_jax.retrieval.faiss_index import Index as Index
from crisalad_jax.retrieval.faiss_index import build as build
from crisalad_jax.retrieval.faiss_index import load_index as load_index
from crisalad_jax.retrieval.faiss_index import recall_against_exact as recall_against_exact
from crisalad_jax.retrieval.faiss_index import save_index as save_index
