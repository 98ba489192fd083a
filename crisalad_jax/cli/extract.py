"""`crisalad extract`."""

import pathlib
from typing import Annotated, Any

from crisalad_jax.cli.common import echo, given_positions, open_flagged, pick
from crisalad_jax.cli.flags import (
    ClusterFlag,
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


class Extract(ReadFlags, ClusterFlag, FrameFlags, ModelFlags, PlaceFlags, JsonFlag):
    """Write a descriptor of every image in a folder, in sorted path order."""

    images: pathlib.Path
    """Folder of images, with subfolders; or a file, a pattern, a list, a table, a video or a
    robot log (docs/how-to/image-sources.md)."""
    out: Annotated[pathlib.Path, Target()]
    """File to write: .npy, with the images' names in .names.txt next to it, or .h5 for hloc."""
    grouping: str = "single"
    """single, shuffled, sequential, or window (an image and those just before it, --batch-size in
    all). A cross-image model's descriptors depend on it."""
    seed: int = 0
    """Seed of the shuffled order."""
    root: pathlib.Path | None = None
    """Folder that names are relative to, by default --images; for hloc its folder of all images."""
    pca: pathlib.Path | None = None
    """Components that `crisalad pca` fitted, for shorter descriptors."""


def run(arguments: Extract) -> dict[str, Any]:
    """Describe the images, and print what was written; return the result for --json."""
    out, how = arguments.out, pick(arguments, "grouping", "seed")
    check_extraction(out, cluster=arguments.cluster, **how)
    positions = given_positions(arguments)
    model, _, file = open_flagged(arguments, groupings=[arguments.grouping])
    more = pick(arguments, "fps", "topic", "every_metres", "root", "pca", "reading", "cluster")
    more |= {"weights": file, "positions": positions, "verify": arguments.checksums}
    result = extract(model, arguments.images, out, **how, **more)
    described = counted(len(result.names), "descriptor")
    skipped = f"; {len(result.skipped)} unreadable images left out" if result.skipped else ""
    length, images = result.descriptors.shape[1], model.config.images_in_words
    echo(
        f"{out}: {described} of {length} dimensions, grouping {arguments.grouping} "
        f"({GROUPINGS[arguments.grouping]}), images at {images}{skipped}"
    )
    return {
        "out": str(out),
        "descriptors": len(result.names),
        "length": length,
        "grouping": arguments.grouping,
        "images": images,
        "skipped": result.skipped,
    }
