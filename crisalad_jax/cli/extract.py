"""`crisalad extract`."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.cli.common import RuntimeName, give_json, open_model, prepare_json, say
from crisalad_jax.retrieval.extract import check_extraction, extract
from crisalad_jax.retrieval.grouping import GROUPINGS
from crisalad_jax.utils.output import counted

COMMON = (
    "weights",
    "images",
    "out",
    "image-size",
    "resize",
    "grouping",
    "batch-size",
    "runtime",
    "compute-dtype",
    "root",
    "pairs",
    "database",
    "k",
    "pca",
    "on-bad-image",
    "json",
    "quiet",
)
EXAMPLE = "crisalad extract --weights salad --images photos --out photos.npy"
SEVERAL = "quote a pattern, or list the images in a .txt"
"""What to do in place of several values of --images."""


@dataclasses.dataclass(frozen=True)
class Extract:
    """Write a descriptor of every image in a folder, in sorted path order."""

    images: pathlib.Path
    """Folder, searched with its subfolders; or a file, a pattern, a list, a table or a video
    (docs/how-to/image-sources.md)."""
    out: pathlib.Path
    """descriptors.npy (names beside it in .names.txt) or features.h5 (hloc)."""
    weights: pathlib.Path | None = None
    """By default starter, the small model in this package; or a .safetensors file, or a published
    model's name (`crisalad models`)."""
    fps: float | None = None
    """Frames a second taken of a video, by default 1."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; by default the model's."""
    resize: tuple[str, ...] = ()
    """Words in place of the model's way: fixed, shorter-side, longer-side or native; bilinear,
    bicubic or area; antialias or no-antialias; bytes or floats; round;
    high-byte or contrast-stretch, for 16 bits and floats (docs/resizing.md)."""
    grouping: str = "single"
    """single, shuffled, sequential, or window (an image with those just before it, --batch-size in
    all): a cross-image model's descriptors depend on it."""
    batch_size: int = 16
    """Images described together."""
    runtime: RuntimeName = "jax"
    """What computes the model: jax, onnxruntime or openvino (docs/export.md). Weights are exported
    for it once; --weights may be an exported folder."""
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
    share: str | None = None
    """INDEX/COUNT: describe one share; other processes and hosts take the others, the last one
    joins all. Of the grouping single."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and say so."""
    verify: bool = True
    """Check weights, components and --database against their checksums; --no-verify skips that,
    where files are huge."""
    max_pixels: int = 2**28
    """Pixels that an image file may have; larger ones are not decoded."""
    json: pathlib.Path | None = None
    """File for the result as JSON; - prints it."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Extract) -> None:
    """Describe the images, and print what was written."""
    prepare_json(arguments.json)
    check_extraction(
        arguments.out,
        grouping=arguments.grouping,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        pairs=arguments.pairs,
        database=arguments.database,
        k=arguments.k,
        share=arguments.share,
    )
    weights = find_weights(arguments.weights, quiet=arguments.quiet)
    params, config, _ = open_model(
        weights,
        arguments.runtime,
        image_size=arguments.image_size,
        resize=arguments.resize,
        compute_dtype=arguments.compute_dtype,
        any_grouping=arguments.grouping != "single",
        verify=arguments.verify,
    )
    result = extract(
        params,
        config,
        arguments.images,
        arguments.out,
        fps=arguments.fps,
        weights=weights,
        grouping=arguments.grouping,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        root=arguments.root,
        pairs=arguments.pairs,
        database=arguments.database,
        k=arguments.k,
        pca=arguments.pca,
        share=arguments.share,
        on_bad_image=arguments.on_bad_image,
        verify=arguments.verify,
        quiet=arguments.quiet,
    )
    described = counted(len(result.names), "descriptor")
    if result.shares_left or result.joined_elsewhere:
        rest = (
            f"shares still to be done: {result.shares_left}; the last one joins all"
            if result.shares_left
            else "another process joins all"
        )
        say(f"{arguments.out}: share {arguments.share}: {described}; {rest}")
        return
    if result.pairs is not None:
        say(f"{arguments.pairs}: {len(result.pairs)} pairs")
    skipped = f"; {len(result.skipped)} unreadable images left out" if result.skipped else ""
    say(
        f"{arguments.out}: {described} of {result.descriptors.shape[1]} "
        f"numbers, grouping {arguments.grouping} ({GROUPINGS[arguments.grouping]}), images at "
        f"{config.images_in_words}{skipped}"
    )
    pairs = {"file": str(arguments.pairs), "count": len(result.pairs or ())}
    give_json(
        arguments.json,
        {
            "out": str(arguments.out),
            "descriptors": len(result.names),
            "length": result.descriptors.shape[1],
            "grouping": arguments.grouping,
            "images": config.images_in_words,
            "skipped": result.skipped,
            "pairs": None if result.pairs is None else pairs,
        },
    )
