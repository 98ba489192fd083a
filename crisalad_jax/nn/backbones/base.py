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
"""Normalised images."""
TokenBatch = Float[Array, "image token dim"]
"""Tokens of a transformer: the class token first, and the patches last."""
Patches = Float[Array, "*batch patch dim"]
"""Features of patches, in row order."""


@brief
class Features(NamedTuple):
    """The features of a batch, or of one of its images."""

    class_token: Float[Array, "*batch dim"]
    """One vector for the whole image; of width 0 where the backbone has none."""
    patches: Patches
    """One vector for each patch, in row order."""
    inserted: Float[Array, "*batch inserted dim"] | None = None
    """One vector for each of `FeatureSpec.inserted`; None without them."""
    class_attention: Float[Array, "*batch patch"] | None = None
    """Share of each patch in the class token's attention, summed over the last block's heads, in
    float32 at least; None where `FeatureSpec.class_attention` does not ask for it."""


@short_repr()
@dataclasses.dataclass(frozen=True)
class FeatureSpec:
    """The features that an aggregator requests; by default those after the last layer."""

    levels: tuple[int, ...] | None = None
    """Numbers of blocks, from 1, after which patches are taken and concatenated. Several must
    include the last block. None takes the last alone."""
    facet: Literal["token", "query", "key", "value"] = "token"
    """Facet of the level's last block: its output tokens, or queries, keys or values of its
    attention, with the heads side by side."""
    norm: bool = True
    """Whether tokens go through the last layer norm."""
    class_token: bool = False
    """Whether the class token is used, which not every backbone has."""
    class_attention: bool = False
    """Whether the class token's attention in the last block is used."""
    path: int = 0
    """Number of the adapters' side path, from 0, whose tokens are the features."""
    insertion: int | None = None
    """Number of blocks after which the aggregator's own tokens are put in front of all others.
    None where it has none."""
    inserted: Float[Array, "inserted dim"] | None = None
    """Those tokens, the same for every image; `Aggregator.inserted` returns them."""

    def levels_of(self, depth: int) -> tuple[int, ...]:
        """Return the levels in a backbone of so many blocks.

        Raises:
            InputError: they are not in order, more than there are blocks, or several of a facet.
        """
        levels = (depth,) if self.levels is None else self.levels
        in_order = list(levels) == sorted(set(levels)) and 0 < levels[0] <= levels[-1] <= depth
        require(
            in_order and (self.facet == "token" or len(levels) == 1),
            f"levels: found {levels} of facet {self.facet}, expected numbers of blocks in order, 1 "
            f"to {depth}, and one alone of a facet of attention",
        )
        return levels


@dataclasses.dataclass(frozen=True)
class Backbone(Part, abc.ABC):
    """A network from pixels to features: a frozen dataclass whose fields are its settings.

    A backbone has at least `dim`, `depth` and `patch_size`, and the two methods that are abstract.
    """

    dim: PositiveInt = 768
    """Width of a feature."""
    depth: PositiveInt = 12
    """Number of blocks, or levels."""
    patch_size: ClassVar[int] = 14
    """Side of a patch in pixels; sides of images are multiples of it."""
    any_size: ClassVar[bool] = False
    """Whether sides of images may be of any length."""
    class_token: ClassVar[bool] = True
    """Whether its features have a class token."""
    supports_prompt_tokens: ClassVar[bool] = False
    """Whether an aggregator's own tokens can run through its blocks."""
    exposes_cls_attention: ClassVar[bool] = False
    """Whether its features can have the class token's attention, or facets of attention."""
    exposes_levels: ClassVar[bool] = True
    """Whether its features can be those after other blocks than the last."""
    local_features: ClassVar[str | None] = None
    """Features that photographs become on the host, in place of pixels: "sift" or "orb"."""
    binary: ClassVar[bool] = False
    """Whether the numbers of its features have two values, as those of visual words then have."""
    encoded_size: ClassVar[tuple[int, int] | None] = None
    """Height and width of the bytes of `local_features`; None where it takes pixels."""
    side_paths: ClassVar[int] = 1
    """Number of side paths of its adapters; 1 where there are none."""
    extras: ClassVar[str] = ""
    """Settings that one line about a model names, each after a comma."""
    trains: ClassVar[tuple[str, ...]] = ()
    """Names, or patterns of names, of parameters that are there to be trained.

    They are those of adapters, in the names of `init`, such as "blocks.*.adapter" or "lora". A run
    that trains none of them is refused, unless it says so (`--trainable head,-adapters`)."""

    @abc.abstractmethod
    def init(self, key: PRNGKeyArray) -> Any:
        """Draw random parameters, a pytree of arrays in float32."""

    @abc.abstractmethod
    def apply(
        self, params: Any, images: Pixels, request: FeatureSpec, *, remat: str, valid: Valid
    ) -> tuple[Features, Any]:
        """Return the features of normalised images, and the parameters.

        Args:
            params: of `init`, or of `split_blocks`.
            images: with sides that are multiples of `patch_size`, in the type to compute in.
            request: the features to return.
            remat: `ModelConfig.remat`.
            valid: images of a training batch, whose statistics batch norms normalise by
                (`layers.train_batch_norm`). None takes the stored ones, which stay.

        Returns:
            (features, updated): the parameters with updated running statistics, if there are any.
            In the place of all other leaves there may be None.

        Raises:
            InputError: while tracing, for a request that this backbone cannot meet.
        """

    def split_blocks(self, params: Any, cuts: Sequence[int]) -> Any:
        """Return parameters whose stack `params.blocks` is cut before the blocks of these numbers.

        It is needed where leaves of `params.blocks` have a leading axis of `depth` blocks: training
        cuts it so that some blocks train and no gradient runs through frozen ones before them. The
        parts are a tuple, and `apply` accepts both forms.

        Raises:
            InputError: this backbone has no blocks to cut.
        """
        raise InputError(
            f"trainable: found a part of the blocks of backbone {self.part_name}, which cannot be "
            "cut, expected the same parameters of each block"
        )

    def join_blocks(self, params: Any) -> Any:
        """Undo `split_blocks`."""
        return params

    def merge_adapters(self, params: Any) -> tuple[Any, Any]:
        """Return (backbone, params) without adapters that compute the same; see `merge_adapters`.

        Raises:
            InputError: this backbone has no adapters, or they cannot be merged.
        """
        raise InputError(
            f"merge_adapters: found backbone {self.part_name}, expected one with adapters, as vit"
        )

    def adapt_checkpoint(self, config: Any, params: Any, fresh: Any) -> tuple[Any, Any]:
        """Return another's configuration and parameters, changed as far as this one can do with.

        Args:
            config: another backbone of this class.
            params: its parameters.
            fresh: parameters of this backbone, for what the other's lack.
        """
        return config, params

    def grid(self, image_size: tuple[int, int]) -> Grid:
        """Return the rows and columns of patches in an image of this height and width.

        Raises:
            InputError: a side is no multiple of `patch_size`.
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
