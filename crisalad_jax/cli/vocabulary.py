"""`crisalad vocabulary`."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.common import find_given, give_json, prepare_json, say
from crisalad_jax.nn.model import Model
from crisalad_jax.training.vocabulary import (
    IMAGES,
    build_vocabulary,
    start_vocabulary,
    vocabulary_words,
)
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_target

COMMON = (
    "images",
    "out",
    "weights",
    "backbone",
    "preset",
    "aggregator",
    "clusters",
    "image-size",
    "max-images",
    "batch-size",
    "on-bad-image",
    "seed",
    "json",
    "quiet",
)
EXAMPLE = (
    "crisalad vocabulary --images photos --backbone dinov2-vitg14 --preset "
    "g14 --out anyloc.safetensors"
)
SEVERAL = "quote a pattern, or list the images in a .txt"
"""What to do in place of several values of --images."""


@dataclasses.dataclass(frozen=True)
class Vocabulary:
    """Build AnyLoc's vocabulary from a folder of images: a whole model; or NetVLAD's, to train."""

    images: pathlib.Path
    """Folder, searched with its subfolders; or a file, a pattern, a list, a table or a video
    (docs/how-to/image-sources.md). Not of images that are evaluated on."""
    out: pathlib.Path
    """A .safetensors file."""
    fps: float | None = None
    """Frames a second taken of a video, by default 1."""
    weights: pathlib.Path | None = None
    """A model of AnyLoc, NetVLAD or a part of yours with a vocabulary, for another one; a file, or
    a published model's name."""
    backbone: pathlib.Path | None = None
    """Any checkpoint that `convert` reads, or a published model's name, as in dinov2-vitg14: the
    backbone is taken."""
    preset: str | None = None
    """tiny, s14, b14 (the default), l14 or g14: the size of --backbone; without one the backbone is
    random."""
    aggregator: str | None = None
    """With --preset: anyloc (the default), or another that starts from centroids, such as netvlad
    or a part of yours."""
    clusters: int | None = None
    """Words, where the aggregator has such a setting; by default the preset's."""
    layer: int | None = None
    """AnyLoc's block, from 0, or from the end where negative; by default the preset's."""
    facet: str | None = None
    """What of that block AnyLoc takes: query, key, value or token; by default its values."""
    assignment: str | None = None
    """What AnyLoc's nearest word of a patch is nearest by: cosine (as published) or euclidean."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; by default the model's."""
    resize: tuple[str, ...] = ()
    """Words in place of the model's way: fixed, shorter-side, longer-side or native; bilinear,
    bicubic or area; antialias or no-antialias; bytes or floats; round;
    high-byte or contrast-stretch, for 16 bits and floats (docs/resizing.md)."""
    max_images: int = IMAGES
    """Read at most so many images, drawn at random."""
    batch_size: int = 16
    """Images described together."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out."""
    seed: int = 0
    """Draws the images, patches of each, the first centroids, and a random backbone."""
    max_pixels: int = 2**28
    """Pixels that an image file may have; larger ones are not decoded."""
    json: pathlib.Path | None = None
    """File for the result as JSON; - prints it."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""
    quiet: bool = False
    """No progress bar."""


def run(arguments: Vocabulary) -> None:
    """Build the vocabulary, write the model, and print its size."""
    prepare_json(arguments.json)
    check_target(arguments.out, ".safetensors")
    model = _model(arguments)
    config = model.config
    built = build_vocabulary(
        model,
        arguments.images,
        arguments.out,
        fps=arguments.fps,
        max_images=arguments.max_images,
        seed=arguments.seed,
        batch_size=arguments.batch_size,
        on_bad_image=arguments.on_bad_image,
        quiet=arguments.quiet,
    )
    say(
        f"{arguments.out}: {vocabulary_words(config)}, {built.words} words from {built.images} "
        f"images at {config.images_in_words}, descriptors of {config.descriptor_dim} numbers"
    )
    give_json(
        arguments.json,
        {
            "out": str(arguments.out),
            "vocabulary": vocabulary_words(config),
            "words": built.words,
            "images": built.images,
            "length": config.descriptor_dim,
            "resized": config.images_in_words,
        },
    )


def _model(arguments: Vocabulary) -> Model:
    fields = {
        name: value
        for name in ("clusters", "layer", "facet", "assignment")
        if (value := getattr(arguments, name)) is not None
    }
    if arguments.weights is None:
        return start_vocabulary(
            arguments.aggregator or "anyloc",
            arguments.preset or "b14",
            backbone=find_given(arguments.backbone, quiet=arguments.quiet),
            fields=fields,
            image_size=arguments.image_size,
            resize=arguments.resize,
            seed=arguments.seed,
        )
    for name in ("backbone", "preset", "aggregator", *fields):
        if getattr(arguments, name) is not None:
            raise InputError(f"--{name}: found beside --weights, expected only one of the two")
    params, config = load_weights(find_weights(arguments.weights, quiet=arguments.quiet))
    return Model(params, config.resized(arguments.image_size, arguments.resize))
