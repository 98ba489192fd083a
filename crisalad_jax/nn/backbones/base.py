"""Backbones, which turn pixels into features, and the features that an aggregator may request."""

import abc
import dataclasses
from typing import Any, ClassVar, Literal, NamedTuple

from jaxtyping import Array, Bool, Float, PRNGKeyArray

from crisalad_jax.config.checks import require
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry
from crisalad_jax.config.short_repr import brief, short_repr
from crisalad_jax.nn.layers import split_statistics


@brief
class Features(NamedTuple):
    """The features of a batch, or of one of its images."""

    class_token: Float[Array, "*batch dim"]
    """One vector for the whole image; of width 0 where the backbone has none."""
    patches: Float[Array, "*batch patch dim"]
    """One vector for each patch, in row order."""
    inserted: Float[Array, "*batch inserted dim"] | None = None
    """One vector for each of `FeatureRequest.inserted`; None without them."""
    class_attention: Float[Array, "*batch patch"] | None = None
    """Share of each patch in the class token's attention, summed over the last block's heads, in
    float32 at least; None where `FeatureRequest.class_attention` does not ask for it."""


@short_repr()
@dataclasses.dataclass(frozen=True)
class FeatureRequest:
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
    insertion: int | None = None
    """Number of blocks after which the aggregator's own tokens are put in front of all others.
    None where it has none."""
    inserted: Float[Array, "inserted dim"] | None = None
    """Those tokens, the same for every image; `Aggregator.inserted` returns them."""


@dataclasses.dataclass(frozen=True)
class Backbone(Part, abc.ABC):
    """A network from pixels to features: a frozen dataclass whose fields are its settings.

    A backbone has at least `dim`, `depth` and `patch_size`, and the two methods that are abstract.
    """

    dim: int = 768
    """Width of a feature."""
    depth: int = 12
    """Number of blocks, or levels."""
    patch_size: ClassVar[int] = 14
    """Side of a patch in pixels; sides of images are multiples of it."""
    class_token: ClassVar[bool] = True
    """Whether its features have a class token."""
    inserts: ClassVar[bool] = False
    """Whether an aggregator's own tokens can run through its blocks."""
    attends: ClassVar[bool] = False
    """Whether its features can have the class token's attention."""

    @abc.abstractmethod
    def init(self, key: PRNGKeyArray) -> Any:
        """Draw random parameters, a pytree of arrays in float32."""

    @abc.abstractmethod
    def apply(
        self,
        params: Any,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
    ) -> Features:
        """Return the features of normalised images.

        Args:
            params: of `init`, or of `split_blocks`.
            images: with sides that are multiples of `patch_size`, in the type to compute in.
            request: the features to return.
            remat: `ModelConfig.remat`.

        Raises:
            InputError: while tracing, for a request that this backbone cannot meet.
        """

    def apply_training(
        self,
        params: Any,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
        valid: Bool[Array, " image"],
    ) -> tuple[Features, Any]:
        """Return the features of a training batch, and the running statistics after it.

        A backbone with batch norms overrides it, by `layers.train_batch_norm`. By default the
        features are those of `apply`, and the statistics stay as they are.

        Args:
            params: see `apply`.
            images: see `apply`.
            request: see `apply`.
            remat: see `apply`.
            valid: which images are no padding; the statistics are taken of these.

        Returns:
            (features, statistics): a tree of the structure of `params`, which holds the running
            statistics (`layers.split_statistics`), and None for all other leaves.

        Raises:
            InputError: as `apply`.
        """
        features = self.apply(params, images, request, remat=remat)
        return features, split_statistics(params)[0]

    @property
    def extras(self) -> str:
        """Settings that one line about a model names, each after a comma; by default none."""
        return ""

    def split_blocks(self, params: Any, first: int) -> Any:
        """Return parameters whose `params.blocks` is cut in two, after the first `first` blocks.

        Training uses it so that no gradient runs through frozen blocks. `apply` accepts both forms.

        Raises:
            InputError: this backbone has no blocks to cut.
        """
        require(
            False,
            f"trainable: found backbone {self.part_name}, which cannot be cut into blocks, "
            "expected head or all",
        )

    def join_blocks(self, params: Any) -> Any:
        """Undo `split_blocks`."""
        return params

    def adopt(self, config: Any, params: Any, fresh: Any) -> tuple[Any, Any]:
        """Return another's configuration and parameters, changed as far as this one can do with.

        Args:
            config: another backbone of this class.
            params: its parameters.
            fresh: parameters of this backbone, for what the other's lack.
        """
        del fresh
        return config, params

    def grid(self, image_size: tuple[int, int]) -> tuple[int, int]:
        """Return the rows and columns of patches in an image of this height and width.

        Raises:
            InputError: a side is no multiple of `patch_size`.
        """
        height, width = image_size
        size = self.patch_size
        require(
            height > 0 and width > 0 and height % size == 0 and width % size == 0,
            f"image size: found {height} x {width}, expected sides that are multiples of {size} "
            f"(nearest: {_nearest(height, size)} x {_nearest(width, size)})",
        )
        return height // size, width // size


class BackboneWithStatistics(Backbone):
    """A backbone with batch norms, whose one method `run` serves inference and training."""

    @abc.abstractmethod
    def run(
        self,
        params: Any,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
        valid: Bool[Array, " image"] | None,
    ) -> tuple[Features, Any]:
        """Return the features, and parameters with updated running statistics.

        The arguments are those of `apply_training`; `valid` None takes the stored statistics, which
        stay.

        Raises:
            InputError: as `apply`.
        """

    def apply(
        self,
        params: Any,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
    ) -> Features:
        """Return the features of normalised images, by the stored statistics."""
        return self.run(params, images, request, remat=remat, valid=None)[0]

    def apply_training(
        self,
        params: Any,
        images: Float[Array, "image height width 3"],
        request: FeatureRequest,
        *,
        remat: str,
        valid: Bool[Array, " image"],
    ) -> tuple[Features, Any]:
        """Return the features of a training batch, and the running statistics after it."""
        features, updated = self.run(params, images, request, remat=remat, valid=valid)
        return features, split_statistics(updated)[0]


def _nearest(side: int, size: int) -> int:
    return max(size, round(side / size) * size)


BACKBONES = Registry("backbone", Backbone)
