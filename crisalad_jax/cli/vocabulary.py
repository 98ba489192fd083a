"""`crisalad vocabulary`."""

import dataclasses
import pathlib
from typing import Literal

import jax

from crisalad_jax.checkpoint import load_weights, save_weights
from crisalad_jax.cli.common import console, resized
from crisalad_jax.config import ModelConfig, recipe
from crisalad_jax.convert import read_backbone
from crisalad_jax.data.images import list_images
from crisalad_jax.errors import InputError
from crisalad_jax.files import check_target
from crisalad_jax.model import Crisalad, init_crisalad
from crisalad_jax.vocabulary import IMAGES, needs_vocabulary, with_vocabulary


@dataclasses.dataclass(frozen=True)
class Vocabulary:
    """Build AnyLoc's vocabulary from a folder of images: a whole model; or NetVLAD's, to train."""

    images: pathlib.Path
    """Folder, searched with its subfolders; not of images that are evaluated on."""
    out: pathlib.Path
    """A .safetensors file."""
    weights: pathlib.Path | None = None
    """A model of AnyLoc or NetVLAD, for another vocabulary."""
    backbone: pathlib.Path | None = None
    """Any checkpoint that `convert` reads, of which the backbone is taken."""
    preset: str = "b14"
    """tiny, s14, b14, l14 or g14: the size of --backbone; without one the backbone is random."""
    aggregator: Literal["anyloc", "netvlad"] | None = None
    """With --preset; by default anyloc."""
    clusters: int | None = None
    """Words; by default the preset's."""
    layer: int | None = None
    """AnyLoc's block, from 0, or from the end where negative; by default the preset's."""
    facet: Literal["query", "key", "value", "token"] | None = None
    """What of that block AnyLoc takes; by default its values."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the model's."""
    max_images: int = IMAGES
    """Read at most so many images, drawn at random."""
    batch_size: int = 16
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out."""
    seed: int = 0
    """Draws the images, patches of each, the first centroids, and a random backbone."""
    quiet: bool = False
    """No progress bar."""


def run(arguments: Vocabulary) -> None:
    """Build, write, and say what of."""
    if arguments.out.suffix != ".safetensors":
        raise InputError(
            f"{arguments.out}: found the suffix {arguments.out.suffix!r}, expected .safetensors"
        )
    check_target(arguments.out)
    params, config = _model(arguments)
    paths = list_images(arguments.images)
    params = with_vocabulary(
        params,
        config,
        paths,
        images=arguments.max_images,
        seed=arguments.seed,
        batch_size=arguments.batch_size,
        on_bad_image=arguments.on_bad_image,
        quiet=arguments.quiet,
    )
    save_weights(arguments.out, params, config)
    where = ""
    if config.aggregator == "anyloc":
        block = config.anyloc.block(config.backbone.depth)
        where = f" ({config.anyloc.facet} of block {block})"
    console.print(
        f"{arguments.out}: {config.aggregator}{where}, {config.shape.tokens} words from "
        f"{min(arguments.max_images, len(paths))} images, descriptors of "
        f"{config.descriptor_dim} numbers",
        soft_wrap=True,
    )


def _model(arguments: Vocabulary) -> tuple[Crisalad, ModelConfig]:
    given = {
        name: value
        for name in ("clusters", "layer", "facet")
        if (value := getattr(arguments, name)) is not None
    }
    if arguments.weights is not None:
        beside = {"--backbone": arguments.backbone, "--aggregator": arguments.aggregator}
        for name, found in (*beside.items(), *((f"--{n}", n) for n in given)):
            if found is not None:
                raise InputError(f"{name}: found beside --weights, expected only one of the two")
        params, config = load_weights(arguments.weights)
        if not needs_vocabulary(config):
            raise InputError(
                f"{arguments.weights}: found aggregator {config.aggregator}, expected netvlad or "
                "anyloc; --backbone takes the backbone of any model"
            )
        return params, resized(config, arguments.image_size)
    aggregator = arguments.aggregator or "anyloc"
    config = recipe(arguments.preset, aggregator).model
    alien = [name for name in given if not hasattr(config.part, name)]
    if alien:
        raise InputError(f"--{alien[0]}: found with --aggregator netvlad, expected anyloc")
    part = dataclasses.replace(config.part, **given)
    config = resized(dataclasses.replace(config, **{aggregator: part}), arguments.image_size)
    params = init_crisalad(jax.random.key(arguments.seed), config)
    if arguments.backbone is not None:
        backbone = read_backbone(arguments.backbone, config.backbone, params.backbone)
        params = dataclasses.replace(params, backbone=backbone)
    return params, config
