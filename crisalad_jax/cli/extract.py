"""`crisalad extract`."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.cli.common import console, model_of
from crisalad_jax.data.images import list_images
from crisalad_jax.descriptors import config_of, targets, writer_for
from crisalad_jax.errors import InputError
from crisalad_jax.evaluation import group, read_tokens
from crisalad_jax.files import check_target, write_json
from crisalad_jax.groupings import GROUPINGS, check_grouping
from crisalad_jax.pca import load_pca
from crisalad_jax.serial import to_plain


@dataclasses.dataclass(frozen=True)
class Extract:
    """Write a descriptor of every image in a folder, in sorted path order."""

    weights: pathlib.Path
    """A .safetensors file of this package."""
    images: pathlib.Path
    """Folder, searched with its subfolders."""
    out: pathlib.Path
    """descriptors.npy (names beside it in .names.txt) or features.h5 (hloc)."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the model's."""
    grouping: str = "single"
    """single, shuffled, sequential, or window (an image with those just before it, --batch-size in
    all): a cross-image model's descriptors depend on it."""
    batch_size: int = 16
    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the model's; docs/performance.md shows what bfloat16
    gains and loses."""
    seed: int = 0
    """Draws the shuffled order."""
    pca: pathlib.Path | None = None
    """Components that `crisalad pca` fitted, for shorter descriptors."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and say so."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Extract) -> None:
    """Describe the images, and write the descriptors."""
    write = writer_for(arguments.out)
    for target in targets(arguments.out):
        check_target(target)
    check_grouping([arguments.grouping], arguments.batch_size, arguments.seed)
    params, config, _ = model_of(
        arguments.weights,
        image_size=arguments.image_size,
        compute_dtype=arguments.compute_dtype,
    )
    pca = None if arguments.pca is None else load_pca(arguments.pca)
    if pca is not None:
        pca.check(config.descriptor_dim, str(arguments.weights))
    paths = list_images(arguments.images)
    folder = read_tokens(
        params,
        config,
        paths,
        batch_size=arguments.batch_size,
        label="images",
        on_bad_image=arguments.on_bad_image,
        quiet=arguments.quiet,
    )
    descriptors = group(
        params,
        config,
        folder,
        arguments.grouping,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        quiet=arguments.quiet,
    )[folder.readable]
    names = [path.relative_to(arguments.images).as_posix() for path in paths]
    skipped = [name for name, ok in zip(names, folder.readable, strict=True) if not ok]
    kept = [name for name, ok in zip(names, folder.readable, strict=True) if ok]
    if not kept:
        raise InputError(f"{arguments.images}: found {len(paths)} images, none of them readable")
    if pca is not None:
        descriptors = pca.apply(descriptors)
    write(arguments.out, descriptors, kept)
    write_json(
        config_of(arguments.out),
        {
            "weights": str(arguments.weights),
            "images": str(arguments.images),
            "grouping": arguments.grouping,
            "batch_size": arguments.batch_size,
            "seed": arguments.seed,
            "pca": None if arguments.pca is None else str(arguments.pca),
            "skipped": skipped,
            "model": to_plain(config),
        },
    )
    console.print(
        f"{arguments.out}: {len(kept)} descriptors of {descriptors.shape[1]} numbers, "
        f"grouping {arguments.grouping} ({GROUPINGS[arguments.grouping]})"
        + (f"; {len(skipped)} unreadable images left out" if skipped else ""),
        soft_wrap=True,
    )
