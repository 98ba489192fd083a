"""A format of public checkpoints: its names for a model's arrays, and how to infer the model."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

from crisalad_jax.checkpoints.formats.rows import Row, Rows, expand
from crisalad_jax.checkpoints.formats.sizes import Reader, State, infer_backbone, infer_encoder
from crisalad_jax.config.checks import require
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators import Aggregator
from crisalad_jax.nn.backbones.base import Backbone
from crisalad_jax.nn.backbones.vit import VisionTransformer
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.projection import ProjectionConfig


class BackboneNames(NamedTuple):
    """How files name a backbone's parameters."""

    kinds: tuple[type[Backbone], ...]
    """Classes of the backbones; empty if the backbone, of any class, is in another file."""
    rows: Rows
    """Table of corresponding names; the files' omit `prefix`, this package's omit `backbone.`."""
    marks: tuple[str, ...]
    """Names, without `prefix`; every file with such a backbone has at least one of them."""
    prefix: str = ""


class Head(NamedTuple):
    """How files name an aggregator's parameters."""

    kind: type[Aggregator]
    rows: Rows
    """Table of corresponding names; the files' omit `prefix`, this package's omit `aggregator.`."""
    sizes: Mapping[str, str]
    """For each field of the aggregator's configuration to read, the argument of `Reader.read`."""
    mark: str | None
    """A name, without `prefix`, in every file with such a head; None for a head without arrays."""
    prefix: str

    def infer(self, state: State) -> Aggregator:
        """Infer the aggregator's configuration from the names and shapes in a checkpoint."""
        read = Reader(state, self.prefix)
        return self.kind(**{field: read.read(where) for field, where in self.sizes.items()})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Format:
    """How the checkpoints of one model family name and order the arrays of a model."""

    name: str
    holds: str
    """Description of the files, for messages and lists."""
    backbone: BackboneNames
    head: Head
    image_size: tuple[int, int]
    """Height and width in pixels of the images that the family is evaluated on."""
    preprocessing: PreprocessingConfig
    encoder_rows: Rows
    projection: Row | None = None
    """Row of the projection layer, with {dim} for its width; None if there is no such layer."""
    head_first: int = 0
    """How many of the head's rows come before those of the backbone in a file."""
    encoder_first: bool = False
    """Whether the cross-image encoder comes before the head in a file."""
    adapter: str = "none"
    """Name of the adapter; "any" allows all."""
    encoder: str = "none"
    """Name of the cross-image encoder; "any" allows all, and "none,NAME" means that the arrays show
    whether there is one."""
    extras: Rows = ()
    """Rows of arrays that the files have but no descriptor needs."""
    settings: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """Values of configuration fields that shapes do not show, by part and field."""
    adjust: Callable[[State, ModelConfig], ModelConfig] = lambda state, config: config
    """Function of a file's arrays and the inferred configuration that returns the final one."""
    inside: str = ""
    """Where a file holds its arrays: KEY of its dictionary, or KEY/PREFIX if all names have a
    prefix, as torch's DataParallel adds it; empty if the file is the dictionary of arrays."""
    stored: Literal["torch", "safetensors"] = "torch"
    """Type of the file."""
    bare: bool = False
    """Whether a file is a single tensor, which is only a part of a model."""

    def parts(self) -> dict[str, list[str]]:
        """Return the names that are allowed for each part of a model; "any" allows all."""
        return {
            "aggregator": [self.head.kind.part_name],
            "backbone": [kind.part_name for kind in self.backbone.kinds] or ["any"],
            "adapter": [self.adapter],
            "encoder": self.encoder.split(","),
            "projection": ["no" if self.projection is None else "yes"],
        }

    def check_parts(self, config: ModelConfig) -> None:
        """Check that a model has exactly the parts of this format's model family.

        Raises:
            InputError: a part differs.
        """
        allowed = self.parts()
        for part, found in parts_of(config).items():
            require(
                found in allowed[part] or "any" in allowed[part],
                f"format {self.name}: found a model of {part} {found}, expected "
                f"{' or '.join(allowed[part])} (format reference holds any)",
            )

    def lines(self, config: ModelConfig, names: Iterable[str]) -> Iterator[Row]:
        """Yield the rows of a model whose arrays have these `names`, in the order of the files."""
        names, backbone, head = list(names), self.backbone_of(config), self.head_of(config)
        before, after = head.rows[: self.head_first], head.rows[self.head_first :]
        yield from expand(before, names, "aggregator.", head.prefix)
        yield from expand(backbone.rows, names, "backbone.", backbone.prefix)
        yield from expand(self.extras, names)
        parts = [(after, "aggregator.", head.prefix), (self.encoder_rows, "", "")]
        for rows, ours, theirs in parts[::-1] if self.encoder_first else parts:
            yield from expand(rows, names, ours, theirs)
        if self.projection is not None:
            theirs = self.projection.theirs[0].format(dim=config.projection.dim)
            yield from expand((self.projection._replace(theirs=(theirs,)),), names)

    def backbone_of(self, config: ModelConfig) -> BackboneNames:
        """Return how the files name the backbone of a model with this configuration."""
        return self.backbone

    def head_of(self, config: ModelConfig) -> Head:
        """Return how the files name the aggregator of a model with this configuration."""
        return self.head

    def has_backbone(self, state: State) -> bool:
        """Return whether `state`, a file's arrays by name, includes this format's backbone."""
        return any(self.backbone.prefix + mark in state for mark in self.backbone.marks)

    def has_head(self, state: State) -> bool:
        """Return whether `state` has this format's head; True if that head has no parameters."""
        return self.head.mark is None or self.head.prefix + self.head.mark in state

    def infer(self, state: State) -> ModelConfig:
        """Infer a model's configuration from the names and shapes of its arrays in a file."""
        backbone = self.backbone
        config = ModelConfig(
            image_size=self.image_size,
            preprocessing=self.preprocessing,
            backbone=infer_backbone(backbone.kinds, backbone.rows, Reader(state, backbone.prefix)),
            aggregator=self.head.infer(state),
            cross_image="none" if self.encoder == "none" else infer_encoder(state, self.encoder),
            projection=ProjectionConfig(dim=self._projection_dim(state)),
        )
        parts = {
            part: dataclasses.replace(getattr(config, part), **fields)
            for part, fields in self.settings.items()
        }
        return self.adjust(state, dataclasses.replace(config, **parts))

    def _projection_dim(self, state: State) -> int:
        if self.projection is None:
            return 0
        bias = f"{self.projection.theirs[0]}.bias"
        start, _, end = bias.partition("{dim}")
        fits = (name for name in state if name.startswith(start) and name.endswith(end))
        return Reader(state).size(next(fits, bias), 0)


def parts_of(config: ModelConfig) -> dict[str, str]:
    """Return the name of each part of a model, with the same keys as `Format.parts`."""
    backbone = config.backbone
    return {
        "aggregator": config.aggregator.part_name,
        "backbone": backbone.part_name,
        "adapter": backbone.adapter.part_name
        if isinstance(backbone, VisionTransformer)
        else "none",
        "encoder": config.cross_image.part_name,
        "projection": "yes" if config.projection.dim else "no",
    }
