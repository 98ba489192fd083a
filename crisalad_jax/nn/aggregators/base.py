"""Aggregators, which turn an image's features into tokens: their interface and registry."""

import abc
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import require
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn.backbones.base import Backbone, Features, FeatureSpec, Grid, Patches
from crisalad_jax.nn.layers import Keys, at_least_float32, l2_normalise
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import expect_like

Centroids = Float[Array, "cluster dim"]
FeatureRows = Float[Array, "feature dim"]
FlattenOrder = Literal["token-first", "dimension-first"]
Cut = tuple[int, int]
"""First row or column of a region, and the one after its last."""


@brief
class TokenShape(NamedTuple):
    """The shape of an image's tokens: a global one and local ones."""

    global_dim: int
    """Width of the global token; 0 if there is none."""
    tokens: int
    """Number of local tokens."""
    token_dim: int
    """Width of a local token, and of the cross-image encoder."""


class Aggregator(Part, abc.ABC):
    """A method that turns features into tokens: a frozen dataclass whose fields are its settings.

    Implement `token_shape` and `apply`. An aggregator without parameters can also be a function
    from the `Features` of one image to a vector, or to a matrix with a token in each row.

    Example:
        >>> from crisalad_jax import ModelConfig, register_aggregator
        >>> @register_aggregator("largest")
        ... class Largest(Aggregator):
        ...     power: float = 1.0
        ...
        ...     def token_shape(self, dim):
        ...         return TokenShape(dim, 0, dim)
        ...
        ...     def apply(self, params, features, grid, *, key):
        ...         return Tokens.of_global(features.patches.max(axis=-2) ** self.power)
        >>> ModelConfig(aggregator=Largest(power=2.0)).descriptor_dim
        768
    """

    flatten_order: ClassVar[FlattenOrder] = "token-first"
    """Order of the local tokens in a descriptor: token by token, or the first dimension of all
    tokens, then their second, and so on."""
    trainable: ClassVar[bool] = True
    """Whether the aggregator's parameters train; if not, no part of the model does."""
    fixed_grid: ClassVar[bool] = False
    """Whether the aggregator's parameters fit only one image size."""
    centroid_images: ClassVar[int] = 500
    """Maximum number of training images from whose features the initial centroids are computed."""
    spherical_centroids: ClassVar[bool] = False
    """Whether k-means compares features with centroids by angle instead of distance. Either way a
    centroid is the mean of its features."""
    class_token: ClassVar[bool] = False
    """Whether `features` by default requests the class token too; not every backbone has one."""

    def numbers(self, params: Any) -> Mapping[str, Any]:
        """Return values to log at each validation, by name; by default none."""
        return {}

    @abc.abstractmethod
    def token_shape(self, dim: int) -> TokenShape:
        """Return the shape of the tokens of an image whose features have width `dim`."""

    def features(self, depth: int) -> FeatureSpec:
        """Return features to request from a backbone of `depth` blocks; by default the last one's.

        Raises:
            InputError: the backbone has too few blocks.
        """
        return FeatureSpec(class_token=self.class_token)

    def init(self, key: PRNGKeyArray, backbone: Backbone, grid: Grid) -> Any:
        """Draw random parameters, a pytree of float32 arrays; by default None.

        Args:
            key: random key.
            backbone: the backbone of the features.
            grid: rows and columns of patches in an image of the model's size.
        """
        return None

    def inserted(self, params: Any) -> Float[Array, "inserted dim"] | None:
        """Return additional tokens to run through the backbone's blocks; by default None.

        `FeatureSpec.insertion` from `features` says where; `Features.inserted` has their outputs.
        """
        return None

    @abc.abstractmethod
    def apply(self, params: Any, features: Features, grid: Grid, *, key: Keys) -> Tokens:
        """Return the tokens of one image or of a batch, in at least float32.

        Args:
            params: from `init`.
            features: the features that `features` requested.
            grid: rows and columns of patches.
            key: random key for dropout, one for all images or one for each; None for inference.
        """

    def check_grid(self, grid: Grid, patch_size: int) -> None:
        """Raise InputError if an image with this grid is too small; by default, accept any grid."""

    def from_centroids(self, centroids: Centroids, features: FeatureRows) -> Any:
        """Make parameters from k-means centroids of features.

        `starts_from_centroids` is True for aggregators that implement this.

        Args:
            centroids: k-means centroids of what `centroid_features` returns.
            features: the features, scaled to unit length, before `centroid_features`.
        """
        raise NotImplementedError

    def with_frequencies(self, params: Any, images: Sequence[Any]) -> Any:
        """Weight the centroids by how many images contain each of them; by default, do nothing.

        Args:
            params: from `from_centroids`.
            images: an array of unit features, (feature, dim), for each image.
        """
        return params

    def centroid_features(self, features: FeatureRows) -> Float[Array, "feature reduced"]:
        """Return what k-means clusters, given unit features; by default the features themselves."""
        return features

    def count_centroids(self, dim: int) -> int:
        """Return how many centroids `from_centroids` takes, for features of width `dim`.

        By default there is one for each local token.
        """
        return self.token_shape(dim).tokens

    @property
    def starts_from_centroids(self) -> bool:
        """Whether a vocabulary (centroids) must be built before the model is used or trained."""
        return type(self).from_centroids is not Aggregator.from_centroids

    @property
    def transports(self) -> bool:
        """Whether the aggregator implements `plan`."""
        return type(self).plan is not Aggregator.plan

    def plan(self, params: Any, features: Features) -> Float[Array, "*batch patch column"]:
        """Return the mass that an optimal transport sends from each patch to each cluster.

        A patch sends a mass of 1. A dustbin, for patches without a cluster, is the last column.
        `transports` is True for aggregators that implement this; others raise InputError.
        """
        raise InputError(
            f"aggregator: found {self.part_name}, expected one that transports, such as salad"
        )


def check_tokens(tokens: Any, aggregator: Aggregator, dim: int, batch: tuple[int, ...]) -> None:
    """Check that an aggregator has returned tokens of its `token_shape`.

    Args:
        tokens: what `apply` returned.
        aggregator: the aggregator that returned them.
        dim: width of the features.
        batch: leading axes of the tokens, () for a single image.

    Raises:
        InputError: the shapes or types do not match; the message names the aggregator.
    """
    shape = TokenShape(*aggregator.token_shape(dim))
    wide = jnp.result_type(jnp.float32, *jax.tree.leaves(tokens))
    sizes = (shape.global_dim,), (shape.tokens, shape.token_dim)
    arrays: Any = [jax.ShapeDtypeStruct((*batch, *size), wide) for size in sizes]
    if isinstance(tokens, Tokens):
        tokens = Tokens(tokens.global_token, tokens.local)
    expect_like(f"aggregator {aggregator.part_name}", tokens, Tokens(*arrays))


def require_side(name: str, grid: Grid, regions: int, patch_size: int) -> None:
    """Check that each side of a patch grid has at least `regions` patches.

    Raises:
        InputError: a side has fewer; the message is in pixels, and calls the aggregator `name`.
    """
    side = regions * patch_size
    height, width = (patch_size * each for each in grid)
    require(
        min(grid) >= regions,
        f"image size: found {height} x {width}, expected at least {side} x {side}, a patch for "
        f"every region of aggregator {name}",
    )


def regions(
    patches: Patches, grid: Grid, rows: Iterable[Cut], columns: Iterable[Cut]
) -> list[Float[Array, "*batch _ _ dim"]]:
    """Cut the patch grid into regions, in row order; `rows` and `columns` are half-open ranges."""
    columns = list(columns)
    cells = patches.reshape(*patches.shape[:-2], *grid, patches.shape[-1])
    return [
        cells[..., top:bottom, left:right, :] for top, bottom in rows for left, right in columns
    ]


def _of_function(function: Callable[..., Any]) -> Mapping[str, Any]:
    """Return the methods of an aggregator that is a plain function of one image's features."""

    def outputs(features: Features) -> Tokens:
        result = function(features)
        if isinstance(result, Tokens):
            return result
        shape = getattr(result, "shape", ())
        require(
            len(shape) in (1, 2),
            f"aggregator {function.__name__}: found to return {shape or result}, expected a "
            "vector, a matrix of token vectors, or Tokens",
        )
        make = Tokens.of_global if len(shape) == 1 else Tokens.of_local
        return make(at_least_float32(result))

    def token_shape(self: Aggregator, dim: int) -> TokenShape:
        # Use the 256 patches of 224 x 224 pixels: the shape is needed before there is an image.
        patches = jax.ShapeDtypeStruct((256, dim), "float32")
        features: Any = Features(jax.ShapeDtypeStruct((dim,), "float32"), patches)  # pyright: ignore
        tokens = jax.eval_shape(outputs, features)
        return TokenShape(tokens.global_token.shape[0], *tokens.local.shape)

    def apply(self: Aggregator, params: Any, features: Features, grid: Any, *, key: Keys) -> Tokens:
        each = outputs
        for _ in features.class_token.shape[:-1]:
            each = jax.vmap(each)
        return each(features)

    return {"token_shape": token_shape, "apply": apply}


AGGREGATORS = Registry("aggregator", Aggregator, of_function=_of_function)


def to_descriptor(tokens: Tokens, aggregator: Aggregator) -> Float[Array, "*batch descriptor"]:
    """Return unit descriptors: the global token, then the local ones by `flatten_order`."""
    local = tokens.local
    if aggregator.flatten_order == "dimension-first":
        local = local.swapaxes(-2, -1)
    flat = local.reshape(*local.shape[:-2], math.prod(local.shape[-2:]))
    return l2_normalise(jnp.concatenate([tokens.global_token, flat], axis=-1))
