"""`crisalad index`."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.runtime import Runtime, open_runtime
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.common import RuntimeName, give_json, open_model, prepare_json, say
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.retrieval.maps.approximate import NEIGHBOURS, SAMPLE
from crisalad_jax.retrieval.maps.build import Indexed, index
from crisalad_jax.retrieval.maps.head import has_images, read_head, weights_of
from crisalad_jax.retrieval.maps.manifest import read_description
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


@dataclasses.dataclass(frozen=True)
class Index:
    """Make a map of a folder of images, or append to it those that it lacks."""

    images: pathlib.Path
    """Folder, file, pattern, list, table or video (docs/how-to/image-sources.md); the map names
    images by their paths in the folder, subfolders included."""
    out: pathlib.Path
    """The map's folder. After a kill the same command goes on."""
    weights: pathlib.Path | None = None
    """By default starter, the small model in this package, and of a map that is there the model
    that made it; or a .safetensors file, or a published model's name (`crisalad models`)."""
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
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; by default the map's, and of a new map
    the model's."""
    resize: tuple[str, ...] = ()
    """Words in place of the model's way: fixed, shorter-side, longer-side or native; bilinear,
    bicubic or area; antialias or no-antialias; bytes or floats; round;
    high-byte or contrast-stretch, for 16 bits and floats (docs/resizing.md)."""
    batch_size: int = 16
    """Images described at once, each as if it were alone."""
    runtime: RuntimeName = "jax"
    """What computes the model: jax, onnxruntime or openvino (docs/export.md). Weights are exported
    for it once; --weights may be an exported folder."""
    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the map's, and in a new map the model's."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and say so."""
    verify: bool = True
    """Check the weights, or an exported model, against their checksums; --no-verify skips that,
    where files are huge."""
    max_pixels: int = 2**28
    """Pixels that an image file may have; larger ones are not decoded."""
    json: pathlib.Path | None = None
    """File for the result as JSON; - prints it."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Index) -> None:
    """Index the images, and print what became of them."""
    prepare_json(arguments.json)
    weights = _weights(arguments)
    params, config = _model(arguments, weights)
    result = index(
        params,
        config,
        arguments.images,
        arguments.out,
        weights=weights,
        fps=arguments.fps,
        image_size=arguments.image_size,
        resize=arguments.resize,
        compute_dtype=arguments.compute_dtype,
        positions=arguments.positions,
        store=arguments.store,
        dtype=arguments.dtype,
        pca=arguments.pca,
        search=arguments.search,
        share=arguments.share,
        batch_size=arguments.batch_size,
        on_bad_image=arguments.on_bad_image,
        quiet=arguments.quiet,
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
        say(f"{arguments.out}: {'; '.join(_words(result))}")
    description = result.description
    counts = {name: value for name, value in result._asdict().items() if name != "description"}
    give_json(
        arguments.json,
        {"out": str(arguments.out)}
        | counts
        | {
            "length": description.descriptor_length,
            "store": description.store,
            "resized": description.config.images_in_words,
        },
    )


def _weights(arguments: Index) -> pathlib.Path:
    """Find the model's file, by default that of the map."""
    if arguments.weights is None and has_images(arguments.out):
        there = read_head(arguments.out)
        assert there is not None  # or it would have no images
        return weights_of(there, arguments.out)
    return find_weights(arguments.weights, quiet=arguments.quiet)


def _model(arguments: Index, weights: pathlib.Path) -> tuple[Crisalad | Runtime, ModelConfig]:
    """Load the model; for another engine, in the size and type in which the map has its images."""
    if arguments.runtime == "jax":
        return load_weights(weights, verify=arguments.verify)
    there = read_description(arguments.out)
    if there is not None and has_images(arguments.out):
        config = there.config
        runtime = open_runtime(
            weights,
            arguments.runtime,
            image_size=config.image_size,
            preprocessing=config.preprocessing,
            precision="bfloat16" if config.compute_dtype == "bfloat16" else "float32",
            verify=arguments.verify,
        )
        return runtime, config
    params, config, _ = open_model(
        weights,
        arguments.runtime,
        image_size=arguments.image_size,
        resize=arguments.resize,
        compute_dtype=arguments.compute_dtype,
        verify=arguments.verify,
        quiet=arguments.quiet,
    )
    return params, config


def _words(result: Indexed) -> list[str]:
    """Describe the images' fates in clauses; empty groups are left out."""
    description, unmatched = result.description, result.unmatched
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
    length, store = description.descriptor_length, description.store
    words.append(f"{counted(result.images, 'descriptor')} of {length} numbers ({store})")
    if result.recall is not None:
        words.append(
            f"approximate search finds {100 * result.recall:.1f} % of the exact {NEIGHBOURS} "
            f"nearest of {min(SAMPLE, result.images)} images"
        )
    return [*words, f"images at {description.config.images_in_words}"]
