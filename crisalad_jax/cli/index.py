"""`crisalad index`."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.cli.common import give_json, open_model, prepare_json, say
from crisalad_jax.cli.flags import JsonFlag, ModelFlags, ReadFlags
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.maps.approximate import NEIGHBOURS, SAMPLE
from crisalad_jax.retrieval.maps.build import Indexed, index
from crisalad_jax.retrieval.maps.metadata import (
    has_images,
    model_config,
    read_metadata,
    weights_of,
)
from crisalad_jax.utils.output import counted

COMMON = (
    "images",
    "out",
    "weights",
    "fps",
    "positions",
    "store",
    "dtype",
    "pca",
    "search",
    "share",
    "image-size",
    "resize",
    "batch-size",
    "runtime",
    "compute-dtype",
    "on-bad-image",
    "json",
    "plugin",
    "quiet",
)
EXAMPLE = "crisalad index --weights salad --images photos --positions gps.csv --out map"
SEVERAL = "quote a pattern; other folders are added by the same command again"
"""What to do in place of several values of --images."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Index(ReadFlags, ModelFlags, JsonFlag):
    """Make a map of a folder of images, or append to it those that it lacks.

    An existing map takes images by the model that made it, at its image size.
    """

    images: pathlib.Path
    """Folder, file, pattern, list, table or video (docs/how-to/image-sources.md); the map names
    images by their paths in the folder, subfolders included."""
    out: pathlib.Path
    """The map's folder. After a kill the same command goes on."""
    fps: float | None = None
    """Frames a second taken of a video, by default 1."""
    positions: pathlib.Path | None = None
    """CSV of name,east,north (metres) or name,lat,lon or name,x,y, for images that are new; by
    default what a table as --images says, or @UTM names, or EXIF data."""
    store: str | None = None
    """files, in the map's folder, or milvus:URI, a file name.db or http://host:port; by default the
    map's, and of a new map files."""
    dtype: Literal["float32", "float16"] | None = None
    """What files keep descriptors as, by default the map's, and in a new map float32."""
    pca: pathlib.Path | None = None
    """Components of `crisalad pca`, for shorter descriptors; the map keeps a copy, which queries
    use."""
    search: Literal["exact", "hnsw", "ivf-pq"] | None = None
    """Build an approximate search, and print what it recalls; exact removes it (docs/large.md)."""
    share: str | None = None
    """INDEX/COUNT: describe one share; other processes and hosts take the others, the last one
    joins all."""


def run(arguments: Index) -> None:
    """Index the images, and print what became of them."""
    prepare_json(arguments.json)
    reading = arguments.reading
    weights, config = _there(arguments)
    model, _ = open_model(weights, arguments, like=config)
    result = index(
        model,
        arguments.images,
        arguments.out,
        weights=weights,
        fps=arguments.fps,
        positions=arguments.positions,
        store=arguments.store,
        dtype=arguments.dtype,
        pca=arguments.pca,
        search=arguments.search,
        share=arguments.share,
        reading=reading,
    )
    described = f"{counted(result.added, 'image')} described"
    if result.shares_left:
        say(
            f"{arguments.out}: share {arguments.share}: {described}; "
            f"shares still to be done: {result.shares_left}; the last one joins all"
        )
    elif result.joined_elsewhere:
        say(f"{arguments.out}: share {arguments.share}: {described}; another process joins all")
    else:
        say(f"{arguments.out}: {'; '.join(_words(result, model.config))}")
    metadata = result.metadata
    counts = {name: value for name, value in result._asdict().items() if name != "metadata"}
    give_json(
        arguments.json,
        {"out": str(arguments.out)}
        | counts
        | {
            "length": metadata.descriptor_length,
            "store": metadata.store,
            "resized": model.config.images_in_words,
        },
    )


def _there(arguments: Index) -> tuple[pathlib.Path, ModelConfig | None]:
    """Find the model's file and, of an existing map, the configuration of its images."""
    metadata = read_metadata(arguments.out) if has_images(arguments.out) else None
    config = None if metadata is None else model_config(metadata, arguments.out)
    if metadata is not None and arguments.weights is None:
        return weights_of(metadata, arguments.out), config
    return find_weights(arguments.weights, quiet=arguments.quiet), config


def _words(result: Indexed, config: ModelConfig) -> list[str]:
    """Describe the images' fates in clauses; empty groups are left out."""
    metadata, unmatched = result.metadata, result.unmatched
    words = [f"{counted(result.added, 'image')} added, {result.positions} with positions"]
    if result.there:
        words.append(f"{result.there} were there already")
    if result.stay:
        words.append(f"{result.stay} positions given are of such, and stay as they are")
    if unmatched:
        words.append(
            f"{len(unmatched)} positions given are of no image here, {unmatched[0]!r} the first"
        )
    if result.unreadable:
        words.append(
            f"{len(result.unreadable)} unreadable left out, {result.unreadable[0]} the first"
        )
    length, store = metadata.descriptor_length, metadata.store
    words.append(f"{counted(result.images, 'descriptor')} of {length} numbers ({store})")
    if result.recall is not None:
        words.append(
            f"approximate search finds {100 * result.recall:.1f} % of the exact {NEIGHBOURS} "
            f"nearest of {min(SAMPLE, result.images)} images"
        )
    return [*words, f"images at {config.images_in_words}"]
