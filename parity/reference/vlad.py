"""NetVLAD (Arandjelovic et al. 2016), AnyLoc's hard VLAD (Keetha et al. 2023), SuperVLAD (2024)."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from parity.reference.layers import at_least_float32, l2_normalise
from parity.reference.tokens import Tokens
from parity.reference.vit import Features


class NetVlad(nn.Module):
    """Separate assignment and centroids, with the names of Nanne/pytorch-NetVlad."""

    def __init__(self, dim: int, clusters: int) -> None:
        """Initialise randomly, like torch's layers."""
        super().__init__()
        self.conv = nn.Conv2d(dim, clusters, 1, bias=False)
        self.centroids = nn.Parameter(l2_normalise(torch.randn(clusters, dim)))

    def forward(self, features: Features) -> Tokens:
        """Compute V(k) = sum of a_k(x) (x - c_k) over the patches (Eq. 4), each of length 1."""
        patches = F.normalize(at_least_float32(features.patches), dim=1)
        shares = self.conv(patches).softmax(dim=1).flatten(2)
        return _tokens(features, _vlad(shares, patches.flatten(2), self.centroids))


class AnyLoc(nn.Module):
    """Assignment of every patch to its nearest word."""

    def __init__(self, dim: int, clusters: int) -> None:
        """Initialise random words."""
        super().__init__()
        self.words = nn.Parameter(l2_normalise(torch.randn(clusters, dim)))

    def forward(self, features: Features) -> Tokens:
        """Compute V(k) = sum of x - c_k over the patches nearest to word k, each of length 1."""
        patches = F.normalize(at_least_float32(features.patches), dim=1).flatten(2)
        nearest = torch.cdist(patches.mT, self.words.expand(len(patches), -1, -1)).argmin(dim=2)
        shares = F.one_hot(nearest, len(self.words)).mT.to(patches.dtype)
        return _tokens(features, _vlad(shares, patches, self.words))


class SuperVlad(nn.Module):
    """Sums of patches, not of residuals; ghost clusters take shares and are dropped."""

    def __init__(self, dim: int, clusters: int, ghosts: int) -> None:
        """Initialise randomly, like torch's layers."""
        super().__init__()
        self.clusters = clusters
        self.conv = nn.Conv2d(dim, clusters + ghosts, 1, bias=False)

    def forward(self, features: Features) -> Tokens:
        """Compute V(k) = sum of a_k(x) x over the patches, each of length 1, then all together."""
        patches = F.normalize(at_least_float32(features.patches), dim=1)
        shares = self.conv(patches).softmax(dim=1).flatten(2)[:, : self.clusters]
        sums = F.normalize(shares @ patches.flatten(2).mT, dim=2)
        return _tokens(features, F.normalize(sums.flatten(1), dim=1).view_as(sums))


def _vlad(shares: Tensor, patches: Tensor, centroids: Tensor) -> Tensor:
    """Sum residuals of patches (batch, dim, patch) by shares (batch, cluster, patch)."""
    residuals = patches[:, None] - centroids[None, :, :, None]
    return l2_normalise((shares[:, :, None] * residuals).sum(dim=3))


def _tokens(features: Features, clusters: Tensor) -> Tokens:
    return Tokens(at_least_float32(features.class_token)[:, :0], clusters)
