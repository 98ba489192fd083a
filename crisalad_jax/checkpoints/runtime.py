"""Open an exported folder, or a weight file, as a model in an engine other than JAX.

A weight file is exported once, into the user's cache. Importing this module does not import jax.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import os
import pathlib
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from crisalad_jax.checkpoints.engines import (
    READS,
    EngineName,
    NotExportableError,
    Precision,
    Program,
    load_program,
)
from crisalad_jax.checkpoints.safetensors_io import read_header
from crisalad_jax.config.checks import choose
from crisalad_jax.config.io import from_plain
from crisalad_jax.config.plugins import loaded_plugins
from crisalad_jax.config.preprocessing import PreprocessingConfig, Size
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.loader import ImageBatch
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.utils.checksums import ChangedFileError, sha256_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path, read_json, user_cache
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.version import VERSION

if TYPE_CHECKING:
    from crisalad_jax.nn.config import ModelConfig

FORMAT = "crisalad-jax export 1"
MANIFEST = "manifest.json"
_EXPECTED = "the manifest of `crisalad export`"
DESCRIBE, TOKENS, ATTEND = "describe", "tokens", "attend"
"""Names of the programs: images to descriptors, images to tokens, and tokens to descriptors."""


@brief
@dataclasses.dataclass(frozen=True)
class Runtime:
    """A model opened in an engine other than JAX, to use in place of a `Model`.

    It computes the same descriptors as `describe`, for images of one size.
    """

    folder: pathlib.Path
    """The exported folder."""
    engine: EngineName
    digest: str
    """The `model_hash` of the exported weights; an int8 program has its own digest."""
    quantised_from: str | None
    """The `model_hash` of the weights that an int8 program was made from; None for float32."""
    grouping: str
    """Which images attend to each other: "single", "batch" or "any" (`export.GROUPINGS`)."""
    attends: bool
    """Whether a descriptor depends on the other images of its batch."""
    dim: int
    """Dimensions of a descriptor."""
    input_size: Size
    """Height and width of the images that the programs take."""
    fixed_batch: int | None
    """Number of images that each call of the program takes; None if any number."""
    preparation: Preparation
    """How photographs are prepared for the programs."""
    model: Mapping[str, Any]
    """The configuration, with the image size and compute type of this engine, as JSON values."""
    _first: Program
    _second: Program | None
    row_dtype = "float32"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the bytes of the exported files, so that another machine can open the model."""
        files = {path.name: path.read_bytes() for path in self.folder.iterdir() if path.is_file()}
        return _opened, (files, self.engine, self.model)

    @functools.cached_property
    def config(self) -> "ModelConfig":
        """The model's configuration, with the image size and compute type of this engine."""
        from crisalad_jax.nn.config import ModelConfig

        return from_plain(ModelConfig, self.model, source=str(self.folder))

    @property
    def row_length(self) -> int:
        """Number of values in the row that `tokens` returns for an image."""
        return self.dim if self._second is None else self.config.unprojected_dim

    def check_groupings(self, groupings: Iterable[str]) -> None:
        """Check that the model can describe images under groupings such as "window/single".

        Raises:
            InputError: the model was exported for another grouping.
        """
        if not self.attends or self.grouping == "any":
            return
        wanted = {kind for grouping in groupings for kind in grouping.split("/")}
        if self.grouping == "batch" or wanted != {"single"}:
            raise InputError(
                f"{self.folder}: found a program of grouping {self.grouping}, expected any, for "
                f"images of grouping {', '.join(sorted(wanted))} (`crisalad export --grouping`)"
            )

    def tokens(self, batches: Iterable[ImageBatch]) -> Iterator[tuple[np.ndarray, ImageBatch]]:
        """Yield (rows, batch) for each batch: rows (image, row_length) of tokens, for `attend`."""
        for batch in batches:
            yield self._rows(batch.images), batch

    def describe(self, images: np.ndarray) -> np.ndarray:
        """Describe prepared images: each independently, or together if `grouping` is "batch".

        Args:
            images: (image, height, width, 3) of `input_size`, as `preparation` makes them.

        Returns:
            Descriptors (image, dim).

        Raises:
            InputError: the images have another shape or type.
        """
        rows = self._rows(images)
        return self.attend(rows[None], np.eye(len(rows), dtype=bool)[None])[0]

    def _rows(self, images: np.ndarray) -> np.ndarray:
        expected = (*self.input_size, 3)
        if images.shape[1:] != expected or images.dtype != self.preparation.dtype:
            raise InputError(
                f"{self.folder}: found images of {images.dtype} {images.shape}, expected "
                f"{np.dtype(self.preparation.dtype)} (image, {', '.join(map(str, expected))})"
            )
        size = self.fixed_batch
        if size is None:
            return self._first(images)
        parts = [images[start : start + size] for start in range(0, len(images), size)]
        filled = (np.resize(part, (size, *expected)) for part in parts)
        return np.concatenate([self._first(each) for each in filled])[: len(images)]

    def attend(self, rows: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Compute descriptors from the tokens of groups of images.

        Args:
            rows: rows from `tokens`, (group, image, row_length).
            mask: booleans; `mask[g, i, j]` lets image i of group g attend to image j.

        Returns:
            Descriptors (group, image, dim). Unless `grouping` is "any", they are the rows as given.
        """
        if self._second is None:
            return rows
        lonely = ~mask.any(axis=2, keepdims=True) & np.eye(mask.shape[1], dtype=bool)
        return np.stack([self._second(*group) for group in zip(rows, mask | lonely, strict=True)])


def open_runtime(
    source: str | os.PathLike[str],
    engine: EngineName,
    config: Mapping[str, Any] | None = None,
    *,
    any_grouping: bool = False,
    verify: bool = True,
) -> Runtime:
    """Open a model in an engine other than JAX.

    JAX is imported only if `source` is a weight file that was not exported before.

    Args:
        source: a folder that `crisalad export` wrote in a format that the engine reads, or a
            weight file of this package.
        engine: "onnxruntime" or "openvino".
        config: a `ModelConfig` as JSON values, which sets image size, preprocessing and compute
            type; None uses the model's own, in float32. Only OpenVINO supports bfloat16.
        any_grouping: whether to export a weight file for any grouping of images, rather than for
            images that are described independently.
        verify: whether to compare files with their checksums.

    Returns:
        The model.

    Raises:
        InputError: the folder or file is missing or damaged; the engine does not read its format;
            its image size or type differs from `config`; or a weight file cannot be exported.
        ModuleNotFoundError: the engine is not installed.

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
    choose("runtime", engine, READS)
    path = pathlib.Path(source)
    changes = {} if config is None else _changes(config)
    if changes.get("compute_dtype") == "float64":
        raise InputError(f"{path}: found a model of float64 for {engine}, expected jax")
    if not path.is_dir():
        path = _exported(path, engine, changes, any_grouping)
    manifest = read_json(path / MANIFEST, _EXPECTED)
    if manifest.get("format") != FORMAT:
        found = manifest.get("format")
        raise InputError(f"{path / MANIFEST}: found format {found!r}, expected {FORMAT!r}")
    if manifest["program_format"] not in READS[engine]:
        raise InputError(
            f"{path}: found a program of format {manifest['program_format']}, expected "
            f"{' or '.join(READS[engine])} for {engine} (`crisalad export --format`)"
        )
    model = manifest["model"] | {"compute_dtype": "float32"} | changes
    preparation = _preparation(path, manifest, model)
    first, *second = _load(path, manifest, engine, model["compute_dtype"], verify=verify)
    count, height, width, _ = manifest["images"]["shape"]
    return Runtime(
        folder=path,
        engine=engine,
        digest=manifest["model_sha256"],
        quantised_from=manifest.get("quantised_from"),
        grouping=manifest["grouping"],
        attends=manifest["attends_across_images"],
        dim=manifest["descriptors"]["shape"][1],
        input_size=(height, width),
        fixed_batch=count if isinstance(count, int) else None,
        preparation=preparation,
        model=model,
        _first=first,
        _second=second[0] if second else None,
    )


def fastest_engine(
    source: str | os.PathLike[str], config: Mapping[str, Any], *, any_grouping: bool = False
) -> EngineName | Literal["jax"]:
    """Choose the fastest engine for single images, among those that compute what JAX does.

    Only installed engines are considered: ONNX Runtime first, then OpenVINO, which is as fast but
    takes longer to start (docs/performance.md). A weight file is exported for the engine once, and
    its descriptors are compared with JAX's. It runs in JAX if JAX may have an accelerator, if
    plug-ins are loaded, if `config` isn't float32 at a fixed image size, or if no engine works.

    Args:
        source: a weight file, or an exported folder.
        config: the `ModelConfig` to describe images with, as JSON values.
        any_grouping: whether images may attend to each other, as `open_runtime` takes it.

    Raises:
        InputError: `source` is an exported folder that no installed engine reads.
    """
    names: tuple[EngineName, ...] = get_args(EngineName)  # in their order
    installed: list[EngineName] = [name for name in names if importlib.util.find_spec(name)]
    path = pathlib.Path(source)
    dtype = config["compute_dtype"]
    if path.is_dir():
        kind = read_json(path / MANIFEST, _EXPECTED).get("program_format")
        for engine in installed:
            if kind in READS[engine] and not (dtype == "bfloat16" and engine == "onnxruntime"):
                return engine
        readers = " or ".join(name for name in READS if kind in READS[name])
        raise InputError(
            f"{path}: found a program of format {kind}, and nothing installed that reads it, "
            f"expected {readers or 'one of format onnx or openvino'}"
        )
    fits = dtype == "float32" and config["preprocessing"]["size_rule"] == "fixed"
    if not fits or loaded_plugins() or _has_accelerator():
        return "jax"
    for engine in installed:
        with contextlib.suppress(Exception):  # JAX is used then, and the user sees its errors
            _exported(path, engine, _changes(config), any_grouping, wait=0)
            return engine
    return "jax"


def _changes(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that may differ from those of the file to export."""
    return {name: config[name] for name in ("image_size", "preprocessing", "compute_dtype")}


def _has_accelerator() -> bool:
    """Return whether JAX may have another platform than CPUs, without importing it."""
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        return False
    plugins = importlib.metadata.entry_points(group="jax_plugins")
    return bool(plugins) or importlib.util.find_spec("libtpu") is not None


def _opened(files: Mapping[str, bytes], engine: EngineName, model: Mapping[str, Any]) -> Runtime:
    """Open an exported folder, given the bytes of its files."""
    with tempfile.TemporaryDirectory() as folder:
        for name, data in files.items():
            pathlib.Path(folder, name).write_bytes(data)
        return open_runtime(folder, engine, model)


def _preparation(
    folder: pathlib.Path, manifest: Mapping[str, Any], model: Mapping[str, Any]
) -> Preparation:
    """Return how to prepare images as `model` says, if the program takes such images.

    Raises:
        InputError: it does not.
    """
    own, chain = (
        from_plain(PreprocessingConfig, each["preprocessing"], source=str(folder))
        for each in (manifest["model"], model)
    )
    _check_fixed(folder, chain.size_rule)
    images, (height, width) = manifest["images"], model["image_size"]
    wanted = Preparation((height, width), chain, int(manifest["side_multiple"]))
    taken = _words(images["shape"][1:3], images["dtype"], own)
    given = _words(wanted.size_of(wanted.image_size), np.dtype(wanted.dtype), chain)
    if taken != given:
        raise InputError(
            f"{folder}: found a program for images of {taken}, expected {given} (`crisalad "
            "export` with these flags, and --pixels)"
        )
    return wanted


def _words(size: Sequence[int], dtype: object, chain: PreprocessingConfig) -> str:
    """Describe the images that a program takes: their size, type and normalisation."""
    height, width = size
    return (
        f"{height} x {width}, {dtype}, normalised by {chain.normalisation} {chain.mean} "
        f"{chain.deviation}"
    )


def _check_fixed(source: pathlib.Path, rule: str) -> None:
    """Check that images have a fixed size, which programs require."""
    if rule != "fixed":
        raise InputError(f"{source}: found images of size rule {rule}, expected --resize fixed")


def _load(
    folder: pathlib.Path,
    manifest: Mapping[str, Any],
    engine: EngineName,
    precision: Precision,
    *,
    verify: bool,
) -> list[Program]:
    """Load the programs while comparing their files with the checksums."""
    parts = [manifest, manifest[ATTEND]] if ATTEND in manifest else [manifest]
    entries = [part[name] for part in parts for name in ("program", "weights") if part[name]]
    for entry in entries:
        if os.path.basename(entry["file"]) != entry["file"]:
            raise InputError(f"{folder}: found file {entry['file']!r}, expected a bare file name")
    files = {folder / entry["file"]: entry["sha256"] for entry in entries}
    with concurrent.futures.ThreadPoolExecutor() as pool:
        digests = pool.map(sha256_of, files if verify else ())
        try:
            return [
                load_program(engine, folder / part["program"]["file"], precision) for part in parts
            ]
        finally:  # a changed file explains best why an engine cannot load it
            for file, digest in zip(files, digests, strict=False):
                if digest != files[file]:
                    if user_cache() not in folder.parents:
                        raise ChangedFileError(file)
                    advice = f"remove {folder}, and the same command makes it again"
                    raise InputError(f"{ChangedFileError(file)}; {advice}")


def _exported(
    weights: pathlib.Path,
    engine: EngineName,
    changes: Mapping[str, Any],
    any_grouping: bool,
    *,
    wait: float = 3600,
) -> pathlib.Path:
    """Return the exported folder of a weight file in the cache; export it the first time.

    `wait` is how many seconds to wait for another process that is exporting.
    """
    header = read_header(weights)
    model = header["config"] | changes | {"compute_dtype": "float32"}
    how = {"grouping": "any" if any_grouping else "single", "format": READS[engine][0]}
    settings = {"weights": header["model_sha256"], "model": model, **how, "version": VERSION}
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
    folder = user_cache() / "exports" / key[:32]
    refusal = folder.with_suffix(".txt")
    if refusal.is_file():  # otherwise each query would try again, for seconds
        raise NotExportableError(f"{refusal.read_text('utf-8')} (stored in {refusal})")
    if not (folder / MANIFEST).is_file():
        _check_fixed(weights, model["preprocessing"]["size_rule"])
        with lock(folder.parent, wait=wait):
            if not (folder / MANIFEST).is_file():
                try:
                    _export(weights, model, how, folder, engine)
                except NotExportableError as error:
                    with contextlib.suppress(OSError), atomic_path(refusal) as staged:
                        staged.write_text(str(error), "utf-8")
                    raise
    return folder


def _export(
    weights: pathlib.Path,
    model: Mapping[str, Any],
    how: Any,
    folder: pathlib.Path,
    engine: EngineName,
) -> None:
    importlib.import_module("onnx")  # raises before the note if it is not installed
    from crisalad_jax.checkpoints.export import ExportConfig, write_export
    from crisalad_jax.checkpoints.weights import load_weights
    from crisalad_jax.nn.config import ModelConfig

    config = from_plain(ModelConfig, model, source=str(weights))
    check_takes_photographs(config, weights)
    warn(f"{weights}: exporting once for {engine}, into {folder} (--runtime jax needs no export)")
    write_export(folder, load_weights(weights)._replace(config=config), ExportConfig(**how))


def check_takes_photographs(config: "ModelConfig", source: object) -> None:
    """Check that a model takes photographs, which engines need, and not SIFT or ORB features.

    Raises:
        InputError: the model takes features; `source`, its file, begins the message.
    """
    if config.backbone.local_features is not None:
        raise NotExportableError(
            f"{source}: found backbone {config.backbone.part_name}, whose features no engine "
            "computes, expected --runtime jax"
        )


def read_model(source: str | os.PathLike[str]) -> "ModelConfig":
    """Read a model's configuration from a weight file or an exported folder, without arrays.

    Raises:
        InputError: the file is missing or not a weight file, or its configuration is invalid.
    """
    from crisalad_jax.nn.config import ModelConfig

    if os.path.isdir(source):
        manifest = read_json(pathlib.Path(source) / MANIFEST, _EXPECTED)
        plain = {**manifest["model"], "compute_dtype": "float32"}  # the program's type
        return from_plain(ModelConfig, plain, source=str(source))
    return from_plain(ModelConfig, read_header(source)["config"], source=f"{source} (metadata)")
