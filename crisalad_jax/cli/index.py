"""`crisalad index`."""

import dataclasses
import pathlib
from typing import Literal

from crisalad_jax.checkpoint import model_hash
from crisalad_jax.cli.common import console, model_of
from crisalad_jax.config import ModelConfig
from crisalad_jax.data.images import list_images, names_in
from crisalad_jax.data.positions import read_positions, utm_positions
from crisalad_jax.errors import InputError
from crisalad_jax.groupings import check_grouping
from crisalad_jax.indexing import index_images
from crisalad_jax.map_description import (
    MapDescription,
    check_model,
    describe_map,
    has_images,
    read_description,
)
from crisalad_jax.maps import open_for_appending
from crisalad_jax.model import Crisalad
from crisalad_jax.stores import store_name


@dataclasses.dataclass(frozen=True)
class Index:
    """Make a map of a folder of images, or append to it those that it lacks."""

    weights: pathlib.Path
    """A .safetensors file of this package; of a map that is there, the same model's."""
    images: pathlib.Path
    """Folder, searched with its subfolders; the map names images by their paths in it."""
    out: pathlib.Path
    """The map's folder. After a kill the same command goes on."""
    positions: pathlib.Path | None = None
    """CSV of name,east,north (metres) or name,lat,lon, for images that are new; by default what
    @UTM names say."""
    store: str | None = None
    """files, in the map's folder, or milvus:URI, a file name.db or http://host:port; by default the
    map's, and of a new map files."""
    dtype: Literal["float32", "float16"] | None = None
    """What files keep descriptors as, by default the map's, and in a new map float32."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of 14; by default the map's, and of a new map the model's."""
    batch_size: int = 16
    """Images described at once, each as if it were alone."""
    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the map's, and in a new map the model's."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and say so."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Index) -> None:
    """Describe the images that the map lacks, and append them."""
    check_grouping((), arguments.batch_size, seed=0)
    found = read_description(arguments.out)
    if not has_images(arguments.out):
        found = None  # what a kill left before there was an image binds to nothing
    paths = list_images(arguments.images)
    names = names_in(arguments.images, paths)
    here = set(names)
    if arguments.positions is None:
        positions = utm_positions(names)
    else:
        positions = read_positions(arguments.positions)
        if positions.of.keys().isdisjoint(names):
            raise InputError(
                f"{arguments.positions}: found none of the {len(names)} images of "
                f"{arguments.images}, expected names such as {names[0]!r}"
            )
    params, config, _ = model_of(
        arguments.weights,
        image_size=arguments.image_size,
        compute_dtype=arguments.compute_dtype,
    )
    description = _new(arguments, params, config) if found is None else found
    if found is not None:
        check_model(found, arguments.out, model_hash(params, config), arguments.weights)
        _check_settings(arguments, found)
    with open_for_appending(arguments.out, description) as target:
        result = index_images(
            target,
            params,
            arguments.images,
            paths,
            positions=positions,
            batch_size=arguments.batch_size,
            on_bad_image=arguments.on_bad_image,
            quiet=arguments.quiet,
        )
        count = len(target)
        if not count:
            raise InputError(
                f"{arguments.images}: found {len(paths)} images, none of them readable"
            )
    given = [] if arguments.positions is None else list(positions.of)
    stay = result.stay if given else 0
    strange = [name for name in given if name not in here]
    console.print(
        f"{arguments.out}: {result.added} images added, {result.positions} with positions"
        + (f"; {result.there} were there already" if result.there else "")
        + (f"; {stay} positions given are of such, and stay as they are" if stay else "")
        + (
            f"; {len(strange)} positions given are of no image here, {strange[0]!r} the first"
            if strange
            else ""
        )
        + (f"; {len(result.unreadable)} unreadable left out" if result.unreadable else "")
        + f"; {count} descriptors of {description.descriptor_length} numbers ({description.store})",
        soft_wrap=True,
    )


def _new(arguments: Index, params: Crisalad, config: ModelConfig) -> MapDescription:
    return describe_map(
        params,
        config,
        arguments.weights,
        arguments.out,
        store=arguments.store or "files",
        dtype=arguments.dtype or "float32",
    )


def _check_settings(arguments: Index, found: MapDescription) -> None:
    """Flags, where they are given, that a map which is there has to agree with."""
    store = arguments.store and store_name(arguments.store, arguments.out, found.dtype)
    for name, given, there in (
        ("image size", arguments.image_size, found.config.image_size),
        ("compute dtype", arguments.compute_dtype, found.config.compute_dtype),
        ("dtype", arguments.dtype, found.dtype),
        ("store", store, found.store),
    ):
        if given is not None and given != there:
            raise InputError(
                f"{arguments.out}: found {name} {given}, expected {there} as in the map"
            )
