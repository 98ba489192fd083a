"""The tokens of images in a folder of files while `extract` works, so that it can be resumed."""

import contextlib
import hashlib
import json
import os
import pathlib
import shutil
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.safetensors_io import read_sealed, write_sealed
from crisalad_jax.checkpoints.weights import model_hash
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.retrieval.describe import FolderTokens, tokens_in_batches
from crisalad_jax.utils.checksums import checked_safetensors
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.locks import one_writer
from crisalad_jax.utils.notes import tell
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.temporaries import remove_temporaries

FORMAT = "crisalad-jax tokens 1"
SEGMENT = 256
"""Number of images that are described again at most after a kill."""
_PLAN = "plan.json"


@contextlib.contextmanager
def partial_folder(out: pathlib.Path) -> Iterator[pathlib.Path]:
    """Hold the folder of what is done of the descriptors in `out`; remove it after success.

    An error leaves it only if it holds work: the message then says so.

    Raises:
        InputError: another process writes these descriptors, or the folder cannot be made.
    """
    folder = out.with_name(f"{out.name}.partial")
    with one_writer(folder):
        try:
            yield folder
        except InputError as error:
            if _segments(folder):
                raise InputError(
                    f"{error} (what is done is kept in {folder}, and the same command goes on)"
                ) from error
            (folder / _PLAN).unlink(missing_ok=True)
            raise
        shutil.rmtree(folder)


def _segments(folder: pathlib.Path) -> list[pathlib.Path]:
    return sorted(folder.glob("[0-9]*.safetensors"))


def read_tokens_partly(
    folder: pathlib.Path,
    params: Crisalad,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = False,
) -> FolderTokens:
    """Extract the tokens of images in order, as `describe.read_tokens`, and keep them in files.

    What the folder holds of the same images and model is read, and not computed again.

    Raises:
        InputError: an image cannot be read, and `on_bad_image` is "stop"; or a full disk.
    """
    remove_temporaries(folder)
    _begin(folder, _plan(params, config, paths, batch_size))
    # Whole batches, so that the same images are computed together after a kill.
    size = -(-SEGMENT // batch_size) * batch_size
    parts = list(_read(folder, len(paths), size, on_bad_image))
    done = sum(len(part.readable) for part in parts)
    with progress_bar("images", len(paths), "images", quiet=quiet, done=done) as bar:
        while done < len(paths):
            batches = []
            for tokens, batch in tokens_in_batches(
                params,
                config,
                paths[done : done + size],
                batch_size=batch_size,
                on_bad_image=on_bad_image,
            ):
                used = int((batch.indices >= 0).sum())
                batches.append(FolderTokens(*(leaf[:used] for leaf in tokens)))
                bar.advance(used)
            part = _joined(batches)
            if part.readable.any():
                arrays = {name: np.ascontiguousarray(leaf) for name, leaf in part._asdict().items()}
                write_sealed(_path(folder, done), arrays, FORMAT, {})
            parts.append(part)
            done += len(part.readable)
    return _joined(parts)


def _joined(parts: Sequence[FolderTokens]) -> FolderTokens:
    return FolderTokens(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))


def _path(folder: pathlib.Path, first: int) -> pathlib.Path:
    return folder / f"{first:010d}.safetensors"


def _plan(
    params: Crisalad, config: ModelConfig, paths: Sequence[pathlib.Path], batch_size: int
) -> dict[str, Any]:
    """Return what tokens depend on: the model, the images and how they are batched."""
    files = hashlib.sha256()
    for path in paths:
        with contextlib.suppress(OSError):  # told when it is read
            there = path.stat()
            line = f"{os.fspath(path)} {there.st_size} {there.st_mtime_ns}\n"
            files.update(line.encode(errors="surrogateescape"))
    return {
        "model": model_hash(params, config),
        "config": to_plain(config),
        "images": files.hexdigest(),
        "batch_size": batch_size,
    }


def _begin(folder: pathlib.Path, plan: dict[str, Any]) -> None:
    """Remove what is left of other work in the folder."""
    left = _segments(folder)
    try:
        if left and read_json(folder / _PLAN, "the plan of an extraction") == plan:
            return
    except InputError:
        pass
    if left:
        tell(f"{folder}: found work on other images or of another model; it is begun anew")
    for path in left:
        path.unlink()
    write_json(folder / _PLAN, json.loads(json.dumps(plan)))


def _read(
    folder: pathlib.Path, count: int, size: int, on_bad_image: OnBadImage
) -> Iterator[FolderTokens]:
    """Yield the tokens that are there, up to the first file that is damaged or missing."""
    for first in range(0, count, size):
        path = _path(folder, first)
        if not path.exists():
            return
        try:
            with checked_safetensors(path, verify=True):
                arrays = read_sealed(path, (FORMAT,), "tokens of images").arrays
            part = FolderTokens(**arrays)
        except (InputError, TypeError):
            return
        if on_bad_image == "stop" and not part.readable.all():
            return  # to be read again, for the error
        yield part
