"""The cache of published models: each is downloaded once, checked, and stored as a weight file.

The folder of a model, `user_cache() / "models" / NAME`, holds the published file, the weight file
that was converted from it, and a record with the published file's SHA-256 at the first download.
"""

import contextlib
import importlib.util
import os
import pathlib
import urllib.parse
from typing import Any

import jax

from crisalad_jax.checkpoints.matlab_io import MATLAB_SUFFIX
from crisalad_jax.checkpoints.public import read_checkpoint, read_vocabulary
from crisalad_jax.checkpoints.published import PUBLISHED, Published
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.download import OFFLINE, MissingFileError, download, is_offline
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, user_cache, write_json
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.version import VERSION

MIRROR = "CRISALAD_MIRROR"
"""Environment variable with the base URL of a mirror, tried before a file's published address."""
_RECORD = "record.json"
"""Name of the record of a published model, next to its weights in the cache."""


def is_cached(model: Published) -> bool:
    """Return whether the weights of a published model are in the cache."""
    return _weights(model).is_file()


def cached_weights(model: Published, *, quiet: bool = False) -> pathlib.Path:
    """Return a published model's weight file; download and convert the model the first time.

    If several processes need it, one downloads and the others wait. The weight file has its own
    checksum, which `load_weights` checks. If another version of this package wrote the weight file,
    the cached published file is converted again; its SHA-256 must still be that of the download.

    Args:
        model: the published model, as `published_model` returns it.
        quiet: whether to hide the progress bar.

    Returns:
        The path of the weight file, a .safetensors file of this package in the cache.

    Raises:
        InputError: the download fails, or is impossible because the network is disabled or no
            address is known; the published file is unreadable, differs from the first download, or
            is not this model; torch is needed but not installed; or the cache cannot be written to.
    """
    if not _is_ready(model):
        try:
            _make(model, quiet=quiet)
        except InputError as error:
            raise InputError(f"{model.name}: {error}") from error
    return _weights(model)


def _make(model: Published, *, quiet: bool) -> None:
    """Download a published model if needed, and convert it.

    A file that was just downloaded is removed if it is not the model.
    """
    published = _folder(model) / model.file
    is_torch = published.suffix not in (MATLAB_SUFFIX, ".safetensors")
    if is_torch and importlib.util.find_spec("torch") is None:
        raise InputError(
            f"found no torch to read {model.file}: pip install 'crisalad-jax[convert]'"
        )
    if not published.is_file():
        _addresses(model)  # before a folder is made
    with lock(_folder(model), wait=3600):
        if _is_ready(model):
            return
        address = None if published.is_file() else _download(model, quiet=quiet)
        try:
            _convert(model, published, address, quiet=quiet)
        except InputError:
            if address is not None:
                published.unlink()
            raise


def _folder(model: Published) -> pathlib.Path:
    return user_cache() / "models" / model.name


def _weights(model: Published) -> pathlib.Path:
    return _folder(model) / f"{model.name}.safetensors"


def _is_ready(model: Published) -> bool:
    """Return whether weights made by this version of the package exist."""
    if not _weights(model).is_file():
        return False
    # If the published file was removed to save space, they cannot be made again.
    published = _folder(model) / model.file
    return not published.is_file() or _record(model).get("version") == VERSION


def _record(model: Published) -> dict[str, Any]:
    """Read the record of the published file; it is empty before the first download."""
    path = _folder(model) / _RECORD
    return read_json(path, "the record of a download") if path.exists() else {}


def _addresses(model: Published) -> list[str]:
    """Return where to look for the file: the mirror, if there is one, and its published address.

    Raises:
        InputError: downloads are disabled.
    """
    if is_offline():
        raise InputError(f"found none in the cache {user_cache()}: {OFFLINE} forbids the network")
    mirror = os.environ.get(MIRROR)
    if mirror and not mirror.startswith(("http://", "https://", "file://")):
        raise InputError(f"{MIRROR}: found {mirror!r}, expected https://HOST or file:///FOLDER")
    mirrors = [f"{mirror.rstrip('/')}/{urllib.parse.quote(model.file)}"] if mirror else []
    addresses = mirrors + ([] if model.url is None else [model.url])
    if not addresses:
        raise InputError(
            f"found no separate address for {model.file}, expected it as "
            f"{_folder(model) / model.file} (download it by hand from {model.repository}: "
            f"{model.note})"
        )
    return addresses


def _download(model: Published, *, quiet: bool) -> str:
    """Download the published file, from the mirror if that has it; return its address."""
    target = _folder(model) / model.file
    *mirrors, last = _addresses(model)
    for address in mirrors:
        with contextlib.suppress(MissingFileError):
            download(address, target, label=model.name, quiet=quiet)
            return address
        warn(f"{address}: found no such file; trying {last}")
    try:
        download(last, target, label=model.name, quiet=quiet)
    except MissingFileError as error:
        raise InputError(f"{error}; it may have moved: {model.repository}") from error
    return last


def _convert(
    model: Published, published: pathlib.Path, address: str | None, *, quiet: bool
) -> None:
    """Convert the published file to weights, and write its record.

    Args:
        model: the model.
        published: its file.
        address: where it was downloaded from just now; None if the file was there before.
        quiet: whether to hide the progress bar.

    Raises:
        InputError: the file is not the recorded one, or not the model.
    """
    record, digest = _record(model), sha256_of(published)
    if digest != record.get("sha256", digest):
        raise InputError(
            f"{published}: found SHA-256 {digest[:12]}..., expected {record['sha256'][:12]}... as "
            f"at the first download: the file was changed (remove {published.parent} to "
            "download it again)"
        )
    if model.backbone:  # a vocabulary, whose backbone is in the cache too
        backbone = cached_weights(PUBLISHED[model.backbone], quiet=quiet)
        checkpoint = read_vocabulary(published, backbone)
    else:
        checkpoint = read_checkpoint(published)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(checkpoint.params))
    found = checkpoint.config.descriptor_dim, parameters
    if found != (model.descriptor, model.parameters):
        raise InputError(
            f"{published}: found {found[0]} dimensions and {found[1]} parameters "
            f"({checkpoint.format}), expected {model.descriptor} and {model.parameters}"
        )
    extras, restriction = checkpoint.extras, model.restriction
    save_weights(_weights(model), checkpoint.model, extras=extras, restriction=restriction)
    url = address or record.get("url")
    known = {"url": url, "file": model.file, "sha256": digest, "version": VERSION}
    write_json(_folder(model) / _RECORD, known)
