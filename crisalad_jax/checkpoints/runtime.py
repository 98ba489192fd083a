"""A model in another engine than JAX: an exported folder, opened. Nothing here imports jax.

Of a file of weights the export is made once, and kept in the user's cache.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import pathlib
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from crisalad_jax.checkpoints.engines import EngineName, Precision, Program, load_program
from crisalad_jax.config.checks import choose
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.config.preprocessing import PreprocessingConfig, Size
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.loader import ImageBatch
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, user_cache
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.version import VERSION

if TYPE_CHECKING:
    from crisalad_jax.nn.config import ModelConfig

FORMAT = "crisalad-jax export 1"
MANIFEST = "manifest.json"
DESCRIBE, TOKENS, ATTEND = "describe", "tokens", "attend"
"""Names of programs: of images to descriptors, or of the two halves of that."""
SUFFIXES = {"onnx": (".onnx", ".onnx.data"), "openvino": (".xml", ".bin")}
"""Suffixes of a program and of its weights, by format."""
_READS: Mapping[str, tuple[str, ...]] = {
    "onnxruntime": ("onnx",),
    "openvino": ("openvino", "onnx"),
}
"""Formats that an engine reads, its own first."""


@brief
@dataclasses.dataclass(frozen=True)
class Runtime:
    """A model in an engine, in place of its parameters.

    Its descriptors are those of `describe` for images of one size.
    """

    folder: pathlib.Path
    """The exported folder."""
    engine: EngineName
    digest: str
    """The `model_hash` of the weights that were exported; of an int8 program one of its own."""
    quantised_from: str | None
    """The `model_hash` of the weights that an int8 program was made of."""
    grouping: str
    """What the programs are for; see `export.GROUPINGS`."""
    dim: int
    """Numbers in a descriptor."""
    input_size: Size
    """Height and width of the images that the programs take."""
    fixed_batch: int | None
    """Number of images of every call; None is any."""
    preparation: Preparation
    """How photographs are prepared."""
    precision: Precision
    """Type of the matrix products."""
    model: Mapping[str, Any]
    """The configuration of the model that was exported, as JSON values."""
    _first: Program
    _second: Program | None

    @functools.cached_property
    def config(self) -> "ModelConfig":
        """The model's configuration, at the size and in the type that this engine computes."""
        from crisalad_jax.nn.config import ModelConfig

        config = from_plain(ModelConfig, self.model, source=str(self.folder))
        return dataclasses.replace(
            config,
            image_size=self.preparation.image_size,
            preprocessing=self.preparation.preprocessing,
            compute_dtype=self.precision,
        )

    @property
    def row_length(self) -> int:
        """Number of values in the row of an image's tokens."""
        return self.dim if self._second is None else self.config.unprojected_dim

    @property
    def row_dtype(self) -> str:
        """Type of the values in rows of tokens."""
        return "float32"

    def check_size(self, size: Size) -> None:
        """Accept all sizes: `open_runtime` checked that images are prepared for the program."""

    def check_groupings(self, groupings: Iterable[str]) -> None:
        """Check that the program can describe images under these groupings.

        Raises:
            InputError: it is for images that are described alone, or for a whole call's together.
        """
        if not self.model["cross_image"]["layers"] or self.grouping == "any":
            return
        wanted = {kind for grouping in groupings for kind in grouping.split("/")}
        if self.grouping == "batch" or wanted != {"single"}:
            others = ", ".join(sorted(wanted))
            raise InputError(
                f"{self.folder}: found a program of grouping {self.grouping}, expected "
                f"{'single or any' if wanted == {'single'} else 'any'}, for images of grouping "
                f"{others} (`crisalad export --grouping`)"
            )

    def tokens(self, batches: Iterable[ImageBatch]) -> Iterator[tuple[np.ndarray, ImageBatch]]:
        """Yield each batch with a row of numbers for each of its images, which `attend` reads."""
        for batch in batches:
            yield self._rows(batch.images), batch

    def describe(self, images: np.ndarray) -> np.ndarray:
        """Describe prepared images, each as if it were alone (or all together: `grouping`).

        Args:
            images: (image, height, width, 3) of `input_size`, as `preparation` makes them.

        Returns:
            Descriptors (image, dim).

        Raises:
            InputError: images of another shape or type.
        """
        rows = self._rows(images)
        return self.attend(rows[None], np.eye(len(rows), dtype=bool)[None])[0]

    def _rows(self, images: np.ndarray) -> np.ndarray:
        expected = (*self.input_size, 3)
        if images.shape[1:] != expected or images.dtype != self.preparation.dtype:
            raise InputError(
                f"images: found {images.dtype} {images.shape}, expected "
                f"{np.dtype(self.preparation.dtype)} (image, {', '.join(map(str, expected))}) for "
                f"{self.folder}"
            )
        size = self.fixed_batch
        if size is None or len(images) == size:
            return self._first(images)
        parts = [images[start : start + size] for start in range(0, len(images), size)]
        filled = (np.resize(part, (size, *expected)) for part in parts)
        return np.concatenate([self._first(each) for each in filled])[: len(images)]

    def attend(self, rows: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Make descriptors of the tokens of some groups of images.

        Args:
            rows: of `tokens`, (group, image, number).
            mask: `mask[g, i, j]` allows image i of group g to attend to image j of it.

        Returns:
            Descriptors (group, image, dim).
        """
        if self._second is None:
            return rows
        lonely = ~mask.any(axis=2, keepdims=True) & np.eye(mask.shape[1], dtype=bool)
        return np.stack([self._second(*group) for group in zip(rows, mask | lonely, strict=True)])


def open_runtime(
    source: str | os.PathLike[str],
    engine: EngineName,
    *,
    image_size: Size | None = None,
    preprocessing: PreprocessingConfig | Mapping[str, Any] | None = None,
    precision: Precision = "float32",
    any_grouping: bool = False,
    digest: str | None = None,
    verify: bool = True,
) -> Runtime:
    """Open a model in an engine.

    JAX is imported only where `source` is a file of weights that was not exported before.

    Args:
        source: a folder of `crisalad export` in a format that the engine reads, or a file of
            weights of this package.
        engine: "onnxruntime" or "openvino".
        image_size: height and width; None is the model's.
        preprocessing: how images are resized; None is the model's way.
        precision: type of the matrix products: bfloat16 is OpenVINO's alone.
        any_grouping: whether images are to look at each other in other ways than `source`, a file,
            would be exported for: each alone.
        digest: the model that it has to be; None is any.
        verify: whether to compare files with their checksums.

    Returns:
        The model.

    Raises:
        InputError: the engine is not installed; there is no such folder or file, or it is damaged,
            of another format, model or image size; or what `write_export` raises.

    Example:
        >>> import jax, numpy as np
        >>> from crisalad_jax import PRESETS, ExportConfig, Model, init_crisalad, write_export
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> how = ExportConfig(format="onnx")
        >>> _ = write_export(folder / "onnx", Model(params, config), how)
        >>> runtime = open_runtime(folder / "onnx", "onnxruntime")
        >>> runtime.describe(np.zeros((2, 98, 98, 3), np.uint8)).shape
        (2, 576)
    """
    choose("runtime", engine, _READS)
    path = pathlib.Path(source)
    is_folder = path.is_dir()
    if not is_folder:
        path = _exported(path, engine, image_size, preprocessing, any_grouping)
    manifest = _manifest(path, engine)
    if digest is not None and manifest["model_sha256"] != digest:
        raise InputError(
            f"{source}: found a program of other weights (model {manifest['model_sha256'][:12]}), "
            f"expected one of model {digest[:12]}"
        )
    chain = from_plain(PreprocessingConfig, manifest["model"]["preprocessing"], source=str(path))
    own = Preparation(tuple(manifest["model"]["image_size"]), chain, int(manifest["side_multiple"]))
    wanted = own
    if image_size is not None:
        wanted = dataclasses.replace(wanted, image_size=tuple(image_size))
    if preprocessing is not None:
        wanted = dataclasses.replace(wanted, preprocessing=_as_config(preprocessing))
    _check_prepared(path, manifest, own, wanted)
    loaded = _load(path, manifest, engine, precision, verify=verify)
    count, height, width, _ = manifest["images"]["shape"]
    return Runtime(
        folder=path,
        engine=engine,
        digest=manifest["model_sha256"],
        quantised_from=manifest.get("quantised_from"),
        grouping=manifest["grouping"],
        dim=manifest["descriptors"]["shape"][1],
        input_size=(height, width),
        fixed_batch=count if isinstance(count, int) else None,
        preparation=wanted,
        precision=precision,
        model=manifest["model"],
        _first=loaded[0],
        _second=loaded[1] if len(loaded) > 1 else None,
    )


def _as_config(preprocessing: PreprocessingConfig | Mapping[str, Any]) -> PreprocessingConfig:
    if isinstance(preprocessing, PreprocessingConfig):
        return preprocessing
    return from_plain(PreprocessingConfig, preprocessing, source="preprocessing")


def _manifest(folder: pathlib.Path, engine: EngineName) -> dict[str, Any]:
    """Read the manifest of an export that the engine reads."""
    path = folder / MANIFEST
    expected = "the manifest of `crisalad export`"
    manifest = read_json(path, expected)
    found = manifest.get("format")
    if found != FORMAT:
        raise InputError(f"{path}: found format {found!r}, expected {FORMAT!r}: {expected}")
    kind = manifest["program_format"]
    if kind not in _READS[engine]:
        raise InputError(
            f"{folder}: found a program of format {kind}, expected {' or '.join(_READS[engine])} "
            f"for {engine}: `crisalad export --format {_READS[engine][0]}`"
        )
    return manifest


def _check_prepared(
    folder: pathlib.Path, manifest: Mapping[str, Any], own: Preparation, wanted: Preparation
) -> None:
    """Check that images which are prepared as wanted are those that the program takes."""
    rule = wanted.preprocessing.size_rule
    if rule != "fixed":
        raise InputError(
            f"{folder}: found images of size rule {rule}, expected fixed: a program takes one size "
            "(--resize fixed)"
        )
    size, expected = wanted.size_of(wanted.image_size), tuple(manifest["images"]["shape"][1:3])
    if size != expected:
        words = (" x ".join(map(str, each)) for each in (expected, size))
        raise InputError(f"{folder}: found a program for images of {'; expected '.join(words)}")
    dtype = np.dtype(wanted.dtype)
    if str(dtype) != manifest["images"]["dtype"]:
        raise InputError(
            f"{folder}: found a program of {manifest['images']['dtype']}, expected {dtype}, which "
            "this model's images are resized to (`crisalad export --pixels`)"
        )
    same = ("normalisation", "mean", "deviation")
    if any(getattr(own.preprocessing, n) != getattr(wanted.preprocessing, n) for n in same):
        raise InputError(f"{folder}: found another normalisation than was asked for")


def _load(
    folder: pathlib.Path,
    manifest: Mapping[str, Any],
    engine: EngineName,
    precision: Precision,
    *,
    verify: bool,
) -> list[Program]:
    """Load the programs, while the bytes of their files are compared with their checksums."""
    parts = [manifest, manifest[ATTEND]] if ATTEND in manifest else [manifest]
    entries = [part[name] for part in parts for name in ("program", "weights") if part[name]]
    for entry in entries:
        path = folder / entry["file"]
        found = path.stat().st_size if path.is_file() else None
        if found != entry["bytes"]:
            words = "no such file" if found is None else f"{found} bytes"
            raise InputError(f"{path}: found {words}, expected {entry['bytes']} bytes")
    with concurrent.futures.ThreadPoolExecutor() as pool:
        digests = [pool.submit(sha256_of, folder / entry["file"]) for entry in entries if verify]
        failure = None
        programs: list[Program] = []
        try:
            for part in parts:
                programs.append(load_program(engine, folder / part["program"]["file"], precision))
        except InputError as error:  # which a changed file explains better
            failure = error
        for entry, digest in zip(entries, digests, strict=False):
            if digest.result() != entry["sha256"]:
                raise InputError(
                    f"{folder / entry['file']}: found other bytes than {MANIFEST} says, expected "
                    "the file as it was exported"
                )
        if failure is not None:
            raise failure
    return programs


def _exported(
    weights: pathlib.Path,
    engine: EngineName,
    image_size: Size | None,
    preprocessing: PreprocessingConfig | Mapping[str, Any] | None,
    any_grouping: bool,
) -> pathlib.Path:
    """Return the exported folder of a file of weights in the cache; export it the first time."""
    header = read_header(weights)
    plain = header["config"]
    settings = {  # a damaged file may lack some, which `_export` refuses
        "image_size": list(image_size or plain.get("image_size", ())),
        "preprocessing": plain.get("preprocessing")
        if preprocessing is None
        else to_plain(_as_config(preprocessing)),
        "format": _READS[engine][0],
        "grouping": "any" if any_grouping else "single",
        "version": VERSION,
    }
    folder = _cached(header["model_sha256"], settings)
    if not (folder / MANIFEST).is_file():
        _export(weights, settings, folder)
    return folder


def _cached(digest: str, settings: Mapping[str, Any]) -> pathlib.Path:
    key = json.dumps({"model": digest, **settings}, sort_keys=True)
    return user_cache() / "exports" / hashlib.sha256(key.encode()).hexdigest()[:32]


def read_header(weights: str | os.PathLike[str]) -> dict[str, Any]:
    """Read what a file of weights says of its model, without its arrays.

    Its bytes are not compared with its checksum: the export is, and it was made of bytes that were.

    Args:
        weights: the file.

    Returns:
        The metadata, with "model_sha256" and "config", a `ModelConfig` as JSON values.

    Raises:
        InputError: what `load_weights` raises, for a file without such metadata.
    """
    import safetensors

    with contextlib.suppress(safetensors.SafetensorError, OSError, ValueError):
        with safetensors.safe_open(weights, framework="numpy") as file:
            values = [json.loads(value) for value in (file.metadata() or {}).values()]
        for value in values:
            if isinstance(value, dict) and {"model_sha256", "config"} <= value.keys():
                return value
    from crisalad_jax.checkpoints.weights import load_weights

    load_weights(weights)
    raise AssertionError("no header")  # which `load_weights` has told of


def read_model(source: str | os.PathLike[str]) -> "ModelConfig":
    """Read the configuration in a file of weights or an exported folder, without its arrays.

    Raises:
        InputError: what `read_header` raises, or of the manifest or the configuration.
    """
    from crisalad_jax.nn.config import ModelConfig

    if os.path.isdir(source):
        manifest = read_json(pathlib.Path(source) / MANIFEST, "the manifest of `crisalad export`")
        plain = {**manifest["model"], "compute_dtype": "float32"}  # which its numbers are
        return from_plain(ModelConfig, plain, source=str(source))
    return from_plain(ModelConfig, read_header(source)["config"], source=f"{source} (metadata)")


def _export(weights: pathlib.Path, settings: Mapping[str, Any], folder: pathlib.Path) -> None:
    from crisalad_jax.checkpoints.export import ExportConfig, write_export
    from crisalad_jax.checkpoints.weights import load_weights
    from crisalad_jax.nn.model import Model

    params, config = load_weights(weights)
    config = dataclasses.replace(
        config,
        image_size=tuple(settings["image_size"]),
        preprocessing=_as_config(settings["preprocessing"]),
        compute_dtype="float32",
    )
    if config.preprocessing.size_rule != "fixed":
        raise InputError(
            f"{weights}: found images of size rule {config.preprocessing.size_rule}, expected "
            "fixed: a program takes one size (--resize fixed)"
        )
    with lock(folder.parent, wait=True):
        if not (folder / MANIFEST).is_file():
            warn(f"{weights}: exporting it for --runtime, once; into {folder}")
            how = ExportConfig(settings["grouping"], format=settings["format"])
            write_export(folder, Model(params, config), how)
