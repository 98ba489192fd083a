"""Formats of public checkpoints: what their files call a model's parts, and how it is inferred."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from crisalad_jax.checkpoints.formats.forms import (
    LINEAR,
    SAME,
    Entry,
    Form,
    Lines,
    transformer_layer,
)
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators import Aggregator
from crisalad_jax.nn.backbones.base import Backbone
from crisalad_jax.nn.backbones.vit import VisionTransformer
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.errors import InputError

State = Mapping[str, np.ndarray]
Stored = Literal["torch", "safetensors"]
_ENCODER_HEADS = 16
"""Number of heads of the published encoder, which no shape shows."""


class Reader(NamedTuple):
    """A reader of the shapes of a state under a prefix, with one error for a missing name."""

    state: State
    prefix: str = ""

    def size(self, name: str, axis: int) -> int:
        """Return the size of an axis.

        Raises:
            InputError: there is no such name, or it has no such axis.
        """
        name = self.prefix + name
        if name not in self.state:
            raise InputError(f"found no {name}, expected it among the others")
        shape = self.state[name].shape
        if len(shape) <= axis or not shape[axis]:
            raise InputError(
                f"{name} found of shape {shape}, expected more than {axis} axes, none of them empty"
            )
        return shape[axis]

    def has(self, name: str) -> bool:
        """Return whether there is an array of this name."""
        return self.prefix + name in self.state

    def count(self, name: str) -> int:
        """Count the consecutive numbers from 0 that follow a name."""
        heads = {key[: key.find(".", len(self.prefix + name))] for key in self.state}
        return next(i for i in range(len(heads) + 1) if f"{self.prefix}{name}{i}" not in heads)


class BackboneNames(Protocol):
    """How files name a backbone's parameters."""

    @property
    def kinds(self) -> tuple[type[Backbone], ...]:
        """Classes of the backbones."""
        ...

    @property
    def marks(self) -> tuple[str, ...]:
        """Names of which any file with such a backbone has at least one."""
        ...

    def lines(self, config: Any) -> Lines:
        """Yield the table, in the public order."""
        ...

    def infer(self, state: State) -> Backbone:
        """Make the configuration from names and shapes."""
        ...


class Head(NamedTuple):
    """How files name an aggregator's parameters."""

    aggregator: str
    lines: Callable[[Any, str], Lines]
    """Function of the configuration and a prefix that yields the table, in the public order."""
    infer: Callable[[Reader], Aggregator]
    """Function that makes the configuration from names and shapes."""
    mark: str | None
    """A name after the prefix that any file with such a head has; None if it has no parameters."""
    prefix: str = "aggregator."
    """What their names begin with, unless the format says otherwise."""


class Images(NamedTuple):
    """How the models of a family take images."""

    size: tuple[int, int] = (224, 224)
    """Height and width in pixels that they are evaluated at."""
    preprocessing: PreprocessingConfig = PreprocessingConfig()


@dataclasses.dataclass(frozen=True)
class Format:
    """The names of a model's parts in the checkpoints of one family."""

    name: str
    holds: str
    """Description of the files."""
    backbone: BackboneNames
    head: Head
    images: Images = Images()  # noqa: RUF009
    _: dataclasses.KW_ONLY
    prefix: str | None = None
    """What the head's names begin with; None is as in other files."""
    first: int = 0
    """Number of the head's lines that are before the backbone's."""
    adapter: str | None = "none"
    """Kind of the adapters; None is any."""
    encoder: bool | None = False
    """Whether there is a cross-image encoder; None where the file tells."""
    projection: tuple[str, str] | None = None
    """Their names of the projection's weight and bias, with {dim} for its width; None without
    one."""
    projection_form: Form = LINEAR
    extras: Callable[[ModelConfig], Lines] = lambda config: iter(())
    """Function that yields what their files have and no descriptor needs."""
    adjust: Callable[[State, ModelConfig], ModelConfig] = lambda state, config: config
    """Function that sets what else a state tells of its model."""
    module: str = ""
    """Prefix of all names, as torch's DataParallel adds it."""
    under: str | None = None
    """Key of the file's dictionary that holds the state; None: the file is the state."""
    stored: Stored = "torch"
    """Kind of file."""
    bare: bool = False
    """Whether a file is one tensor by itself, which is a part of a model."""

    def accepts(self, config: ModelConfig) -> bool:
        """Return whether a model has exactly the family's parts."""
        return (
            isinstance(config.backbone, self.backbone.kinds)
            and config.aggregator.part_name == self.head.aggregator
            and self.adapter in (None, adapter_of(config.backbone))
            and self.encoder in (None, bool(config.cross_image.layers))
            and bool(config.projection.dim) == (self.projection is not None)
        )

    def expected(self) -> str:
        """Name the parts of a model that it accepts."""
        backbone = " or ".join(kind.part_name for kind in self.backbone.kinds)
        adapter = self.adapter or "any"
        has_projection = self.projection is not None
        return _words(self.head.aggregator, backbone, adapter, self.encoder, has_projection)

    @property
    def _head_prefix(self) -> str:
        return self.head.prefix if self.prefix is None else self.prefix

    def lines(self, config: ModelConfig) -> Lines:
        """Yield the table of a model that it accepts, in the public order."""
        head = list(self.head.lines(config.aggregator, self._head_prefix))
        yield from head[: self.first]
        yield from self.backbone.lines(config.backbone)
        yield from self.extras(config)
        yield from head[self.first :]
        yield from encoder_lines(config.cross_image)
        if self.projection is not None:
            weight, bias = (name.format(dim=config.projection.dim) for name in self.projection)
            yield Entry(("projection.weight",), (weight,), self.projection_form)
            yield Entry(("projection.bias",), (bias,), SAME)

    def has_backbone(self, state: State) -> bool:
        """Return whether a state has the family's backbone, with or without a head."""
        return any(mark in state for mark in self.backbone.marks)

    def has_head(self, state: State) -> bool:
        """Return whether a state has the family's head; one without parameters is in any."""
        return self.head.mark is None or self._head_prefix + self.head.mark in state

    def detects(self, state: State) -> bool:
        """Return whether a state's names are of this family."""
        return self.has_backbone(state) and self.has_head(state)

    def infer(self, state: State) -> ModelConfig:
        """Make the configuration of a state that it detects, from names and shapes."""
        config = ModelConfig(
            image_size=self.images.size,
            preprocessing=self.images.preprocessing,
            backbone=self.backbone.infer(state),
            aggregator=self.head.infer(Reader(state, self._head_prefix)),
            cross_image=no_encoder() if self.encoder is False else infer_encoder(state),
            projection=ProjectionConfig(dim=self._projection_dim(state)),
        )
        return self.adjust(state, config)

    def _projection_dim(self, state: State) -> int:
        if self.projection is None:
            return 0
        bias = self.projection[1]
        start, _, end = bias.partition("{dim}")
        fits = (name for name in state if name.startswith(start) and name.endswith(end))
        return Reader(state).size(next(fits, bias), 0)


def adapter_of(backbone: Backbone) -> str:
    """Return the kind of a backbone's adapters."""
    return backbone.adapter.kind if isinstance(backbone, VisionTransformer) else "none"


def parts_in_words(config: ModelConfig) -> str:
    """Name a model's parts."""
    return _words(
        config.aggregator.part_name,
        config.backbone.part_name,
        adapter_of(config.backbone),
        bool(config.cross_image.layers),
        bool(config.projection.dim),
    )


def _words(
    aggregator: str, backbone: str, adapter: str, encoder: bool | None, projection: bool
) -> str:
    across = {True: "an encoder", False: "no encoder", None: "an encoder or none"}[encoder]
    words = f"aggregator {aggregator}, backbone {backbone}, adapter {adapter}, {across}"
    return words + ", a projection" * projection


def no_encoder() -> CrossImageConfig:
    """Return the configuration of a model without a cross-image encoder."""
    return CrossImageConfig(layers=0)


def encoder_lines(config: CrossImageConfig) -> Lines:
    """Yield the cross-image encoder, under torch.nn.TransformerEncoder's names."""
    for i in range(config.layers):
        yield from transformer_layer(f"cross_image.layers.{i}", f"encoder.layers.{i}")


def infer_encoder(state: State) -> CrossImageConfig:
    """Infer the encoder's sizes; the number of heads is the published one."""
    read = Reader(state)
    layers = read.count("encoder.layers.")
    if not layers:
        return CrossImageConfig(layers=0, heads=_ENCODER_HEADS)
    feedforward = read.size("encoder.layers.0.linear1.weight", 0)
    return CrossImageConfig(layers, _ENCODER_HEADS, feedforward)
