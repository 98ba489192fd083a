"""SALAD: optimal-transport aggregation of patch features (Izquierdo and Civera, CVPR 2024)."""

import torch
from torch import Tensor, nn

from crisalad_jax.nn.aggregators.salad import SaladConfig
from parity.reference.layers import Conv2d, Linear, at_least_float32, l2_normalise
from parity.reference.sinkhorn import assign_with_dustbin
from parity.reference.tokens import Tokens
from parity.reference.vit import Features


class Salad(nn.Module):
    """The three networks over features, and the dustbin's score."""

    def __init__(self, dim: int, config: SaladConfig) -> None:
        """Make it for features of width `dim`, with torch's initialisation and dustbin score 1."""
        super().__init__()
        self.epsilon = config.epsilon
        self.sinkhorn = config.sinkhorn
        self.token_features = nn.Sequential(
            Linear(dim, config.hidden),
            nn.ReLU(),
            Linear(config.hidden, config.token_dim),
        )
        self.cluster_features = _pointwise_network(dim, config.cluster_dim, config)
        self.score = _pointwise_network(dim, config.clusters, config)
        self.dust_bin = nn.Parameter(torch.ones(()))

    def forward(self, features: Features) -> Tokens:
        """Compute L2-normalised global and cluster tokens (paper Eq. 6), in at least float32."""
        global_token = at_least_float32(self.token_features(features.class_token))
        local = at_least_float32(self.cluster_features(features.patches)).flatten(2)
        plan = self.transport(features.patches)[:, :-1].exp()
        clusters = torch.einsum("bkn,bdn->bkd", plan, local)
        return Tokens(l2_normalise(global_token), l2_normalise(clusters))

    def transport(self, patches: Tensor) -> Tensor:
        """Map (batch, dim, rows, columns) to the log plan (batch, cluster + 1, patch)."""
        scores = at_least_float32(self.score(patches)).flatten(2)
        return assign_with_dustbin(
            scores, self.dust_bin, epsilon=self.epsilon, config=self.sinkhorn
        )


def _pointwise_network(dim: int, d_out: int, config: SaladConfig) -> nn.Sequential:
    return nn.Sequential(
        Conv2d(dim, config.hidden, 1),
        nn.Dropout(config.dropout),
        nn.ReLU(),
        Conv2d(config.hidden, d_out, 1),
    )


def published_order(clusters: Tensor) -> Tensor:
    """Transpose (batch, cluster, dim) to (batch, dim, cluster), the public descriptor's order."""
    return clusters.mT
