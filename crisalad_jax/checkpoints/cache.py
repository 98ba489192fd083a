"""The cache of published models: each is downloaded once, checked, and kept as a weight file.

A model has a folder in `user_cache() / "models"`, with the published file, the file of weights
that was made of it, and a record of the published file's size and SHA-256 after its first download.
"""

import contextlib
import importlib.util
import os
import pathlib
import urllib.parse
from collections.abc import Mapping
from typing import Any

import jax

from crisalad_jax.checkpoints.layouts import LAYOUTS
from crisalad_jax.checkpoints.published import PUBLISHED, Published
from crisalad_jax.checkpoints.torch_io import Checkpoint, read_checkpoint, read_vocabulary
from crisalad_jax.checkpoints.weights import CACHE_RECORD, save_weights
from crisalad_jax.nn.model import Model
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.download import MissingFileError, download
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, user_cache, write_json
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.version import VERSION

OFFLINE, MIRROR = "CRISALAD_OFFLINE", "CRISALAD_MIRROR"
"""Variables of the environment: whether to use no network, and where to look for files by their
names before their published addresses."""


def is_offline() -> bool:
    """Return whether the environment forbids the network."""
    return os.environ.get(OFFLINE, "").lower() not in ("", "0", "false", "no")


def is_cached(model: Published) -> bool:
    """Return whether the cache has a published model's weights."""
    return _weights(model).is_file()


def cached_weights(model: Published, *, quiet: bool = False) -> pathlib.Path:
    """Return a published model's weights in the cache; download and convert them the first time.

    Of two processes one downloads, and the other waits for it. Each time the published file's size
    and time of change are compared with the record, and its SHA-256 where these differ. The weights
    have a checksum of their own, which `load_weights` checks.

    Args:
        model: the published model.
        quiet: no progress bar.

    Returns:
        A file of this package.

    Raises:
        InputError: what `download` and `read_checkpoint` raise; the file is not the one that was
            downloaded first, or no such model; it is not here and the network is forbidden, or it
            has no address of its own; torch is needed and not installed; or the cache cannot be
            written to.
    """
    if _is_ready(model):
        return _weights(model)
    published = _folder(model) / model.file
    if not published.is_file():
        _check_obtainable(model)
    with lock(_folder(model), wait=True):
        if not _is_ready(model):
            _check_torch(model)
            address = None
            if not published.is_file():
                address = _download(model, published, quiet=quiet)
            _convert(model, published, address, quiet=quiet)
    return _weights(model)


def _folder(model: Published) -> pathlib.Path:
    return user_cache() / "models" / model.name


def _weights(model: Published) -> pathlib.Path:
    return _folder(model) / f"{model.name}.safetensors"


def _is_ready(model: Published) -> bool:
    """Return whether the weights are here, of the published file that the record is of.

    Raises:
        InputError: the published file was changed.
    """
    record, published = _record(model), _folder(model) / model.file
    if record is None or not _weights(model).is_file():
        return False
    if not published.is_file():  # removed for the room
        return True
    if not record.items() >= _stamp(published).items():  # as after a copy of the folder
        _check_same(model, record, sha256_of(published))
        with contextlib.suppress(InputError):  # where the cache is for reading alone
            write_json(_folder(model) / CACHE_RECORD, record | _stamp(published))
    return record["version"] == VERSION


def _record(model: Published) -> dict[str, Any] | None:
    """Read what is known of the published file; None before its first download."""
    path = _folder(model) / CACHE_RECORD
    if not path.exists():
        return None
    record = read_json(path, "the record of a download")
    if {"sha256", "version"} - record.keys():
        raise InputError(f"{path}: found no record of a download, expected one, or no such file")
    return record


def _stamp(path: pathlib.Path) -> dict[str, int]:
    """Return a file's size in bytes and time of change in nanoseconds."""
    status = path.stat()
    return {"size": status.st_size, "changed_ns": status.st_mtime_ns}


def _check_same(model: Published, record: Mapping[str, Any], digest: str) -> None:
    """Check that a published file is the one that was downloaded first."""
    if digest != record["sha256"]:
        folder = _folder(model)
        raise InputError(
            f"{folder / model.file}: found SHA-256 {digest[:12]}..., expected "
            f"{str(record['sha256'])[:12]}... as at the first download: the file was changed "
            f"(without {folder} it is downloaded anew)"
        )


def _check_obtainable(model: Published) -> None:
    """Check that a file may be downloaded, before a folder is made for it."""
    if is_offline():
        raise InputError(
            f"{model.name}: found none in the cache {user_cache()}, expected it there: {OFFLINE} "
            "forbids the network"
        )
    if not _addresses(model):
        raise InputError(
            f"{model.name}: found no address of its own for {model.file}, expected it as "
            f"{_folder(model) / model.file} (download it by hand from {model.repository}: "
            f"{model.note})"
        )
    _check_torch(model)


def _check_torch(model: Published) -> None:
    """Check that what reads the file is installed, before it is downloaded."""
    is_torch = LAYOUTS[model.layout].stored == "torch"
    if is_torch and importlib.util.find_spec("torch") is None:
        raise InputError(
            f"{model.name}: found no torch, expected it to read {model.file}: pip install "
            "'crisalad-jax[convert]'"
        )


def _addresses(model: Published) -> list[str]:
    """Return where to look for the file: the mirror, if there is one, and its published address."""
    addresses = [] if model.url is None else [model.url]
    mirror = os.environ.get(MIRROR)
    if not mirror:
        return addresses
    if not mirror.startswith(("http://", "https://", "file://")):
        raise InputError(
            f"{MIRROR}: found {mirror!r}, expected https://HOST/PATH or file:///FOLDER"
        )
    return [f"{mirror.rstrip('/')}/{urllib.parse.quote(model.file)}", *addresses]


def _download(model: Published, target: pathlib.Path, *, quiet: bool) -> str:
    """Download the published file, from the mirror if that has it; return its address."""
    addresses = _addresses(model)
    for address in addresses:
        try:
            download(address, target, label=model.name, quiet=quiet)
            return address
        except MissingFileError as error:
            if address == addresses[-1]:
                raise InputError(
                    f"{model.name}: {error}; it may have moved: {model.repository}"
                ) from error
            warn(f"{address}: found no such file; looking at {model.url}")
        except InputError as error:
            raise InputError(f"{model.name}: {error}") from error
    raise AssertionError("no address")  # `_check_obtainable` has seen one


def _read(model: Published, published: pathlib.Path, *, quiet: bool) -> Checkpoint:
    """Read the published file; a vocabulary beside its backbone, which is in the cache too."""
    if not model.backbone:
        return read_checkpoint(published)
    return read_vocabulary(published, cached_weights(PUBLISHED[model.backbone], quiet=quiet))


def _convert(
    model: Published, published: pathlib.Path, address: str | None, *, quiet: bool
) -> None:
    """Make the weights of the published file, and record both.

    Args:
        model: the model.
        published: its file.
        address: from where it was downloaded just now; None for a file that was there before.
        quiet: no progress bar.

    Raises:
        InputError: the file is not the one of the record, or not the model. Then it is removed, if
            it was downloaded just now.
    """
    record, digest = _record(model), sha256_of(published)
    try:
        if record is not None:
            _check_same(model, record, digest)
        checkpoint = _read(model, published, quiet=quiet)
        parameters = sum(leaf.size for leaf in jax.tree.leaves(checkpoint.params))
        found = checkpoint.config.descriptor_dim, parameters
        if found != (model.descriptor, model.parameters):
            raise InputError(
                f"{published}: found descriptors of {found[0]} numbers and {found[1]} parameters "
                f"({checkpoint.layout}), expected {model.descriptor} and {model.parameters}"
            )
    except InputError as error:
        if address is not None:
            published.unlink()
        raise InputError(f"{model.name}: {error}") from error
    converted = Model(checkpoint.params, checkpoint.config)
    save_weights(_weights(model), converted, extras=checkpoint.extras)
    known = {
        "url": address or (record or {}).get("url"),
        "file": model.file,
        "sha256": digest,
        "version": VERSION,
    }
    write_json(_folder(model) / CACHE_RECORD, known | _stamp(published))
