"""The tokens of images in a folder of files while `extract` works, so that it can be resumed."""

import contextlib
import hashlib
import json
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import safetensors

from crisalad_jax.checkpoints.safetensors_io import read_sealed, write_sealed
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.loader import OnBadImage
from crisalad_jax.data.video import file_of
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.tokens import Tokens
from crisalad_jax.retrieval.describe import FolderTokens, tokens_in_batches
from crisalad_jax.retrieval.model import Model, model_hash
from crisalad_jax.utils.checksums import checked_safetensors
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.shapes import Bool, Int64
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
    with lock(folder):
        remove_temporaries(folder)
        try:
            yield folder
        except BaseException as error:
            if not _segments(folder):
                (folder / _PLAN).unlink(missing_ok=True)
            elif isinstance(error, InputError):
                raise InputError(
                    f"{error} (what is done is kept in {folder}, and the same command goes on)"
                ) from error
            raise
        for path in (*_segments(folder), folder / _PLAN):
            path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # another process has begun here, or a user's file is there
        folder.rmdir()


def _segments(folder: pathlib.Path) -> list[pathlib.Path]:
    return sorted(folder.glob("[0-9]*.safetensors"))


def read_tokens_partly(
    folder: pathlib.Path,
    params: Model,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    batch_size: int,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = False,
) -> "StoredTokens":
    """Extract the tokens of images in order, as `describe.read_tokens`, into files of the folder.

    What the folder holds of the same images and model is not computed again. One file's tokens are
    in memory, whatever the number of images.

    Raises:
        InputError: an image cannot be read, and `on_bad_image` is "stop"; or a full disk.
    """
    _begin(folder, _plan(params, config, batch_size))
    # Whole batches, so that the same images are computed together after a kill.
    size = -(-SEGMENT // batch_size) * batch_size
    readable: list[np.ndarray] = []
    like: FolderTokens | None = None
    for part in _read(folder, paths, size, on_bad_image):
        readable.append(part.readable)
        like = like or _shape_of(part)
    done = sum(map(len, readable))
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
                value = {"images": _digest(paths[done : done + size])}
                write_sealed(_path(folder, done), arrays, FORMAT, value)
            readable.append(part.readable)
            like = like or _shape_of(part)
            done += len(part.readable)
    if like is None:
        raise ValueError("found no images, expected at least one")
    return StoredTokens(folder, size, like, np.concatenate(readable))


class StoredTokens(NamedTuple):
    """Tokens of many images in a folder's files, read when they are asked for."""

    folder: pathlib.Path
    size: int
    """Number of images in each file."""
    like: FolderTokens
    """No images' tokens, of the files' shapes and types."""
    readable: Bool[np.ndarray, " image"]
    """Whether each image could be read."""

    def of(self, images: Int64[np.ndarray, " n"]) -> Tokens:
        """Read the tokens of some images, by number; zeros where no image of a file was read."""
        global_tokens, local = (
            np.zeros((len(images), *leaf.shape[1:]), leaf.dtype) for leaf in self.like[:2]
        )
        files = images // self.size * self.size
        for first in np.unique(files):
            path = _path(self.folder, int(first))
            if not path.exists():
                continue
            with safetensors.safe_open(path, framework="numpy") as file:
                for name, leaf in (("global_tokens", global_tokens), ("local", local)):
                    stored = file.get_slice(name)
                    for place in np.flatnonzero(files == first):
                        row = int(images[place] - first)
                        leaf[place] = stored[row : row + 1][0]
        return Tokens(jnp.asarray(global_tokens), jnp.asarray(local))


def _shape_of(part: FolderTokens) -> FolderTokens:
    return FolderTokens(*(leaf[:0].copy() for leaf in part))


def _joined(parts: Sequence[FolderTokens]) -> FolderTokens:
    return FolderTokens(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))


def _path(folder: pathlib.Path, first: int) -> pathlib.Path:
    return folder / f"{first:010d}.safetensors"


def _plan(params: Model, config: ModelConfig, batch_size: int) -> dict[str, Any]:
    """Return what all tokens depend on: the model, and how many images are computed together."""
    plan = {
        "model": model_hash(params, config),
        "config": to_plain(config),
        "batch_size": batch_size,
    }
    return json.loads(json.dumps(plan))


def _digest(paths: Sequence[pathlib.Path]) -> str:
    """Compute a digest of the names, sizes and times of image files."""
    files = hashlib.sha256()
    for path in paths:
        with contextlib.suppress(OSError):  # told when it is read
            there = file_of(path).stat()
            line = f"{os.fspath(path)} {there.st_size} {there.st_mtime_ns}\n"
            files.update(line.encode(errors="surrogateescape"))
    return files.hexdigest()


def _begin(folder: pathlib.Path, plan: dict[str, Any]) -> None:
    """Remove what is left of work by another model in the folder."""
    left = _segments(folder)
    try:
        if left and read_json(folder / _PLAN, "the plan of an extraction") == plan:
            return
    except InputError:
        pass
    if left:
        warn(f"{folder}: found work of another model or batch size; it is begun anew")
    for path in left:
        path.unlink()
    write_json(folder / _PLAN, plan)


def _read(
    folder: pathlib.Path, paths: Sequence[pathlib.Path], size: int, on_bad_image: OnBadImage
) -> Iterator[FolderTokens]:
    """Yield the tokens that are there, up to a file that is damaged, missing or of other images."""
    for first in range(0, len(paths), size):
        path = _path(folder, first)
        if not path.exists():
            return
        try:
            with checked_safetensors(path, verify=True):
                value, arrays = read_sealed(path, FORMAT, "tokens of images")
            part = FolderTokens(**arrays)
        except (InputError, TypeError):
            return
        if value.get("images") != _digest(paths[first : first + size]):
            warn(f"{path}: found work on other images; from there on it is begun anew")
            return
        if on_bad_image == "stop" and not part.readable.all():
            return  # to be read again, for the error
        yield part
