"""Re-rank the best retrievals of any first stage by local features."""

from crisalad_jax.retrieval.reranking.stage import RERANKERS as RERANKERS
from crisalad_jax.retrieval.reranking.stage import Reranker as Reranker
from crisalad_jax.retrieval.reranking.stage import Reranking as Reranking
from crisalad_jax.retrieval.reranking.stage import parse_reranking as parse_reranking
