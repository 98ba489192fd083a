"""The metadata of a map, in map.json: the model, its settings, and where descriptors are.

Nothing here imports JAX until `model_config` is called.
"""

import dataclasses
import datetime
import os
import pathlib
import uuid
from typing import TYPE_CHECKING, Literal

from crisalad_jax.checkpoints.runtime import read_header
from crisalad_jax.checkpoints.starter import FILES, recorded, resolved
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.retrieval.bits import check_packable
from crisalad_jax.retrieval.maps.store import check_store, store_name
from crisalad_jax.retrieval.pca import Pca, load_pca, pca_hash, shortened
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_no_links, read_json
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.temporaries import LOCK, is_temporary

if TYPE_CHECKING:  # a map is searched without JAX
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.retrieval.describer import Describer

METADATA, SEGMENTS = "map.json", "segments"
"""Names of the metadata's file, and of the folder of additions."""
COMPONENTS = "pca.safetensors"
"""Name of the file of components that shorten descriptors."""
_PARTS = (
    *(METADATA, SEGMENTS, COMPONENTS, LOCK, "calibration.json", "calibration-verified.json"),
    *("approximate", "similar", "added"),
)
"""All names that a map may have in its folder."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MapMetadata:
    """The contents of map.json; equal for maps that describe and store images in the same way."""

    model: str
    """The `model_hash` of the model that describes the map's images, and its queries."""
    weights: str = dataclasses.field(compare=False)
    """Where the weights of that model were: a path, or a name in `starter.FILES`."""
    config: dict
    """The model's configuration as JSON values, with the image size and data type of the map's
    images."""
    descriptor_length: int
    store: str = "files"
    """Where descriptors are stored; see `store.store_name`."""
    dtype: str = "float32"
    """Type of the stored descriptors, one of `store.DTYPES`."""
    grouping: str = "single"
    """Always "single": no descriptor depends on other images."""
    collection: str = dataclasses.field(default="", compare=False)
    """Name of the Milvus collection of the descriptors."""
    created: str = dataclasses.field(default="", compare=False)
    pca: str = ""
    """The `pca_hash` of the components that shorten the descriptors of images and queries; "" if
    there are none."""
    format: Literal[4] = 4
    """Version of the format."""

    def __post_init__(self) -> None:
        """Check the store."""
        check_store(self.store, self.dtype)

    @property
    def is_bits(self) -> bool:
        """Whether descriptors are stored, and compared, as bits."""
        return self.dtype == "bits"

    @property
    def row(self) -> tuple[int, str]:
        """Length and type of a descriptor's row in the store."""
        length = self.descriptor_length
        return (length // 8, "uint8") if self.is_bits else (length, self.dtype)

    @property
    def length_words(self) -> str:
        """Length of a descriptor as text."""
        return f"{self.descriptor_length} {'bits' if self.is_bits else 'dimensions'}"


def model_config(metadata: MapMetadata, folder: str | os.PathLike[str]) -> "ModelConfig":
    """Return the configuration of the model that describes the images of a map.

    Raises:
        InputError: the recorded configuration is not one that this package knows.
    """
    from crisalad_jax.nn.config import ModelConfig

    return from_plain(ModelConfig, metadata.config, source=f"{pathlib.Path(folder) / METADATA}")


def new_metadata(
    describer: "Describer",
    weights: str | os.PathLike[str],
    folder: pathlib.Path,
    *,
    store: str = "files",
    dtype: str = "float32",
    pca: Pca | None = None,
) -> MapMetadata:
    """Make the metadata of a new map in `folder`, whose images `describer` will describe.

    Raises:
        InputError: `dtype` is not "bits", and the descriptors would not be unit vectors; `dtype` is
            "bits", and their length is not a multiple of 8; the components were fitted to other
            descriptors; or the store or type is invalid.
    """
    check_store(store, dtype)
    length, _ = shortened(pca, describer, str(weights), unit=dtype != "bits")
    if dtype == "bits":
        check_packable(length, "dtype")
    return MapMetadata(
        model=describer.digest,
        weights=recorded(weights),
        config=to_plain(describer.config),
        descriptor_length=length,
        store=store_name(store, folder),
        dtype=dtype,
        collection=f"crisalad_{uuid.uuid4().hex}",
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        pca="" if pca is None else pca_hash(pca),
    )


def read_metadata(folder: str | os.PathLike[str]) -> MapMetadata | None:
    """Read the metadata of the map in `folder`; None if a new map can be created there.

    A map without images, left by a killed process, counts as none.

    Raises:
        InputError: the folder holds something other than a map, or the map is damaged, of another
            format, or contains a symbolic link.
    """
    folder = pathlib.Path(folder)
    path = folder / METADATA
    for name in _PARTS:
        check_no_links(folder / name, itself=True)
    if not path.exists():
        # A process killed before it has made the map leaves its lock and temporary files behind.
        own = (LOCK, SEGMENTS, COMPONENTS)
        there = [*folder.glob("*"), *(folder / SEGMENTS).glob("*")]
        others = [p for p in there if p.name not in own and not is_temporary(p)]
        if others:
            first = min(path.relative_to(folder).parts[0] for path in others)
            raise InputError(
                f"{folder}: found {first} and no {METADATA}, expected a map or an empty folder"
            )
        return None
    # Users who edit the metadata remove its checksum. A changed key would be an unknown field.
    metadata = from_plain(MapMetadata, read_json(path, "a map", sealed=False), source=str(path))
    return metadata if has_images(folder) else None


def existing_metadata(folder: str | os.PathLike[str]) -> MapMetadata:
    """Read the metadata of the map in `folder`.

    Raises:
        InputError: there is no map, or `read_metadata` cannot read it.
    """
    metadata = read_metadata(folder)
    if metadata is None:
        raise InputError(
            f"{folder}: found no map, expected a folder that `crisalad index` put images into"
        )
    return metadata


def read_components(folder: pathlib.Path, metadata: MapMetadata) -> Pca | None:
    """Read the components that shorten the descriptors of a map; None if it has none.

    Raises:
        InputError: the file is gone, damaged, or of other components.
    """
    if not metadata.pca:
        return None
    pca = load_pca(folder / COMPONENTS)
    if pca_hash(pca) != metadata.pca:
        raise InputError(
            f"{folder / COMPONENTS}: found other components, expected those recorded in {METADATA}"
        )
    return pca


def has_images(folder: pathlib.Path) -> bool:
    """Return whether a folder holds a map with images; a map without any counts as none."""
    return any((folder / SEGMENTS).glob("[0-9]*.json"))


def check_model(
    metadata: MapMetadata,
    folder: str | os.PathLike[str],
    digest: str,
    weights: object,
    quantised_from: str | None = None,
) -> None:
    """Check that a map was made by the model with the hash `digest`, called `weights` in messages.

    An int8 program that was quantised from the map's model is accepted with a warning.

    Raises:
        InputError: the hashes differ; the message has both.
    """
    if quantised_from == metadata.model:
        warn(
            f"{weights}: an int8 program of the model that made {folder}; similarities are rougher"
        )
    elif digest != metadata.model:
        file = FILES.get(metadata.weights)
        is_todays = file is None or read_header(file)["model_sha256"] == metadata.model
        version = "" if is_todays else " of another version of this package"
        raise InputError(
            f"{folder}: found a map made by model {metadata.model[:12]} "
            f"({metadata.weights}{version}), but {weights} is model {digest[:12]}: expected the "
            "same (--weights), or a new map (`crisalad index` into a new folder)"
        )


def weights_of(metadata: MapMetadata, folder: str | os.PathLike[str]) -> pathlib.Path:
    """Return the file of the weights that made a map.

    Raises:
        InputError: the file is no longer where it was.
    """
    file = resolved(metadata.weights)
    if not file.exists():
        raise InputError(
            f"{folder}: found no {file}, which made this map, expected it there or as --weights"
        )
    return file
