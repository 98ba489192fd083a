"""`crisalad index`."""

import pathlib
from typing import Annotated, Any, Literal

from crisalad_jax.cli.common import echo, first_of, given_positions, open_flagged, pick
from crisalad_jax.cli.flags import (
    FOLDER,
    ClusterFlag,
    FrameFlags,
    JsonFlag,
    ModelFlags,
    PlaceFlags,
    ReadFlags,
)
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.maps.approximate import NEIGHBOURS, SAMPLE
from crisalad_jax.retrieval.maps.build import Indexed, index
from crisalad_jax.retrieval.maps.metadata import model_config, read_metadata, weights_of
from crisalad_jax.utils.output import counted


class Index(ReadFlags, ClusterFlag, FrameFlags, ModelFlags, PlaceFlags, JsonFlag):
    """Make a map from a folder of images, or append the images that it lacks.

    An existing map uses the model that made it, at its image size.
    """

    images: pathlib.Path
    """Folder, file, pattern, list, table, video or robot log (docs/how-to/image-sources.md);
    the map names images by their paths in the folder, subfolders included."""
    out: Annotated[pathlib.Path, FOLDER]
    """Folder of the map. If the command is killed, the same command resumes it."""
    position_topic: str | None = None
    """Topic of positions in a robot log, by default the only NavSatFix, else the only odometry or
    pose; none ignores positions."""
    novelty: float | None = None
    """Take an image only if its similarity to the last one taken from its folder or video is at
    most this, such as 0.9."""
    store: str | None = None
    """Where to store descriptors: files, in the map's folder, or milvus:URI, with a file name.db or
    http://host:port as the URI; by default as in the map, or files for a new map."""
    dtype: Literal["float32", "float16", "bits"] | None = None
    """Type of descriptors in files, by default that of the map, or float32 in a new map; bits
    stores only their signs (docs/maps.md)."""
    pca: pathlib.Path | None = None
    """Components that `crisalad pca` fitted, for shorter descriptors; the map stores a copy for
    queries."""
    search: Literal["auto", "exact", "hnsw", "ivf-rabitq", "diskann"] | None = None
    """Build an index for approximate search, and print its recall; exact removes it, auto chooses
    by size and memory (docs/large.md). Only Milvus has diskann."""
    again: bool = False
    """Also add images that `crisalad map remove` removed."""


def run(arguments: Index) -> dict[str, Any]:
    """Index the images, and print what became of them; return the counts for --json."""
    out, weights, like = arguments.out, None, None
    positions = given_positions(arguments)
    metadata = read_metadata(out)
    if metadata is not None:
        like = model_config(metadata, out)
        weights = None if arguments.weights else weights_of(metadata, out)
    model, _, file = open_flagged(arguments, weights, like=like)
    config = model.config
    more = pick(arguments, "fps", "topic", "position_topic", "every_metres", "novelty", "reading")
    more |= pick(arguments, "store", "dtype", "pca", "search", "again", "cluster")
    result = index(model, arguments.images, out, weights=file, positions=positions, **more)
    echo(f"{out}: {'; '.join(_words(result, config))}")
    counts = {name: value for name, value in result._asdict().items() if name != "metadata"}
    return {
        "out": str(out),
        **counts,
        "length": result.metadata.descriptor_length,
        "store": result.metadata.store,
        "resized": config.images_in_words,
    }


def _words(result: Indexed, config: ModelConfig) -> list[str]:
    """Describe what became of the images in clauses; empty groups are left out."""
    metadata, unmatched, unreadable = result.metadata, result.unmatched, result.unreadable
    fates = (
        (result.there, "were there already"),
        (result.removed, "were removed from the map and stay out (--again adds them)"),
        (result.stay, "given positions ignored, as the map has these images"),
        (result.near, "nearer than --every-metres left out"),
        (result.similar, "more similar than --novelty left out"),
        (len(unmatched), f"given positions match no image here, {first_of(unmatched)}"),
        (len(unreadable), f"unreadable left out, {first_of(unreadable)}"),
    )
    length, store = metadata.length_words, metadata.store
    words = [
        f"{counted(result.added, 'image')} added, {result.positions} with positions",
        *(f"{count} {fate}" for count, fate in fates if count),
        f"{counted(result.images, 'descriptor')} of {length} ({store})",
    ]
    if result.recall is not None:
        words.append(
            f"approximate search finds {100 * result.recall:.1f} % of the exact {NEIGHBOURS} "
            f"nearest of {min(SAMPLE, result.images)} images"
        )
    return [*words, f"images at {config.images_in_words}"]
