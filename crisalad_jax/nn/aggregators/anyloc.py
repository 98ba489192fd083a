"""AnyLoc: hard VLAD of features that are not trained for places (Keetha et al., RA-L 2023)."""

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from crisalad_jax.config.checks import require, require_positive
from crisalad_jax.nn import draw
from crisalad_jax.nn.aggregators.base import AGGREGATORS, Aggregator, TokenShape
from crisalad_jax.nn.aggregators.netvlad import residual_sums
from crisalad_jax.nn.backbones.base import Backbone, FeatureRequest, Features
from crisalad_jax.nn.layers import Keys, at_least_float32, l2_normalise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.pytree import named_leaves, pytree_dataclass, static_field


@pytree_dataclass
class AnyLoc:
    """The visual words, and the backbone that they belong to."""

    words: Float[Array, "cluster dim"]
    """k-means centroids of unit features."""
    backbone: str | None = static_field(default=None)
    """Digest of the words' backbone; None before a vocabulary is built."""


@AGGREGATORS.register("anyloc", tiny={"clusters": 16, "layer": -1})
@dataclasses.dataclass(frozen=True)
class AnyLocConfig(Aggregator):
    """AnyLoc: hard VLAD of a facet of one layer, nothing learnt (Keetha et al., RA-L 2023)."""

    learns: ClassVar[bool] = False
    clusters: int = 32
    """Number of words of the vocabulary, which `crisalad vocabulary` builds."""
    layer: int = -9
    """Block of the facet, from 0, or from the end where negative: -9 is block 31 of ViT-g's 40,
    AnyLoc's choice."""
    facet: Literal["query", "key", "value", "token"] = "value"
    """Facet of the block: queries, keys or values of its attention, or its output tokens."""
    assignment: Literal["cosine", "euclidean"] = "cosine"
    """What the nearest word of a patch is nearest by. The public code takes the angle; so does the
    k-means that builds a vocabulary."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "clusters")

    def block(self, depth: int) -> int:
        """Return the number of the facet's block among `depth` blocks, from 0.

        Raises:
            InputError: there is no such block.
        """
        require(
            -depth <= self.layer < depth,
            f"AnyLocConfig.layer: found {self.layer}, expected {-depth} to {depth - 1} for a "
            f"backbone of {depth} blocks",
        )
        return self.layer % depth

    def features(self, depth: int) -> FeatureRequest:
        """Request the facet, without the last layer norm."""
        return FeatureRequest((self.block(depth) + 1,), self.facet, norm=False)

    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of one sum of residuals for each word."""
        return TokenShape(0, self.clusters, dim)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: tuple[int, int]) -> AnyLoc:
        """Draw random unit vectors as words, until a vocabulary is built."""
        return AnyLoc(l2_normalise(draw.normal(key, (self.clusters, backbone.dim))))

    @property
    def spherical_centroids(self) -> bool:
        """Whether k-means compares features with centroids by the angle."""
        return self.assignment == "cosine"

    def from_centroids(
        self, centroids: Float[Array, "cluster dim"], features: Float[Array, "feature dim"]
    ) -> AnyLoc:
        """Use the centroids as words."""
        return AnyLoc(centroids)

    def attach_backbone_hash(self, params: AnyLoc, backbone: Any) -> AnyLoc:
        """Return the vocabulary with its backbone's digest."""
        return AnyLoc(params.words, _digest(backbone))

    def check_backbone(self, params: AnyLoc, backbone: Any, source: str) -> None:
        """Raise InputError where a vocabulary, if one was built, is of another backbone."""
        require(
            params.backbone is None or params.backbone == _digest(backbone),
            f"{source}: found a vocabulary of another backbone, expected one of these weights' "
            "(`crisalad vocabulary` builds it)",
        )

    def metadata(self, params: AnyLoc) -> dict[str, str]:
        """Return the backbone's digest, where a vocabulary was built."""
        return {} if params.backbone is None else {"backbone": params.backbone}

    def with_metadata(self, params: AnyLoc, metadata: Mapping[str, str]) -> AnyLoc:
        """Return the words with the backbone's digest."""
        return AnyLoc(params.words, metadata.get("backbone"))

    def apply(
        self, params: AnyLoc, features: Features, grid: tuple[int, int], *, key: Keys | None
    ) -> Tokens:
        """Return a sum of residuals for each word, of length 1, or 0 where no patch is near."""
        vlad = hard_vlad(params.words, features.patches, assignment=self.assignment)
        return Tokens.of_local(vlad)


def _digest(backbone: Any) -> str:
    digest = hashlib.sha256()
    for name, leaf in named_leaves(backbone).items():
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(leaf).data)
    return digest.hexdigest()


def hard_vlad(
    words: Float[Array, "cluster dim"],
    patches: Float[Array, "*batch patch dim"],
    *,
    assignment: Literal["cosine", "euclidean"],
) -> Float[Array, "*batch cluster dim"]:
    """Compute VLAD (Jegou et al. 2010) of unit patches, each at its nearest word, intra-normalised.

    Residuals are from the words as they are, whatever their lengths. It computes in float32 at
    least, at the highest precision: rounding would change words.
    """
    patches = l2_normalise(at_least_float32(patches))
    nearest = nearest_words(words, patches, assignment)
    shares = jax.nn.one_hot(nearest, len(words), dtype=patches.dtype)
    return l2_normalise(residual_sums(shares, patches, words))


def nearest_words(
    words: Float[Array, "cluster dim"],
    patches: Float[Array, "*batch patch dim"],
    assignment: Literal["cosine", "euclidean"],
) -> Int[Array, "*batch patch"]:
    """Find the word nearest to every unit patch, by the angle or the distance."""
    if assignment == "cosine":
        return jnp.argmax(jnp.matmul(patches, l2_normalise(words).T, precision="highest"), axis=-1)
    products = jnp.matmul(patches, words.T, precision="highest")
    # |p - w|^2 = 1 - 2 p w + |w|^2.
    return jnp.argmax(products - 0.5 * jnp.square(words).sum(axis=-1), axis=-1)
