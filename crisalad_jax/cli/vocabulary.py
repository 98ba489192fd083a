"""`crisalad vocabulary`."""

import pathlib
from typing import Annotated, Any

from crisalad_jax.cli.common import echo, find_given, load_model, pick, refuse_with
from crisalad_jax.cli.flags import WEIGHTS, FrameFlags, JsonFlag, ReadFlags, SizeFlags
from crisalad_jax.nn.model import Model
from crisalad_jax.training.vocabulary import IMAGES, build_vocabulary, start_vocabulary


class Vocabulary(ReadFlags, FrameFlags, SizeFlags, JsonFlag):
    """Build a model's vocabulary from images: AnyLoc's, NetVLAD's, or words of SIFT or ORB."""

    images: pathlib.Path
    """Folder of images, with subfolders; or a file, a pattern, a list, a table or a video
    (docs/how-to/image-sources.md). Not evaluation images."""
    out: Annotated[pathlib.Path, WEIGHTS]
    """A .safetensors file, for the model with the new vocabulary."""
    weights: pathlib.Path | None = None
    """Model whose vocabulary is replaced: AnyLoc, NetVLAD or a custom part with one; a file, or a
    published model's name."""
    backbone: pathlib.Path | None = None
    """Any checkpoint that `convert` reads, or a published model's name, as in dinov2-vitg14; only
    its backbone is used."""
    preset: str | None = None
    """Size of the backbone: tiny, s14, b14 (the default), l14 or g14; without --backbone its
    weights are random."""
    aggregator: str | None = None
    """With --preset: anyloc (the default), or another that starts from centroids, such as netvlad
    or a custom part; or sift-vlad, sift-bow or orb-bow, which need no backbone."""
    clusters: int | None = None
    """Number of words, if the aggregator has this setting; by default the preset's."""
    layer: int | None = None
    """Block that AnyLoc reads, from 0, or from the end if negative; by default the preset's."""
    facet: str | None = None
    """What AnyLoc takes from its block: query, key, value or token; by default value."""
    assignment: str | None = None
    """How AnyLoc finds the nearest word of a patch: cosine (as published) or euclidean."""
    max_images: int = IMAGES
    """Maximum number of images to read, drawn at random."""
    seed: int = 0
    """Seed of the draws of images and patches, of the first centroids, and of a random backbone."""


def run(arguments: Vocabulary) -> dict[str, Any]:
    """Build the vocabulary, write the model, and print its size; return the result for --json."""
    model = _model(arguments)
    built = build_vocabulary(
        model,
        arguments.images,
        arguments.out,
        **pick(arguments, "fps", "topic", "max_images", "seed", "batch_size"),
        **pick(arguments, "on_bad_image", "quiet"),
    )
    config, name = model.config, model.config.aggregator.part_name
    echo(
        f"{arguments.out}: {name}, {built.words} words from {built.images} images at "
        f"{config.images_in_words}, descriptors of {config.descriptor_dim} dimensions"
    )
    return {
        "out": str(arguments.out),
        "vocabulary": name,
        "words": built.words,
        "images": built.images,
        "length": config.descriptor_dim,
        "resized": config.images_in_words,
    }


def _model(arguments: Vocabulary) -> Model:
    given = pick(arguments, "clusters", "layer", "facet", "assignment")
    if arguments.weights is not None:
        refuse_with("--weights", **pick(arguments, "backbone", "preset", "aggregator"), **given)
        return load_model(arguments.weights, arguments, quiet=arguments.quiet)
    return start_vocabulary(
        arguments.aggregator or "anyloc",
        arguments.preset or "b14",
        backbone=find_given(arguments.backbone, quiet=arguments.quiet),
        fields={name: value for name, value in given.items() if value is not None},
        **pick(arguments, "image_size", "resize", "seed"),
    )
