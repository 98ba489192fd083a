"""Sinkhorn in the log domain, with a dustbin (Cuturi 2013; Sarlin et al. 2020; SALAD, CVPR 2024).

The layout is as published, with clusters in rows and patches in columns: the transpose of
`crisalad_jax`.
"""

import math

import torch
from torch import Tensor

from crisalad_jax.sinkhorn import SinkhornConfig


def assign_with_dustbin(
    scores: Tensor, dust_bin: Tensor, *, epsilon: float, config: SinkhornConfig
) -> Tensor:
    """Assign patches to clusters as in SALAD, in logarithms (paper Eqs. 4 and 5).

    Each patch has mass 1, each cluster 1, the dustbin the rest. After few iterations the cluster
    masses are inexact, because the patches are scaled last.

    Args:
        scores: (batch, cluster, patch), with more patches than clusters.
        dust_bin: () score of the dustbin, the same for every patch.
        epsilon: regularisation, by which the scores are divided.
        config: the number of iterations.

    Returns:
        (batch, cluster + 1, patch), the dustbin last.
    """
    batch, clusters, patches = scores.shape
    dust = dust_bin.to(scores.dtype).expand(batch, 1, patches)
    kernel = torch.cat([scores, dust], dim=1) / epsilon
    log_mass = kernel.new_zeros(clusters + 1, 1)
    log_mass[-1] = math.log(patches - clusters)
    cluster_potential = kernel.new_zeros(batch, clusters + 1, 1)
    patch_potential = kernel.new_zeros(batch, 1, patches)
    for _ in range(config.iterations):
        cluster_potential = log_mass - (kernel + patch_potential).logsumexp(dim=2, keepdim=True)
        patch_potential = -(kernel + cluster_potential).logsumexp(dim=1, keepdim=True)
    return kernel + cluster_potential + patch_potential
