"""`crisalad extract`."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.cli.common import console, model_of
from crisalad_jax.data.images import list_images, names_in
from crisalad_jax.descriptors import (
    Descriptors,
    config_of,
    read_descriptors,
    targets,
    writer_for,
)
from crisalad_jax.errors import InputError
from crisalad_jax.evaluation import group, read_tokens
from crisalad_jax.files import check_target, write_json
from crisalad_jax.groupings import GROUPINGS, check_grouping
from crisalad_jax.pairs import check_names, nearest_pairs, write_pairs
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
    root: pathlib.Path | None = None
    """Folder that names are relative to, by default --images: hloc's folder of all images."""
    pairs: pathlib.Path | None = None
    """File for hloc's pairs: each image with those most similar to it, a pair a line."""
    database: pathlib.Path | None = None
    """Descriptors, .h5 or .npy, of the images that are paired with these; by default these."""
    k: int = 20
    """Pairs of each image; never with itself."""
    pca: pathlib.Path | None = None
    """Components that `crisalad pca` fitted, for shorter descriptors."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and say so."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Extract) -> None:
    """Describe the images, and write the descriptors."""
    write = writer_for(arguments.out)
    for target in (*targets(arguments.out), *([arguments.pairs] if arguments.pairs else [])):
        check_target(target)
    if arguments.pairs in targets(arguments.out):
        raise InputError(f"--pairs: found {arguments.pairs}, which --out writes, expected another")
    if arguments.database is not None and arguments.pairs is None:
        raise InputError("--database: found without --pairs, expected both")
    check_grouping([arguments.grouping], arguments.batch_size, arguments.seed)
    params, config, _ = model_of(
        arguments.weights,
        image_size=arguments.image_size,
        compute_dtype=arguments.compute_dtype,
    )
    pca = None if arguments.pca is None else load_pca(arguments.pca)
    if pca is not None:
        pca.check(config.descriptor_dim, str(arguments.weights))
        if arguments.pairs is not None and not pca.config.renormalise:
            raise InputError(
                f"--pairs: found {arguments.pca}, which leaves lengths as they are, expected "
                "components that make unit vectors, which are paired by cosine"
            )
    paths = list_images(arguments.images)
    names = _names(arguments, paths)
    length = config.descriptor_dim if pca is None else len(pca.components)
    database = _database(arguments, names, length)
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
    if arguments.pairs is not None:
        pairs = nearest_pairs(kept, descriptors, *(database or (kept, descriptors)), k=arguments.k)
        write_pairs(arguments.pairs, pairs)
        console.print(f"{arguments.pairs}: {len(pairs)} pairs", soft_wrap=True)
    console.print(
        f"{arguments.out}: {len(kept)} descriptors of {descriptors.shape[1]} numbers, "
        f"grouping {arguments.grouping} ({GROUPINGS[arguments.grouping]})"
        + (f"; {len(skipped)} unreadable images left out" if skipped else ""),
        soft_wrap=True,
    )


def _names(arguments: Extract, paths: list[pathlib.Path]) -> list[str]:
    """Posix paths relative to --root, which holds --images."""
    folder = pathlib.PurePath()
    if arguments.root is not None:
        images, root = arguments.images.resolve(), arguments.root.resolve()
        if not images.is_relative_to(root):
            raise InputError(f"--root: found {root}, expected a folder that holds {images}")
        folder = images.relative_to(root)
    return [(folder / name).as_posix() for name in names_in(arguments.images, paths)]


def _database(
    arguments: Extract, names: list[str], length: int
) -> tuple[list[str], Descriptors] | None:
    """What these images are to be paired with; all is checked that can be before the work."""
    if arguments.pairs is None:
        return None
    if arguments.k < 1:
        raise InputError(f"k: found {arguments.k}, expected at least 1")
    check_names(arguments.pairs, names)
    if arguments.database is None:
        return None
    listed, descriptors = read_descriptors(arguments.database)
    check_names(arguments.pairs, listed)
    if descriptors.shape[1] != length:
        raise InputError(
            f"{arguments.database}: found descriptors of {descriptors.shape[1]} numbers, expected "
            f"{length} as of these images"
        )
    return listed, descriptors
