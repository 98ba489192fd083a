"""`crisalad extract`."""

import dataclasses
import pathlib
from typing import Annotated, Any

from crisalad_jax.cli.common import echo, given_positions, open_flagged, pick
from crisalad_jax.cli.flags import (
    FrameFlags,
    JsonFlag,
    ModelFlags,
    PlaceFlags,
    ReadFlags,
    Target,
)
from crisalad_jax.retrieval.extract import check_extraction, extract
from crisalad_jax.retrieval.grouping import GROUPINGS
from crisalad_jax.utils.output import counted

COMMON = (
    "weights images out image-size resize grouping batch-size runtime compute-dtype root pairs "
    "database k pca on-bad-image json quiet"
)
EXAMPLE = "crisalad extract --weights salad --images photos --out photos.npy"
SEVERAL = "quote a pattern, or list the images in a .txt"
"""What to do in place of several values of --images."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Extract(ReadFlags, FrameFlags, ModelFlags, PlaceFlags, JsonFlag):
    """Write a descriptor of every image in a folder, in sorted path order."""

    images: pathlib.Path
    """Folder, searched with its subfolders; or a file, a pattern, a list, a table, a video
    or a robot log (docs/how-to/image-sources.md)."""
    out: Annotated[pathlib.Path, Target()]
    """descriptors.npy (with names in .names.txt) or features.h5 (hloc)."""
    grouping: str = "single"
    """single, shuffled, sequential, or window (an image with those just before it, --batch-size in
    all): a cross-image model's descriptors depend on it."""
    seed: int = 0
    """Draws the shuffled order."""
    root: pathlib.Path | None = None
    """Folder that names are relative to, by default --images: hloc's folder of all images."""
    pairs: Annotated[pathlib.Path | None, Target((".txt",))] = None
    """File for hloc's pairs: each image with those most similar to it, a pair a line."""
    database: pathlib.Path | None = None
    """Descriptors, .h5 or .npy, of the images that are paired with these; by default these."""
    k: int = 20
    """Pairs of each image; never with itself."""
    pca: pathlib.Path | None = None
    """Components that `crisalad pca` fitted, for shorter descriptors."""


def run(arguments: Extract) -> dict[str, Any]:
    """Describe the images, and print what was written."""
    out, how = arguments.out, pick(arguments, "grouping", "seed", "pairs", "database", "k")
    check_extraction(out, **how)
    positions = given_positions(arguments)
    model, _, file = open_flagged(arguments, groupings=[arguments.grouping])
    more = pick(arguments, "fps", "topic", "every_metres", "root", "pca", "verify", "reading")
    result = extract(model, arguments.images, out, weights=file, positions=positions, **how, **more)
    described = counted(len(result.names), "descriptor")
    pairs = None
    if result.pairs is not None:
        pairs = {"file": str(arguments.pairs), "count": len(result.pairs)}
        echo(f"{arguments.pairs}: {len(result.pairs)} pairs")
    skipped = f"; {len(result.skipped)} unreadable images left out" if result.skipped else ""
    length, images = result.descriptors.shape[1], model.config.images_in_words
    echo(
        f"{out}: {described} of {length} numbers, grouping {arguments.grouping} "
        f"({GROUPINGS[arguments.grouping]}), images at {images}{skipped}"
    )
    return {
        "out": str(out),
        "descriptors": len(result.names),
        "length": length,
        "grouping": arguments.grouping,
        "images": images,
        "skipped": result.skipped,
        "pairs": pairs,
    }
