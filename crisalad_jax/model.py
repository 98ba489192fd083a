"""CriSALAD: the composition of backbone, aggregation and cross-image encoder (paper Figure 1).

DINO-SALAD, CricaVPR and bare DINOv2 are the same composition with other parts.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, UInt8

from crisalad_jax import platform
from crisalad_jax.config import ModelConfig
from crisalad_jax.errors import InputError
from crisalad_jax.nn.aggregators import Aggregator, aggregate, init_aggregator, join
from crisalad_jax.nn.cross_image import CrossImageEncoder, cross_image_encoder, init_cross_image
from crisalad_jax.nn.layers import Keys, l2_normalise, split_key, widen
from crisalad_jax.nn.pixels import normalise
from crisalad_jax.nn.salad import Salad, transport
from crisalad_jax.nn.tokens import Tokens, as_sequence, from_sequence
from crisalad_jax.nn.vit import Features, ViT, facet, grid_of, init_vit, vit, vit_levels
from crisalad_jax.pytree import params

Images = UInt8[Array, "image height width 3"] | Float[Array, "image height width 3"]


@params
class Crisalad:
    """All parameters of a model."""

    backbone: ViT
    aggregator: Aggregator | None
    encoder: CrossImageEncoder | None


def init_crisalad(key: PRNGKeyArray, config: ModelConfig) -> Crisalad:
    """Random parameters in float32. A user with DINOv2 weights puts those in `backbone`."""
    backbone, aggregator, encoder = jax.random.split(key, 3)
    return Crisalad(
        backbone=init_vit(backbone, config.backbone),
        aggregator=init_aggregator(aggregator, config),
        encoder=init_cross_image(encoder, config.shape.token_dim, config.encoder)
        if config.encoder.layers
        else None,
    )


def parameter_shapes(config: ModelConfig) -> Crisalad:
    """Shapes and types of all parameters (`jax.ShapeDtypeStruct`); nothing is computed."""
    return jax.eval_shape(functools.partial(init_crisalad, config=config), jax.random.key(0))


@functools.partial(platform.jit, static_argnames=("config", "micro_batch"))
def describe(
    params: Crisalad,
    images: Images,
    config: ModelConfig,
    *,
    mask: Bool[Array, "image image"] | None = None,
    key: Key[Array, ""] | None = None,
    micro_batch: int | None = None,
) -> Float[Array, "image descriptor"]:
    """Unit descriptors of a batch of RGB images.

    With a cross-image encoder a descriptor depends on the images that `mask` lets it look at:
    `mask[i, j]` says that image i may look at image j, and None lets all look at all. See
    `alone` and `among`.

    Args:
        params: from `init_crisalad` or a weight file.
        images: 8-bit pixels, which are normalised here as `config.normalisation` says, or floats
            that already are. The sides are multiples of 14; they need not be `config.image_size`.
        config: the model, static.
        mask: who looks at whom.
        key: draws the dropout (a `jax.random.key`); None means inference.
        micro_batch: see `tokenise`; the images that see each other are the whole batch.

    Raises:
        InputError: while tracing, for images of the wrong rank, channels or sides, or with too few
            patches for the clusters; or a batch is no multiple of `micro_batch`.
    """
    tokens_key, encoder_key = split_key(key, 2)
    tokens = tokenise(params, images, config, key=tokens_key, micro_batch=micro_batch)
    return relate(params, tokens, config, mask=mask, key=encoder_key)


@functools.partial(platform.jit, static_argnames=("config", "micro_batch"))
def tokenise(
    params: Crisalad,
    images: Images,
    config: ModelConfig,
    *,
    key: Key[Array, ""] | None = None,
    micro_batch: int | None = None,
) -> Tokens:
    """The first half of `describe`: every image's tokens, which owe nothing to other images.

    With a `micro_batch` the images go through the backbone so many at a time, and again for the
    gradient, so that the activations of no more are in memory (as in GradCache, Gao et al. 2021).
    Tokens and gradients are those of the whole batch to rounding, dropout included.

    Raises:
        InputError: as `describe`.
    """

    def part_of(images: Images, keys: Keys | None) -> Tokens:
        features = _features(params, images, config)
        return aggregate(params.aggregator, features, grid_of(images[0]), config, key=keys)

    count = images.shape[0]  # which may be symbolic, where `len` is not
    keys = None if key is None else jax.random.split(key, count)
    if micro_batch is None or micro_batch == count:
        return part_of(images, keys)
    if count % micro_batch:
        raise InputError(
            f"micro_batch: found {micro_batch}, expected a divisor of the batch's {count} images"
        )

    # Every so-many-th image is a part: of a batch on several devices each has its share of it.
    def split(x: Array) -> Array:
        return x.reshape(micro_batch, -1, *x.shape[1:]).swapaxes(0, 1)

    def whole(x: Array) -> Array:
        return x.swapaxes(0, 1).reshape(count, *x.shape[2:])

    once = jax.checkpoint(lambda part: part_of(*part), prevent_cse=False)
    return jax.tree.map(whole, jax.lax.map(once, jax.tree.map(split, (images, keys))))


def _features(params: Crisalad, images: Images, config: ModelConfig) -> Features:
    if images.ndim != 4 or images.shape[-1] != 3:
        raise InputError(f"images: found shape {images.shape}, expected (image, height, width, 3)")
    config.check_image_size((images.shape[1], images.shape[2]))

    if images.dtype == jnp.uint8:
        images = jax.vmap(functools.partial(normalise, how=config.normalisation))(images)
    pixels = images.astype(config.compute_dtype)
    if config.aggregator == "transvpr":
        depths = config.transvpr.depths(config.backbone.depth)
        return vit_levels(params.backbone, pixels, config.backbone, depths, keeps=config.keeps)
    if config.aggregator == "anyloc":
        block = config.anyloc.block(config.backbone.depth)
        return facet(params.backbone, pixels, config.backbone, block, config.anyloc.facet)
    return vit(params.backbone, pixels, config.backbone, keeps=config.keeps)


@functools.partial(platform.jit, static_argnames="config")
def features_of(params: Crisalad, images: Images, config: ModelConfig) -> Features:
    """What the aggregator is given of every image, before it makes tokens of it.

    Raises:
        InputError: as `describe`.
    """
    return _features(params, images, config)


@functools.partial(platform.jit, static_argnames="config")
def unit_features(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image patch dim"]:
    """What the aggregator finds in the patches, made unit vectors: what vocabularies are made of.

    In float32 at least.

    Raises:
        InputError: as `describe`.
    """
    return l2_normalise(widen(features_of(params, images, config).patches))


@functools.partial(platform.jit, static_argnames="config")
def relate(
    params: Crisalad,
    tokens: Tokens,
    config: ModelConfig,
    *,
    mask: Bool[Array, "image image"] | None = None,
    key: Key[Array, ""] | None = None,
) -> Float[Array, "image descriptor"]:
    """The second half of `describe`: images look at each other, then become descriptors.

    To see the same images in several groupings, `tokenise` them once.
    """
    if params.encoder is not None:
        enter = functools.partial(as_sequence, global_token=config.encoder.global_token)
        leave = functools.partial(from_sequence, global_token=config.encoder.global_token)
        sequence = jax.vmap(enter)(tokens).astype(config.compute_dtype)
        sequence = cross_image_encoder(params.encoder, sequence, config.encoder, mask=mask, key=key)
        tokens = jax.vmap(leave)(sequence.astype(tokens.local.dtype), tokens)
    return jax.vmap(functools.partial(join, config=config))(tokens)


@functools.partial(platform.jit, static_argnames="config")
def transport_masses(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image patch column"]:
    """What SALAD's transport sends from each patch, in row order, to each cluster.

    A patch has a mass of 1 to send. Where there is a dustbin, what it takes is the last column.

    Raises:
        InputError: the model has no SALAD, or as `describe`.
    """
    if not isinstance(params.aggregator, Salad):
        raise InputError(f"aggregator: found {config.aggregator}, expected salad, which transports")
    features = _features(params, images, config)
    return jnp.exp(transport(params.aggregator, features.patches, config.salad, key=None).log_plan)


def alone(count: int) -> Bool[Array, "image image"]:
    """The mask under which every image looks at itself only, and owes nothing to its batch."""
    return jnp.eye(count, dtype=bool)


def among(valid: Bool[Array, " image"]) -> Bool[Array, "image image"]:
    """The mask under which valid images look at each other, and the others only at themselves."""
    return valid[None, :] & valid[:, None] | jnp.eye(len(valid), dtype=bool)
