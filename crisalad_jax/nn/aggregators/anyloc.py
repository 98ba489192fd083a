"""AnyLoc: hard VLAD of features that nobody trained for places (Keetha et al., RA-L 2023)."""

import zlib

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config import ModelConfig
from crisalad_jax.errors import InputError
from crisalad_jax.nn.aggregators.netvlad import residual_sums
from crisalad_jax.nn.layers import Keys, l2_normalise, widen
from crisalad_jax.nn.tokens import Tokens, local_alone
from crisalad_jax.nn.vit import Features, ViT
from crisalad_jax.pytree import named_leaves, params

_MARKS = 2**24
"""Below it whole numbers are float32."""


@params
class AnyLoc:
    """The words, and whose they are."""

    words: Float[Array, "cluster dim"]
    """k-means centroids of unit features."""
    backbone: Float[Array, ""]
    """The `mark` of the backbone that they are features of; 0 where none were built."""


def init(key: PRNGKeyArray, config: ModelConfig) -> AnyLoc:
    """Unit vectors at random in the place of words, until `crisalad_jax.vocabulary` builds some."""
    shape = (config.anyloc.clusters, config.backbone.dim)
    return AnyLoc(l2_normalise(jax.random.normal(key, shape)), jnp.zeros(()))


def from_words(words: Float[Array, "cluster dim"], backbone: ViT) -> AnyLoc:
    """A vocabulary that knows its backbone."""
    return AnyLoc(words, jnp.float32(mark(backbone)))


def mark(backbone: ViT) -> int:
    """A checksum of all of a backbone's parameters that float32 holds exactly; never 0."""
    value = 0
    for name, leaf in named_leaves(backbone).items():
        value = zlib.crc32(np.ascontiguousarray(leaf).data, zlib.crc32(name.encode(), value))
    return 1 + value % (_MARKS - 1)


def check_vocabulary(params: AnyLoc, backbone: ViT, source: str) -> None:
    """Check that a vocabulary, where one was built, is of this backbone's features.

    Raises:
        InputError: it is of another's; the message begins with `source`.
    """
    built = float(params.backbone)
    if built and built != mark(backbone):
        raise InputError(
            f"{source}: found a vocabulary of another backbone, expected one of these weights' "
            "(`crisalad vocabulary` builds it)"
        )


def apply(
    params: AnyLoc,
    features: Features,
    grid: tuple[int, int],
    config: ModelConfig,
    *,
    key: Keys | None,
) -> Tokens:
    """A sum of residuals for each word, of length 1, or 0 where no patch is near; nothing global.

    The features are those of `config.anyloc.facet`.
    """
    return local_alone(hard_vlad(params.words, features.patches))


def hard_vlad(
    words: Float[Array, "cluster dim"], patches: Float[Array, "*batch patch dim"]
) -> Float[Array, "*batch cluster dim"]:
    """VLAD (Jegou et al. 2010) of unit patches, each of the nearest word, intra-normalised.

    In float32 at least, and as exact as the hardware is: rounding would change words.
    """
    patches = l2_normalise(widen(patches))
    products = jnp.matmul(patches, words.T, precision="highest")
    # |p - w|^2 = 1 - 2 p w + |w|^2.
    nearest = jnp.argmax(products - 0.5 * jnp.square(words).sum(axis=-1), axis=-1)
    shares = jax.nn.one_hot(nearest, len(words), dtype=patches.dtype)
    return l2_normalise(residual_sums(shares, patches, words))
