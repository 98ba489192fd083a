"""`crisalad pairs`."""

import contextlib
import pathlib
import tempfile
from typing import Annotated, Any

from crisalad_jax.cli.common import echo, find_given, pick, refuse_without
from crisalad_jax.cli.flags import JsonFlag, ReadFlags, RuntimeName, Target
from crisalad_jax.config.checks import require
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.pairs import check_rules, image_pairs
from crisalad_jax.utils.output import counted


class Pairs(ReadFlags, JsonFlag):
    """Choose pairs of images to match, for COLMAP and hloc.

    For a reconstruction, pairs are among the images of --map or of --images. With both flags, the
    images of --images are paired with those of the map, to localise them.
    """

    map: pathlib.Path | None = None
    """Folder that `crisalad index` wrote."""
    images: pathlib.Path | None = None
    """Folder, file, pattern, list, table or video (docs/how-to/image-sources.md)."""
    out: Annotated[pathlib.Path, Target((".txt",))]
    """File with a pair per line: two names separated by a space."""
    root: pathlib.Path | None = None
    """Folder that names are relative to, COLMAP's image_path; by default that of the images."""
    k: int = 20
    """Pair each image with this many most similar ones; 0 makes no such pairs."""
    min_similarity: float = -1.0
    """Minimum similarity of the pairs of --k."""
    min_gap: float | None = None
    """Minimum seconds between images paired by --k, by the times in their names (loop closures)."""
    overlap: int = 0
    """Also pair each image with the next images in its folder or video, up to this many."""
    within: float | None = None
    """Also pair images at most this many metres apart, if positions are known."""
    weights: pathlib.Path | None = None
    """Model for --images; by default the one that made the map, or starter. A file or a published
    name."""
    fps: float | None = None
    """Frames per second from a video, by default 1."""
    runtime: RuntimeName = "jax"
    """Engine that runs the model (docs/export.md)."""
    checksums: bool = True
    """Check files against their checksums; --no-checksums skips that for huge files."""


def needs_jax(arguments: Pairs) -> bool:
    """Return whether the command describes images with JAX; a map has descriptors already."""
    return arguments.images is not None and arguments.runtime == "jax"


def run(arguments: Pairs) -> dict[str, Any]:
    """Choose and write the pairs, and print how many; return the result for --json."""
    folder, images, reading = arguments.map, arguments.images, arguments.reading
    rules = pick(arguments, "k", "overlap", "within", "min_gap")
    check_rules(among=folder is None or images is None, **rules)
    refuse_without("--images", images, **pick(arguments, "weights", "fps"))
    rules |= pick(arguments, "root", "min_similarity")
    unreadable: list[str] = []
    with contextlib.ExitStack() as stack:
        if folder is None:
            require(images is not None, "--map: found none, and no --images, expected one or both")
            scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="crisalad-"))
            folder = pathlib.Path(scratch, "map")
            unreadable = _index(arguments, folder)
            images = None
        verify = arguments.checksums
        places = stack.enter_context(Map.open(folder, verify=verify, calibrated=False))
        if images is not None:
            runtime = arguments.runtime
            weights = find_given(arguments.weights, runtime=runtime, quiet=arguments.quiet)
            places.load_model(weights, engine=runtime, verify=verify)
            rules |= pick(arguments, "fps")
        found = image_pairs(places, images, reading=reading, **rules)
        of = counted(len(places), "image")
    found.write(arguments.out)
    unreadable += found.unreadable
    skipped = f"; {len(unreadable)} unreadable images left out" if unreadable else ""
    echo(
        f"{arguments.out}: {counted(len(found.pairs), 'pair')} {'of' if images is None else 'with'}"
        f" {of}, named relative to {found.root}{skipped}"
    )
    return {
        "out": str(arguments.out),
        "pairs": len(found.pairs),
        "root": str(found.root),
        "unreadable": unreadable,
    }


def _index(arguments: Pairs, folder: pathlib.Path) -> list[str]:
    """Index --images into a map, and return the names of unreadable ones."""
    from crisalad_jax.checkpoints.load import open_model
    from crisalad_jax.retrieval.maps.build import index

    model, _, file = open_model(
        arguments.weights,
        arguments.runtime,
        lambda same: same,
        verify=arguments.checksums,
        quiet=arguments.quiet,
    )
    options = pick(arguments, "fps", "reading")
    assert arguments.images is not None
    return index(model, arguments.images, folder, weights=file, **options).unreadable
