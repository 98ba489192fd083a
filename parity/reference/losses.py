"""Multi-similarity loss with online mining (Wang et al., CVPR 2019), as used with GSV-Cities.

There is no `valid` here: padding images of a `crisalad_jax` batch are left out instead.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from parity.reference.layers import at_least_float32


class MinedPairs(NamedTuple):
    """The pairs (anchor, other) that enter the loss: two boolean arrays (anchor, image)."""

    positives: Tensor
    negatives: Tensor


class LossResult(NamedTuple):
    """The loss and the statistic logged with it, both ()."""

    loss: Tensor
    easy_anchor_fraction: Tensor
    """Share of the anchors without a mined positive."""


def mine(similarities: Tensor, labels: Tensor, *, margin: float) -> MinedPairs:
    """Select pairs that violate the order within their row by less than `margin`, strictly.

    Args:
        similarities: (anchor, image).
        labels: (image,) of integers.
        margin: the epsilon of the paper.
    """
    same = labels[:, None] == labels
    positives = same & ~torch.eye(len(labels), dtype=torch.bool, device=labels.device)
    negatives = ~same
    # An anchor without positives or without negatives is compared with infinity, and mines nothing.
    hardest_negative = similarities.masked_fill(~negatives, -torch.inf).amax(1, keepdim=True)
    hardest_positive = similarities.masked_fill(~positives, torch.inf).amin(1, keepdim=True)
    return MinedPairs(
        positives & (similarities - margin < hardest_negative),
        negatives & (similarities + margin > hardest_positive),
    )


def multi_similarity_loss(descriptors: Tensor, labels: Tensor, config: LossConfig) -> LossResult:
    """Compute the mean loss of mined pairs over all anchors; the miner passes no gradient.

    Args:
        descriptors: (image, descriptor), unit vectors.
        labels: (image,): the place of each image.
        config: constants of the loss.
    """
    wide = at_least_float32(descriptors)
    similarities = wide @ wide.T
    pairs = mine(similarities.detach(), labels, margin=config.miner_margin)
    constants = config.kind
    assert isinstance(constants, MultiSimilarityConfig)
    centred = similarities - constants.base
    per_anchor = (
        _log1p_sum_exp(-constants.alpha * centred, pairs.positives) / constants.alpha
        + _log1p_sum_exp(constants.beta * centred, pairs.negatives) / constants.beta
    )
    loss = per_anchor.mean()
    if config.pml_compat and max(pairs.positives.sum(), pairs.negatives.sum()) <= 1:
        loss = 0 * loss
    return LossResult(loss, 1 - pairs.positives.any(dim=1).to(loss.dtype).mean())


def _log1p_sum_exp(x: Tensor, where: Tensor) -> Tensor:
    """Compute log(1 + sum of exp(x) where selected), which is 0 if nothing is selected."""
    # A column of zeros is the 1 inside the logarithm.
    return F.pad(x.masked_fill(~where, -torch.inf), (0, 1)).logsumexp(dim=1)
