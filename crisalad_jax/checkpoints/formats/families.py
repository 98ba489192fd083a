"""All formats of public checkpoints, by name: formats.toml, and code for what it cannot express.

Names and shapes are those of each family's public code, and of the torch reference in `parity/`.
"""

import dataclasses
import functools
import pathlib
import tomllib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.formats.format import BackboneNames, Format, Head, parts_of
from crisalad_jax.checkpoints.formats.rows import SAME, Extra, Row, Rows, read_table, read_tables
from crisalad_jax.checkpoints.formats.sizes import Reader, State, square_side
from crisalad_jax.config.checks import choose, require
from crisalad_jax.config.io import from_plain
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.vlad import SuperVladConfig
from crisalad_jax.nn.backbones import BACKBONES
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import one_line, warn
from crisalad_jax.utils.pytree import named_leaves

VOCABULARY = "anyloc-words"
"""Name of the format of AnyLoc's vocabularies (Keetha et al., RA-L 2023): only cluster centres."""
REFERENCE = "reference"
"""Name of the format of this project's torch reference, for any model on DINOv2 or a CNN."""


def _with_squares(state: State, config: ModelConfig) -> ModelConfig:
    """Set MixVPR's image size from its number of patches, the width of the row projection."""
    name = "aggregator.row_proj.weight"
    positions = Reader(state).size(name, 1)
    otherwise = f"{name}: found {positions} positions, expected a square number"
    side = square_side(positions, otherwise) * config.backbone.patch_size
    return dataclasses.replace(config, image_size=(side, side))


def _conv_ap_filter(state: State, config: ModelConfig) -> ModelConfig:
    """Set the filter as Conv-AP's README says: bicubic only for the model of 4,096 dimensions."""
    assert isinstance(config.aggregator, ConvApConfig)
    name = "bicubic" if config.aggregator.channels == 1024 else "bilinear"
    return dataclasses.replace(config, preprocessing=PreprocessingConfig(filter=name))


def _with_ghosts(state: State, config: ModelConfig) -> ModelConfig:
    """Separate SuperVLAD's clusters from its ghost clusters, whose number shapes do not show."""
    name = "aggregation.conv.weight"
    count = Reader(state).size(name, 0)
    if count not in (3, 5):
        raise InputError(f"{name}: found {count} clusters, expected 5 (1 ghost) or 3 (2 ghosts)")
    ghosts = 1 if count == 5 else 2
    if ghosts == 2:
        warn(
            f"{name}: found 3 clusters, read as 1 and 2 ghosts, as in 1-clusterVLAD.pth; "
            "one of 2 and a ghost (--supervlad_clusters=2) has the same shape, and cannot be read"
        )
    return dataclasses.replace(config, aggregator=SuperVladConfig(count - ghosts, ghosts))


_ADJUST: dict[str, Callable[[State, ModelConfig], ModelConfig]] = {
    "conv-ap": _conv_ap_filter,
    "mixvpr": _with_squares,
    "supervlad": _with_ghosts,
}


class _Reference(Format):
    """The format of our torch reference, for any head. Our files contain their configuration."""

    def parts(self) -> dict[str, list[str]]:
        """Return the allowed parts: any, on DINOv2 or a CNN."""
        parts = {part: ["any"] for part in super().parts()}
        return parts | {"backbone": ["vit", "resnet", "vgg"]}

    def backbone_of(self, config: ModelConfig) -> BackboneNames:
        """Return the names of a DINOv2 or CNN backbone."""
        found = parts_of(config)
        names = {"vit": "dinov2", "resnet": "resnet-numbers", "vgg": "vgg-numbers"}
        sides = {"side": "dinov2-side", "side-multi-resolution": "dinov2-sides"}
        name = sides.get(found["adapter"], names[found["backbone"]])
        return _BACKBONES[name]._replace(prefix="backbone.")

    def head_of(self, config: ModelConfig) -> Head:
        """Return the names of any head: our own if no public checkpoint has others."""
        head = HEADS.get(config.aggregator.part_name)
        if head is not None and head.kind is type(config.aggregator):
            return head
        leaves = named_leaves(parameter_shapes(config))
        own = (
            name.removeprefix("aggregator.") for name in leaves if name.startswith("aggregator.")
        )
        return self.head._replace(rows=tuple(Row((name,), (name,), SAME) for name in own))

    def infer(self, state: State) -> ModelConfig:
        """Infer the configuration of a state whose head is SALAD or a class token."""
        head = self.head if super().has_head(state) else HEADS["class-token"]
        return Format.infer(dataclasses.replace(self, head=head, projection=None), state)

    def has_head(self, state: State) -> bool:
        """Return True: any head is accepted."""
        return True


TABLES: dict[str, Rows] = read_tables({}, {})
"""Tables of corresponding array names, by the name of the layer or part (see `rows.Row`)."""
_CHAINS: dict[str, PreprocessingConfig] = {}
_BACKBONES: dict[str, BackboneNames] = {}
HEADS: dict[str, Head] = {}
"""Heads by name; the reference format uses the head with the same name as the aggregator."""
FORMATS: dict[str, Format] = {}
"""Formats by name, in the order in which they are tried on a checkpoint."""


def add_formats(facts: Mapping[str, Any], source: str) -> None:
    """Register the entries of parsed TOML (chains, tables, backbones, heads, formats): all or none.

    Raises:
        InputError: a name is taken, or `facts` is invalid; the message names the file, `source`.
    """
    known = {"chains": _CHAINS, "tables": TABLES, "backbones": _BACKBONES, "heads": HEADS}
    known["formats"] = FORMATS
    for section, entries in facts.items():
        require(section in known, f"{source}: found [{section}], expected {', '.join(known)}")
        if taken := entries.keys() & known[section].keys():
            raise InputError(f"{source}: found {section}.{min(taken)}, a name that is taken")
    before = {section: dict(entries) for section, entries in known.items()}
    try:
        _add(facts, source)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        for section, entries in known.items():
            entries.clear()
            entries.update(before[section])
        words = "" if isinstance(error, InputError) else "cannot be read: "
        raise InputError(f"{source}: {words}{one_line(error)}") from error


def _add(facts: Mapping[str, Any], source: str) -> None:
    for name, fields in facts.get("chains", {}).items():
        where = f"{source} (chains.{name})"
        _CHAINS[name] = from_plain(PreprocessingConfig, fields, source=where)
    TABLES.update(read_tables(facts.get("tables", {}), TABLES))
    for name, fields in facts.get("backbones", {}).items():
        _BACKBONES[name] = BackboneNames(
            tuple(BACKBONES.find(kind) for kind in fields["kinds"]),
            read_table(fields["rows"], TABLES),
            tuple(fields["marks"]),
        )
    for name, fields in facts.get("heads", {}).items():
        HEADS[name] = Head(
            AGGREGATORS.find(fields.get("aggregator", name)),
            read_table(fields["rows"], TABLES),
            fields.get("sizes", {}),
            fields.get("mark"),
            fields.get("prefix", "aggregator."),
        )
    for name, fields in facts.get("formats", {}).items():
        FORMATS[name] = _format(name, dict(fields))


def _backbone(text: str) -> BackboneNames:
    """Parse "NAME,NAME PREFIX": the names for any of several backbones, after a prefix."""
    names, _, prefix = text.partition(" ")
    first, *others = (choose("backbone", name, _BACKBONES) for name in names.split(","))
    for other in others:
        kinds, rows = first.kinds + other.kinds, first.rows + other.rows
        first = BackboneNames(kinds, rows, first.marks + other.marks)
    return first._replace(prefix=prefix)


def _classifier(layers: Mapping[str, tuple[int, int]]) -> Rows:
    """Return the rows of torchvision's classifier; a size of 0 means the backbone's width."""

    def blank(shape: tuple[int, ...], config: ModelConfig) -> np.ndarray:
        return np.zeros([size or config.backbone.dim for size in shape], np.float32)

    return tuple(
        Row((f"classifier.{name}",), (name,), Extra(functools.partial(blank, shape)))
        for layer, (outputs, inputs) in layers.items()
        for name, shape in {
            f"{layer}.weight": (outputs, inputs),
            f"{layer}.bias": (outputs,),
        }.items()
    )


def _format(name: str, facts: dict[str, Any]) -> Format:
    chain, *size = (images := facts.pop("images", "pillow 224 224")).split()
    expected = f"images: found {images!r}, expected CHAIN HEIGHT WIDTH, as in pillow 224 224"
    require(len(size) == 2 and "".join(size).isdecimal(), expected)
    head, _, prefix = facts.pop("head").partition(" ")
    projection = facts.pop("projection", None)
    if projection is not None:
        theirs, table = projection.split()
        facts["projection"] = Row(("projection",), (theirs,), TABLES[table])
    names = choose("head", head, HEADS)
    return (_Reference if name == REFERENCE else Format)(
        name=name,
        backbone=_backbone(facts.pop("backbone")),
        head=names._replace(prefix=prefix or names.prefix),
        image_size=(int(size[0]), int(size[1])),
        preprocessing=choose("images", chain, _CHAINS),
        encoder_rows=TABLES["encoder"],
        extras=_classifier(facts.pop("extras", {})),
        adjust=_ADJUST.get(name, Format.adjust),
        **facts,
    )


_OWN = pathlib.Path(__file__).with_name("formats.toml")
add_formats(tomllib.loads(_OWN.read_text(encoding="utf-8")), _OWN.name)
