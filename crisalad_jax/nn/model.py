"""Compose backbone, aggregation and cross-image encoder into CriSALAD (paper Figure 1).

DINO-SALAD, CricaVPR and bare DINOv2 are the same composition with other parts.
"""

import contextlib
import dataclasses
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, UInt8

from crisalad_jax.config.checks import require, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn import random_init
from crisalad_jax.nn.aggregators.base import check_tokens, to_descriptor
from crisalad_jax.nn.backbones.base import Features
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.diff_trees import diff_trees, not_finite
from crisalad_jax.nn.layers import (
    Keys,
    Linear,
    at_least_float32,
    init_linear,
    l2_normalise,
    merge_statistics,
    split_key,
    split_statistics,
)
from crisalad_jax.nn.pixels import check_pixels, normalise
from crisalad_jax.nn.projection import project
from crisalad_jax.nn.tokens import Tokens, as_sequence, from_sequence
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import IMAGE, image_mesh, over_images
from crisalad_jax.utils.errors import few
from crisalad_jax.utils.pytree import check_drawn, expect_like, named_leaves, pytree_dataclass
from crisalad_jax.utils.target import widens_slices

_ONLY_MULTIPLIED = re.compile(r"backbone\.blocks\..*(attn|mlp)\.\w+\.weight")
"""Names of linear weights, which `layers.linear` casts to the type of its input."""
AnyArray = Array | np.ndarray
Images = UInt8[AnyArray, "image height width 3"] | Float[AnyArray, "image height width 3"]
_F = TypeVar("_F", bound=Callable[..., Any])
_T = TypeVar("_T")


@pytree_dataclass
class Crisalad:
    """All parameters of a model."""

    backbone: Any
    """Parameters of `ModelConfig.backbone`."""
    aggregator: Any
    """Parameters of `ModelConfig.aggregator`; None if it has none."""
    cross_image: Any
    """Parameters of `ModelConfig.cross_image`; None if it has none."""
    projection: Linear | None = None
    """Parameters of `ModelConfig.projection`; None if there is no projection."""


@brief
class Model(NamedTuple):
    """A model: its parameters and its configuration, which the library passes around together."""

    params: Crisalad
    config: ModelConfig


@takes(config=ModelConfig, key=jax.Array)
def init_crisalad(key: PRNGKeyArray, config: ModelConfig) -> Crisalad:
    """Initialise a model's parameters at random, in float32.

    Args:
        key: random key.
        config: the model's configuration.

    Returns:
        The parameters. To use DINOv2's weights, replace `backbone` with them.

    Raises:
        InputError: a plug-in part returns anything but a pytree of float32 arrays.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS
        >>> params = init_crisalad(jax.random.key(0), PRESETS["tiny"])
        >>> params.backbone.cls_token.shape
        (128,)
    """
    with compiler.number_types():
        keys = random_init.split(key, 3)
        backbone = config.backbone.init(keys[0])
        check_drawn(backbone, f"backbone {config.backbone.part_name}")
        aggregator = config.aggregator.init(keys[1], config.backbone, config.grid)
        check_drawn(aggregator, f"aggregator {config.aggregator.part_name}")
        cross_image = config.cross_image.init(keys[2], config.sequence_dim)
        check_drawn(cross_image, f"cross_image {config.cross_image.part_name}")
        projection = None
        if config.projection.dim:
            dims = config.unprojected_dim, config.projection.dim
            projection = init_linear(jax.random.fold_in(key, 3), *dims)
        return Crisalad(backbone, aggregator, cross_image, projection)


@functools.lru_cache(maxsize=64)
def parameter_shapes(config: ModelConfig) -> Crisalad:
    """Return shapes and types of all parameters (`jax.ShapeDtypeStruct`); nothing is computed."""
    return jax.eval_shape(lambda key: init_crisalad(key, config), jax.random.key(0))


@takes(params=Crisalad, config=ModelConfig)
def check_params(params: Any, config: ModelConfig, *, stored: bool = False) -> None:
    """Check that parameters match a configuration: names, shapes and types.

    Traced parameters pass too, as do those that training has cast or split: the type may be
    `config.compute_dtype` instead of float32, and blocks may be in several stacks.

    Args:
        params: the parameters.
        config: the model's configuration.
        stored: whether they are to be saved, which needs unsplit, finite float32 arrays.

    Raises:
        InputError: params and config do not match (the first differences are listed), or the model
            computes in float64 outside JAX's 64-bit mode.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS
        >>> params = init_crisalad(jax.random.key(0), PRESETS["tiny"])
        >>> check_params(params, PRESETS["tiny"])
        >>> check_params(dataclasses.replace(params, aggregator=None), PRESETS["tiny"])
        Traceback (most recent call last):
        ...
        crisalad_jax.utils.errors.InputError: params: not of this configuration: aggregator. ...
    """
    template = parameter_shapes(config)
    if stored:
        problems = diff_trees(params, template) or not_finite(params)
    else:
        require(
            config.compute_dtype != "float64" or jax.config.jax_enable_x64,  # pyright: ignore
            "ModelConfig.compute_dtype: found float64 in JAX's 32-bit mode, expected "
            "JAX_ENABLE_X64=1 in the environment, or jax.config.update('jax_enable_x64', True)",
        )
        dtypes = {jnp.dtype(config.compute_dtype)}
        problems = diff_trees(params, template, dtypes)
        if problems:
            with contextlib.suppress(Exception):  # the blocks may be anything
                backbone = jax.eval_shape(config.backbone.join_blocks, params.backbone)
                joined = dataclasses.replace(params, backbone=backbone)
                problems = diff_trees(joined, template, dtypes)
    require(not problems, f"params: not of this configuration: {few(problems)}")


@takes(config=ModelConfig)
def cast_params(params: Any, config: ModelConfig) -> Any:
    """Cast the weights of the backbone's large linear layers to the type of their products.

    Without this, every call casts them. Descriptors stay the same, bit for bit. In bfloat16 weights
    take half the memory and can no longer be trained; if XLA would widen them again in every call
    (`widens_slices`), they stay float32. In float64 all parameters are cast, so that no sum is
    rounded to float32.

    Args:
        params: the parameters, or a tree with some of them left out.
        config: the model's configuration.

    Returns:
        Parameters that `describe` accepts as well. In float32, `params` itself.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS
        >>> config = dataclasses.replace(PRESETS["tiny"], compute_dtype="bfloat16")
        >>> params = cast_params(init_crisalad(jax.random.key(0), config), config)
        >>> params.backbone.norm.weight.dtype  # which is not of a product
        dtype('float32')
    """
    dtype = jnp.dtype(config.compute_dtype)
    if dtype == jnp.bfloat16 and widens_slices():
        return params

    def cast(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        is_cast = dtype == jnp.float64 or _ONLY_MULTIPLIED.fullmatch(name)
        return leaf.astype(dtype) if is_cast else leaf

    return jax.tree_util.tree_map_with_path(cast, params)


@takes(model=Model)
def merge_adapters(model: Model) -> Model:
    """Merge adapters into the weights that they update, for inference at the backbone's cost.

    The descriptors are the same up to rounding. LoRA can be merged (W + alpha / rank B A, Hu et al.
    2021, section 4.1); adapters that do not act on a weight cannot.

    Args:
        model: a model with adapters.

    Returns:
        A model whose adapter is "none", with new weights.

    Raises:
        InputError: the backbone has no adapters, or they cannot be merged.

    Example:
        >>> import jax
        >>> from crisalad_jax import init_crisalad, recipe
        >>> config = recipe("tiny", "crisalad+lora").model
        >>> merged = merge_adapters(Model(init_crisalad(jax.random.key(0), config), config))
        >>> merged.config.backbone.adapter.part_name, merged.params.backbone.blocks.adapter
        ('none', None)
    """
    params, config = model
    check_params(params, config)
    with compiler.number_types():
        backbone, merged = config.backbone.merge_adapters(params.backbone)
    return Model(
        dataclasses.replace(params, backbone=merged), dataclasses.replace(config, backbone=backbone)
    )


def _of_images(function: _F) -> _F:
    """Pass the devices of the images to a compiled function of images.

    Pixel values are unknown during tracing, so they are checked before the call.
    """
    spread = over_images("images", 1)(function)

    @takes(params=Crisalad, config=ModelConfig)
    @functools.wraps(spread)
    def call(params: Any, images: Any, config: Any, **options: Any) -> Any:
        check_pixels(images, config.preprocessing)
        return spread(params, images, config, **options)

    return cast(_F, call)


@_of_images
@functools.partial(compiler.jit, static_argnames=("config", "micro_batch"))
def describe(
    params: Crisalad,
    images: Images,
    config: ModelConfig,
    *,
    mask: Bool[AnyArray, "image image"] | None = None,
    key: Key[Array, ""] | None = None,
    micro_batch: int | None = None,
) -> Float[Array, "image descriptor"]:
    """Compute the descriptors of a batch of RGB images.

    With a cross-image encoder, a descriptor depends on the images that `mask` lets it attend to:
    `mask[i, j]` allows image i to attend to image j, and None allows all. An image that may attend
    to none attends to itself. See `self_mask` and `valid_mask`.

    `jax.jit`, `jax.vmap` and reverse mode (`jax.grad`, `jax.jacrev`, once or twice) are supported.
    Forward mode (`jax.jvp`, `jax.hessian`) is not supported: attention and max pooling have custom
    gradients, for speed. For a Hessian, use `jax.jacrev` of `jax.grad`. On an accelerator, where
    attention is fused, the gradient can be taken only once.

    Args:
        params: parameters from `init_crisalad` or a weight file.
        images: 8-bit pixels, which are normalised here as `config.preprocessing` says, or floats
            that are already normalised (float pixels from 0 to 1 or 0 to 255 are rejected). Sides
            may be any that the backbone accepts, not only `config.image_size`. See `prepare_image`.
        config: the model's configuration; static.
        mask: which images attend to which.
        key: a `jax.random.key` for dropout; None means inference.
        micro_batch: see `extract_tokens`; images still attend to the whole batch.

    Returns:
        Descriptors in at least float32, of length 1 if `config.unit_length`.

    Raises:
        InputError: the parameters do not match the configuration; float images are not normalised;
            `images` is empty, or of a wrong type or shape; there are too few patches for the
            aggregator; `mask` has a wrong shape; or `micro_batch` does not divide the batch.

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> describe(params, np.zeros((2, 98, 98, 3), np.uint8), config).shape
        (2, 576)
    """
    tokens_key, cross_key = split_key(key, 2)
    tokens = extract_tokens(params, images, config, key=tokens_key, micro_batch=micro_batch)
    return attend_across_images(params, tokens, config, mask=mask, key=cross_key)


@_of_images
@functools.partial(compiler.jit, static_argnames=("config", "micro_batch"))
def extract_tokens(
    params: Crisalad,
    images: Images,
    config: ModelConfig,
    *,
    key: Key[Array, ""] | None = None,
    micro_batch: int | None = None,
) -> Tokens:
    """Extract the tokens of each image independently: the first half of `describe`.

    With `micro_batch`, the backbone runs on that many images at a time, and again for the gradient.
    Memory then holds the activations of one micro-batch (as in GradCache, Gao et al. 2021). Tokens
    and gradients equal those of the whole batch up to rounding, including dropout.

    Args:
        params: see `describe`.
        images: see `describe`.
        config: see `describe`.
        key: see `describe`.
        micro_batch: a divisor of the number of images; None takes all.

    Returns:
        The tokens of each image.

    Raises:
        InputError: an argument is invalid (see `describe`).

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> extract_tokens(params, np.zeros((1, 98, 98, 3), np.uint8), config).local.shape
        (1, 16, 32)
    """
    return tokens_and_statistics(params, images, config, key=key, micro_batch=micro_batch)[0]


def tokens_and_statistics(
    params: Crisalad,
    images: Images,
    config: ModelConfig,
    *,
    valid: Bool[Array, " image"] | None = None,
    key: Key[Array, ""] | None = None,
    micro_batch: int | None = None,
) -> tuple[Tokens, Crisalad | None]:
    """Extract tokens while tracing, and update the running statistics in training.

    With `valid`, batch norms normalise by the mean and variance of the batch's valid images, like
    torch in training mode, so a token depends on the other images. Devices that share a batch share
    its statistics. Each micro-batch is a separate forward pass: it has its own statistics, and
    updates the running ones in turn.

    Args:
        params: see `describe`.
        images: see `describe`.
        config: see `describe`.
        valid: mask of the images whose statistics are used; None uses the stored ones.
        key: see `describe`.
        micro_batch: see `extract_tokens`.

    Returns:
        (tokens, statistics): `statistics` is a tree of the structure of `params` with the running
        statistics after this batch, and None for all other leaves; it is None if `valid` is.

    Raises:
        InputError: an argument is invalid (see `describe`).
    """
    count = images.shape[0]  # may be symbolic, unlike `len`
    keys = None if key is None else jax.random.split(key, count)
    require(
        micro_batch is None or count % micro_batch == 0,
        f"micro_batch: found {micro_batch}, expected a divisor of the batch's {count} images",
    )
    mesh = image_mesh()
    if mesh is None or valid is not None:
        return _tokens_in_parts(params, images, valid, config, keys, micro_batch)
    # Without batch statistics, a device needs nothing from the others. XLA's partitioner would
    # not see that in loops over images, and would sum gradients layer by layer.
    own = count // mesh.size
    if micro_batch is not None:
        at_once = max(1, micro_batch // mesh.size)
        micro_batch = max(n for n in range(1, at_once + 1) if own % n == 0)

    def tokens_of_own(params: Crisalad, images: Images, keys: Keys) -> Tokens:
        return _tokens_in_parts(params, images, None, config, keys, micro_batch)[0]

    alike, shared = PartitionSpec(), PartitionSpec(IMAGE)
    extract = jax.shard_map(
        tokens_of_own,
        mesh=mesh,
        in_specs=(alike, shared, shared),
        out_specs=shared,
        check_vma=False,  # plug-in parts need not follow its rules
    )
    return extract(params, images, keys), None


def _tokens_in_parts(
    params: Crisalad,
    images: Images,
    valid: Bool[Array, " image"] | None,
    config: ModelConfig,
    keys: Keys,
    micro_batch: int | None,
) -> tuple[Tokens, Crisalad | None]:
    """Extract tokens `micro_batch` images at a time; see `tokens_and_statistics`."""

    def tokens_of(
        statistics: Crisalad | None, part: tuple[Images, Keys, Array | None]
    ) -> tuple[Crisalad | None, Tokens]:
        images, keys, valid = part
        current = params if statistics is None else merge_statistics(statistics, params)
        features, updated = _extract_features(current, images, config, valid=valid)
        grid = config.backbone.grid((images.shape[1], images.shape[2]))
        with jax.named_scope("aggregator"):
            tokens = config.aggregator.apply(params.aggregator, features, grid, key=keys)
        check_tokens(tokens, config.aggregator, config.backbone.dim, (images.shape[0],))
        return None if statistics is None else split_statistics(updated)[0], tokens

    statistics = None if valid is None else split_statistics(params)[0]
    count, whole = images.shape[0], (images, keys, valid)
    if micro_batch is None or micro_batch == count:
        statistics, tokens = tokens_of(statistics, whole)
        return tokens, statistics

    # Parts are interleaved, so that each device of a sharded batch has a share of every part.
    def split(x: Array) -> Array:
        return x.reshape(micro_batch, -1, *x.shape[1:]).swapaxes(0, 1)

    def join(x: Array) -> Array:
        return x.swapaxes(0, 1).reshape(count, *x.shape[2:])

    once = jax.checkpoint(tokens_of, prevent_cse=False)
    statistics, tokens = jax.lax.scan(once, statistics, jax.tree.map(split, whole))
    return jax.tree.map(join, tokens), statistics


@_of_images
@functools.partial(compiler.jit, static_argnames="config")
def extract_features(params: Crisalad, images: Images, config: ModelConfig) -> Features:
    """Extract from every image the features that the aggregator requests.

    Args:
        params: see `describe`.
        images: see `describe`.
        config: see `describe`.

    Returns:
        The requested features.

    Raises:
        InputError: an argument is invalid (see `describe`).

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> extract_features(params, np.zeros((1, 98, 98, 3), np.uint8), config).patches.shape
        (1, 49, 128)
    """
    return _extract_features(params, images, config)[0]


def _extract_features(
    params: Crisalad,
    images: Images,
    config: ModelConfig,
    *,
    valid: Bool[Array, " image"] | None = None,
    with_insertion: bool = True,
) -> tuple[Features, Crisalad]:
    """Extract features, and return parameters with updated statistics, as `Backbone.apply` does."""
    check_params(params, config)
    images, params = _normalised(images, config), _widened(params, config)
    request = config.aggregator.features(config.backbone.depth)
    if with_insertion:
        inserted = config.aggregator.inserted(params.aggregator)
        request = dataclasses.replace(request, inserted=inserted)
    with jax.named_scope("backbone"):
        features, backbone = config.backbone.apply(
            params.backbone,
            images,
            request,
            remat=config.remat,
            valid=valid,
        )
    return features, dataclasses.replace(params, backbone=backbone)


def _normalised(images: Images, config: ModelConfig) -> Float[Array, "image height width 3"]:
    """Check a batch of images, normalise bytes, and cast to the type to compute in."""
    images, are_bytes = jnp.asarray(images), images.dtype == jnp.uint8
    require(
        images.ndim == 4
        and images.shape[-1] == 3
        and images.shape[0] != 0
        and (are_bytes or jnp.issubdtype(images.dtype, jnp.floating)),
        f"images: found {images.dtype} of shape {images.shape}, expected uint8 pixels, or floats "
        "that are normalised, of shape (image, height, width, 3), and at least one image",
    )
    config.check_image_size((images.shape[1], images.shape[2]))
    if are_bytes:
        images = jax.vmap(functools.partial(normalise, how=config.preprocessing))(images)
    return images.astype(config.compute_dtype)


def _widened(params: Crisalad, config: ModelConfig) -> Crisalad:
    """Cast all parameters for a model that computes in float64."""
    return cast_params(params, config) if config.compute_dtype == "float64" else params


@_of_images
@functools.partial(compiler.jit, static_argnames="config")
def unit_features(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image patch dim"]:
    """Return the aggregator's patch features, scaled to unit length, in at least float32.

    Arguments are those of `describe`. Tokens that the aggregator would insert are left out.

    Raises:
        InputError: an argument is invalid (see `describe`).
    """
    features, _ = _extract_features(params, images, config, with_insertion=False)
    return l2_normalise(at_least_float32(features.patches))


@takes(params=Crisalad, tokens=Tokens, config=ModelConfig)
@functools.partial(compiler.jit, static_argnames="config")
def attend_across_images(
    params: Crisalad,
    tokens: Tokens,
    config: ModelConfig,
    *,
    mask: Bool[AnyArray, "image image"] | None = None,
    key: Key[Array, ""] | None = None,
) -> Float[Array, "image descriptor"]:
    """Attend across images and compute their descriptors: the second half of `describe`.

    To describe the same images in several groupings, extract their tokens once.

    Args:
        params: see `describe`.
        tokens: tokens from `extract_tokens`.
        config: see `describe`.
        mask: see `describe`.
        key: see `describe`.

    Returns:
        See `describe`.

    Raises:
        InputError: the parameters or tokens do not match the configuration, or, while tracing, the
            mask has a wrong shape.

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> tokens = extract_tokens(params, np.zeros((2, 98, 98, 3), np.uint8), config)
        >>> attend_across_images(params, tokens, config, mask=self_mask(2)).shape
        (2, 576)
    """
    check_params(params, config)
    params = _widened(params, config)
    count = tokens.local.shape[0]
    shape = config.token_shape
    found = tokens.global_token.shape, tokens.local.shape
    expected = (count, shape.global_dim), (count, shape.tokens, shape.token_dim)
    require(
        found == expected,
        f"tokens: found a global token of shape {found[0]} and local tokens of {found[1]}, "
        f"expected {expected[0]} and {expected[1]}",
    )
    encoder, sequence = config.cross_image, None
    if encoder.attends:
        mask = _checked_mask(mask, count)
        with jax.named_scope("cross_image"):
            sequence = _sequence(tokens, config)
            found = encoder.apply(params.cross_image, sequence, mask=mask, key=key)
            expect_like(f"cross_image {encoder.part_name}", found, sequence)
            sequence = found.astype(tokens.local.dtype)
    if sequence is not None and encoder.width is not None:
        descriptors = sequence.reshape(count, config.unprojected_dim)
    else:
        if sequence is not None:
            tokens = from_sequence(sequence, tokens, global_token=encoder.global_token)
        descriptors = to_descriptor(tokens, config.aggregator)
    if params.projection is None:
        return descriptors
    with jax.named_scope("projection"):
        return project(params.projection, descriptors, config.projection)


def _sequence(tokens: Tokens, config: ModelConfig) -> Float[Array, "image token dim"]:
    """Return the input of the cross-image encoder: tokens, or a descriptor cut into pieces."""
    encoder = config.cross_image
    if encoder.width is None:
        sequence = as_sequence(tokens, global_token=encoder.global_token)
    else:
        descriptors = to_descriptor(tokens, config.aggregator)
        pieces = config.unprojected_dim // encoder.width, encoder.width
        sequence = descriptors.reshape(descriptors.shape[0], *pieces)
    return sequence.astype(config.compute_dtype)


def _checked_mask(
    mask: Bool[AnyArray, "image image"] | None, count: Any
) -> Bool[Array, "image image"] | None:
    """Return the mask of `describe`, in which an image that may attend to none attends to itself.

    Raises:
        InputError: it has a wrong shape.
    """
    if mask is None:
        return None
    require(
        mask.shape == (count, count),
        f"mask: found shape {mask.shape}, expected {(count, count)}, a row and a column for each "
        "image",
    )
    return jnp.asarray(mask) | (self_mask(count) & ~mask.any(axis=1, keepdims=True))


@_of_images
@functools.partial(compiler.jit, static_argnames=("config", "block"))
def attention_maps(
    params: Crisalad, images: Images, config: ModelConfig, *, block: int = -1
) -> Float[Array, "image head token token"]:
    """Compute the attention maps of a block of a vision transformer.

    Entry (i, j) of a head's map is the weight of token j for token i; rows sum to 1. Tokens are the
    class token, the registers, then the patches in row order: `maps[:, :, 0, 1 + registers:]` has
    the weights of the patches for the class token.

    Args:
        params: see `describe`.
        images: see `describe`.
        config: see `describe`.
        block: index of the block, from 0; negative indices count from the last.

    Returns:
        The softmax of the scores, in at least float32.

    Raises:
        InputError: the backbone has no such block or no attention, or has adapters with prompts or
            a side path; the aggregator inserts tokens; or an argument is invalid (see `describe`).

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> attention_maps(params, np.zeros((1, 98, 98, 3), np.uint8), config, block=0).shape
        (1, 4, 50, 50)
    """
    check_params(params, config)
    backbone: Any = config.backbone
    require(
        backbone.exposes_cls_attention,
        f"backbone: found {backbone.part_name}, expected one that has attention, such as vit",
    )
    require(
        config.aggregator.features(backbone.depth).insertion is None,
        f"aggregator: found {config.aggregator.part_name}, which inserts tokens, expected another",
    )
    require(
        -backbone.depth <= block < backbone.depth,
        f"block: found {block}, expected {-backbone.depth} to {backbone.depth - 1}",
    )
    pixels, number = _normalised(images, config), block % backbone.depth
    return backbone.attention_maps(_widened(params, config).backbone, pixels, number)


@_of_images
@functools.partial(compiler.jit, static_argnames="config")
def cross_image_attention(
    params: Crisalad,
    images: Images,
    config: ModelConfig,
    *,
    mask: Bool[AnyArray, "image image"] | None = None,
) -> Float[Array, "layer token head image image"]:
    """Compute the attention between images in the layers of the cross-image encoder.

    Entry (i, j) is the weight of image j's token for the same token of image i; rows sum to 1. The
    tokens are the pieces of the global token, then the clusters; or the pieces of the descriptor,
    if the encoder cuts it.

    Args:
        params: see `describe`.
        images: see `describe`.
        config: see `describe`.
        mask: see `describe`.

    Returns:
        The softmax of the scores, in at least float32.

    Raises:
        InputError: the model has no such attention, or an argument is invalid (see `describe`).

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> cross_image_attention(params, np.zeros((3, 98, 98, 3), np.uint8), config).shape
        (2, 18, 4, 3, 3)
    """
    tokens, encoder = extract_tokens(params, images, config), config.cross_image
    sequence = _sequence(tokens, config)
    mask = _checked_mask(mask, len(sequence))
    return encoder.attention(_widened(params, config).cross_image, sequence, mask=mask)


def describe_training_batch(
    params: Crisalad,
    images: Images,
    config: ModelConfig,
    *,
    valid: Bool[Array, " image"],
    measured: Bool[Array, " image"] | None,
    key: Key[Array, ""] | None,
    micro_batch: int | None = None,
    sub_batches: Sequence[int] = (),
) -> tuple[Float[Array, "image descriptor"], Tokens, Crisalad | None]:
    """Compute the descriptors of a batch while tracing a training step.

    Args:
        params: see `describe`.
        images: see `describe`.
        config: see `describe`.
        valid: mask of the images that attend to each other; the others attend to themselves.
        measured: mask of the images whose statistics batch norms use; None uses the stored ones.
        key: random key for dropout; None means no dropout.
        micro_batch: see `extract_tokens`.
        sub_batches: sizes of groups of consecutive images that attend only to each other; empty if
            the whole batch is one group.

    Returns:
        (descriptors, tokens, statistics): `statistics` are as in `tokens_and_statistics`. The
        descriptors are unit vectors, as losses expect, even if the model does not normalise them.
    """
    tokens_key, cross_key = split_key(key, 2)
    tokens, statistics = tokens_and_statistics(
        params, images, config, valid=measured, key=tokens_key, micro_batch=micro_batch
    )
    mask = valid_mask(valid)
    if sub_batches:
        of_image = np.repeat(np.arange(len(sub_batches)), sub_batches)
        mask &= of_image[:, None] == of_image
    descriptors = attend_across_images(params, tokens, config, mask=mask, key=cross_key)
    if not config.unit_length:
        descriptors = l2_normalise(descriptors)
    return descriptors, tokens, statistics


@_of_images
@functools.partial(compiler.jit, static_argnames="config")
def transport_masses(
    params: Crisalad, images: Images, config: ModelConfig
) -> Float[Array, "image patch column"]:
    """Compute the mass that the transport plan sends from each patch to each cluster.

    Patches are in row order; each sends a mass of 1. If there is a dustbin, it is the last column.

    Args:
        params: see `describe`.
        images: see `describe`.
        config: see `describe`.

    Returns:
        The plan of each image.

    Raises:
        InputError: the aggregator has no transport, or an argument is invalid (see `describe`).

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> transport_masses(params, np.zeros((1, 98, 98, 3), np.uint8), config).shape
        (1, 49, 17)
    """
    return config.aggregator.plan(params.aggregator, extract_features(params, images, config))


def self_mask(count: Any) -> Bool[Array, "image image"]:
    """Return the mask that lets every image attend only to itself, not its batch.

    Args:
        count: number of images in the batch, which may be symbolic in an export.

    Returns:
        A mask for `describe`.

    Example:
        >>> self_mask(2).tolist()
        [[True, False], [False, True]]
    """
    return jnp.eye(count, dtype=bool)


def valid_mask(valid: Bool[Array, " image"]) -> Bool[Array, "image image"]:
    """Return the mask that lets valid images attend to each other, and the others to themselves.

    Args:
        valid: which images are not padding.

    Returns:
        A mask for `describe`.

    Example:
        >>> import jax.numpy as jnp
        >>> valid_mask(jnp.array([True, False])).tolist()
        [[True, False], [False, True]]
    """
    return valid[None, :] & valid[:, None] | jnp.eye(len(valid), dtype=bool)


def params_of(arrays: Mapping[str, np.ndarray], config: ModelConfig, *, source: str) -> Crisalad:
    """Build parameters from stored arrays, by their dotted names.

    Args:
        arrays: finite float32 arrays by name, such as "backbone.cls_token"; blocks are unsplit.
        config: the model's configuration.
        source: name of the file, for messages.

    Raises:
        InputError: the arrays are not exactly the model's parameters; the first differences are
            listed.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS
        >>> params = init_crisalad(jax.random.key(0), PRESETS["tiny"])
        >>> again = params_of(named_leaves(params), PRESETS["tiny"], source="")
        >>> jax.tree.structure(again) == jax.tree.structure(params)
        True
    """
    return tree_of(arrays, parameter_shapes(config), source=source)


def tree_of(arrays: Mapping[str, np.ndarray], template: _T, *, source: str) -> _T:
    """Build a tree from stored arrays, by their dotted names.

    Args:
        arrays: finite arrays by name.
        template: a tree of their shapes and types.
        source: name of the file, for messages.

    Raises:
        InputError: the arrays do not match the template; the first differences are listed.
    """
    names = named_leaves(template)
    problems = diff_trees(arrays, names) or not_finite(arrays)
    require(not problems, f"{source}: weights do not fit: {few(problems)}")
    leaves = jax.device_put([arrays[name] for name in names])
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
