"""Backbones, which turn pixels into features, and the features that an aggregator may request."""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray

from crisalad_jax.config.checks import PositiveInt, require
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry
from crisalad_jax.config.short_repr import brief, short_repr
from crisalad_jax.nn.layers import Grid, Valid
from crisalad_jax.utils.errors import InputError

Pixels = Float[Array, "image height width 3"]
"""Normalised images, channels last."""
TokenBatch = Float[Array, "image token dim"]
"""Tokens of a transformer: the class token first, and the patches last."""
Patches = Float[Array, "*batch patch dim"]
"""Features of patches, in row order."""


@brief
class Features(NamedTuple):
    """The features of a batch, or of one of its images."""

    class_token: Float[Array, "*batch dim"]
    """One vector for the whole image, of width 0 if the backbone has none."""
    patches: Patches
    """One vector for each patch, in row order."""
    inserted: Float[Array, "*batch inserted dim"] | None = None
    """One output vector for each token of `FeatureSpec.inserted`; None without such tokens."""
    class_attention: Float[Array, "*batch patch"] | None = None
    """Attention of the class token to each patch, summed over the heads of the last block, in at
    least float32; None unless `FeatureSpec.class_attention` requests it."""


@short_repr()
@dataclasses.dataclass(frozen=True)
class FeatureSpec:
    """The features that an aggregator requests; by default those after the last block."""

    levels: tuple[int, ...] | None = None
    """Blocks, counted from 1 in ascending order, whose output patches are concatenated. None takes
    only the last."""
    facet: Literal["token", "query", "key", "value"] = "token"
    """What to take from the block: its output tokens, or the queries, keys or values of its
    attention, with the heads concatenated."""
    norm: bool = True
    """Whether the backbone's last layer norm is applied to the features."""
    class_token: bool = False
    """Whether the class token is used. Not every backbone has one."""
    class_attention: bool = False
    """Whether the class token's attention in the last block is used."""
    path: int = 0
    """Index of the adapters' side path whose tokens are the features; 0 if there is only one."""
    insertion: int | None = None
    """Number of blocks after which the aggregator's own tokens are prepended to all others. None
    if the aggregator has no tokens of its own."""
    inserted: Float[Array, "inserted dim"] | None = None
    """The aggregator's own tokens, the same for every image, from `Aggregator.inserted`."""

    def levels_of(self, depth: int) -> tuple[int, ...]:
        """Return the requested levels as block numbers, for a backbone of `depth` blocks.

        Raises:
            InputError: levels are out of order or above `depth`, or an attention facet has several.
        """
        levels = (depth,) if self.levels is None else self.levels
        in_order = list(levels) == sorted(set(levels)) and 0 < levels[0] <= levels[-1] <= depth
        require(
            in_order and (self.facet == "token" or len(levels) == 1),
            f"levels: found {levels} of facet {self.facet}, expected numbers of blocks in order, 1 "
            f"to {depth}, and only one for a facet of attention",
        )
        return levels


@dataclasses.dataclass(frozen=True)
class Backbone(Part, abc.ABC):
    """A network that turns pixels into features: a frozen dataclass whose fields are its settings.

    A subclass has at least `dim`, `depth` and `patch_size`, and implements `init` and `apply`.
    """

    dim: PositiveInt = 768
    """Width of a feature."""
    depth: PositiveInt = 12
    """Number of blocks, or levels."""
    patch_size: ClassVar[int] = 14
    """Side of a patch in pixels; the sides of images are multiples of it."""
    any_size: ClassVar[bool] = False
    """Whether images may have any size."""
    class_token: ClassVar[bool] = True
    """Whether its features include a class token."""
    supports_prompt_tokens: ClassVar[bool] = False
    """Whether an aggregator's own tokens can run through its blocks."""
    exposes_cls_attention: ClassVar[bool] = False
    """Whether its features can include the class token's attention, or facets of attention."""
    exposes_levels: ClassVar[bool] = True
    """Whether features can be taken after blocks other than the last."""
    local_features: ClassVar[str | None] = None
    """Features that the host extracts to replace pixels, "sift" or "orb"; None for pixels."""
    binary: ClassVar[bool] = False
    """Whether its features, and so their visual words, take only two values."""
    encoded_size: ClassVar[tuple[int, int] | None] = None
    """Height and width of the byte array of `local_features`; None if the input is pixels."""
    side_paths: ClassVar[int] = 1
    """Number of side paths of its adapters; 1 if there are none."""
    extras: ClassVar[str] = ""
    """Settings to append to a one-line summary of a model, each preceded by a comma."""
    trains: ClassVar[tuple[str, ...]] = ()
    """Names, or name patterns, of the parameters that are meant to be trained; by default none.

    They are those of adapters, named as in `init`, such as "blocks.*.adapter" or "lora". A run that
    trains none of them must exclude them by name (`--trainable head,-adapters`)."""

    @abc.abstractmethod
    def init(self, key: PRNGKeyArray) -> Any:
        """Draw random parameters, a pytree of float32 arrays."""

    @abc.abstractmethod
    def apply(
        self, params: Any, images: Pixels, request: FeatureSpec, *, remat: str, valid: Valid
    ) -> tuple[Features, Any]:
        """Return the features of normalised images, and the parameters.

        Args:
            params: parameters from `init` or `split_blocks`.
            images: images whose sides are multiples of `patch_size`, in the type to compute in.
            request: the features to return.
            remat: see `ModelConfig.remat`.
            valid: mask of the training images whose statistics the batch norms use
                (`layers.train_batch_norm`). None uses the stored ones, without updating them.

        Returns:
            (features, updated): the second is the parameters, with any running statistics updated.
            All other leaves may be None.

        Raises:
            InputError: during tracing, if the backbone cannot meet the request.
        """

    def split_blocks(self, params: Any, cuts: Sequence[int]) -> Any:
        """Return parameters with the stack `params.blocks` cut before the blocks of these indices.

        Implement this if leaves of `params.blocks` have a leading axis of `depth` blocks. Training
        cuts the stack so that some blocks train and no gradient passes through frozen ones before
        them. The parts form a tuple; `apply` accepts a stack or such a tuple.

        Raises:
            InputError: the backbone has no blocks to cut.
        """
        raise InputError(
            f"trainable: found a part of the blocks of backbone {self.part_name}, which cannot be "
            "cut, expected the same parameters of each block"
        )

    def join_blocks(self, params: Any) -> Any:
        """Undo `split_blocks`."""
        return params

    def merge_adapters(self, params: Any) -> tuple[Any, Any]:
        """Return an equivalent (backbone, params) without adapters; see `nn.model.merge_adapters`.

        Raises:
            InputError: the backbone has no adapters, or they cannot be merged.
        """
        raise InputError(
            f"merge_adapters: found backbone {self.part_name}, expected one such as vit"
        )

    def adapt_checkpoint(self, config: Any, params: Any, fresh: Any) -> tuple[Any, Any]:
        """Return another backbone's configuration and parameters, adapted to this one if possible.

        Args:
            config: another backbone of this class.
            params: parameters of that backbone.
            fresh: new parameters of this backbone, to use where the other's do not fit.
        """
        return config, params

    def grid(self, image_size: tuple[int, int]) -> Grid:
        """Return the rows and columns of patches in an image of this height and width.

        Raises:
            InputError: a side is not a multiple of `patch_size`.
        """
        height, width = image_size
        size = self.patch_size
        nearest = [max(size, round(side / size) * size) for side in image_size]
        require(
            height > 0 and width > 0 and height % size == 0 and width % size == 0,
            f"image size: found {height} x {width}, expected sides that are multiples of {size} "
            f"(nearest: {nearest[0]} x {nearest[1]})",
        )
        return height // size, width // size


BACKBONES = Registry("backbone", Backbone)
