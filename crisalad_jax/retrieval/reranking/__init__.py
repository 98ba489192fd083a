"""A second stage over any first: its best retrievals in the order of what their patches show."""

from crisalad_jax.retrieval.reranking.stage import RERANKERS as RERANKERS
from crisalad_jax.retrieval.reranking.stage import Reranker as Reranker
from crisalad_jax.retrieval.reranking.stage import Reranking as Reranking
from crisalad_jax.retrieval.reranking.stage import parse_reranking as parse_reranking
