"""Read and write files of torch, which runs no code of theirs."""

import collections
import pathlib
import pickle
import re
import warnings
import zipfile
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.files import atomic_path

DECLARED = "crisalad-jax"
"""Key of what a public checkpoint that we write says of its model, in the metadata of its state,
where no other program looks."""
HOW = "torch.save(model.state_dict(), FILE) writes a file of the weights alone"
_UNDER = ("state_dict", "model_state_dict", "model", "teacher")
"""Keys under which files have the state."""


class Content(NamedTuple):
    """What a public checkpoint holds."""

    state: dict[str, np.ndarray]
    """Arrays by name."""
    declared: str | None = None
    """What it says of its model, as JSON, where we wrote it."""
    mean: tuple[float, float, float] | None = None
    """Red, green and blue that are subtracted from pixels of 0 to 1, where it says so."""


class _Unread:
    """A stand-in for an array of NumPy with the weights, such as the recalls of a training run.

    Torch refuses a whole file with one, and NumPy itself would run on bytes of the file.
    """

    def __init__(self, *_: Any) -> None:
        """Take what the array would be made of, and keep nothing."""

    def __setstate__(self, _: Any) -> None:
        """Take its numbers, and keep nothing."""


_NUMPY = (
    "numpy.dtype",
    "numpy.ndarray",
    *(
        f"numpy.{core}.multiarray.{name}"
        for core in ("core", "_core")  # before NumPy 2, and since
        for name in ("_reconstruct", "scalar")
    ),
)
"""What a pickled array or number of NumPy asks for."""


def _stand_in(name: str) -> type:
    """Make a stand-in for any other class or function that a file names: a dictionary.

    Its making runs nothing of the file. Torch fills exactly this kind of dictionary with items, as
    of a `defaultdict`, and with attributes, as of an `argparse.Namespace`.
    """

    def new(_: type, *__: Any) -> Any:
        made = collections.OrderedDict()
        vars(made)["stands_for"] = name
        return made

    return type(name, (), {"__new__": new})


def read_torch(path: pathlib.Path) -> Content:
    """Read the state in a file, under whatever key it is.

    Raises:
        InputError: the file is not whole, asks to run code, or has anything but tensors by name.
        ModuleNotFoundError: torch is not installed.
    """
    import torch

    state = _load(path)
    if isinstance(state, Mapping):
        inside = (state[key] for key in _UNDER if isinstance(state.get(key), Mapping))
        state = next(inside, state)
    strange = [_kind(state)]
    if isinstance(state, dict) and state:
        strange = [
            str(name)
            for name, each in state.items()
            if not (isinstance(name, str) and torch.is_tensor(each))
        ]
    if strange:
        found = few(sorted(strange))
        raise InputError(f"{path}: found {found}, expected nothing but tensors by name: {HOW}")
    metadata = getattr(state, "_metadata", None)  # as of any module's state_dict
    declared = metadata.get(DECLARED) if isinstance(metadata, dict) else None
    return Content({name: _array(path, name, x) for name, x in state.items()}, declared)


def _kind(value: Any) -> str:
    """Name what a file holds in place of a dictionary of tensors."""
    if isinstance(value, dict):
        return getattr(value, "stands_for", "nothing")
    if hasattr(value, "shape"):
        return f"one tensor by itself, of shape {tuple(value.shape)} (see `convert --backbone`)"
    return type(value).__name__


def read_tensor(path: pathlib.Path) -> np.ndarray:
    """Read a file that is one tensor by itself.

    Raises:
        InputError: as `read_torch`; or it is not one.
    """
    return _array(path, "the content", _load(path))


def _load(path: pathlib.Path) -> Any:
    """Read a file, with stand-ins for all classes and functions that it names."""
    import torch

    others: list[str] = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about deprecated formats
            if zipfile.is_zipfile(path):  # as torch's files have been since 1.6
                _check_uncompressed(path)
                named = torch.serialization.get_unsafe_globals_in_checkpoint(path)
                others = sorted(set(named) - set(_NUMPY))
            stand_ins: list[Any] = [(_stand_in(name), name) for name in others]
            stand_ins += [(_Unread, name) for name in _NUMPY]
            with torch.serialization.safe_globals(stand_ins):
                return torch.load(path, map_location="cpu", weights_only=True)
    except InputError:
        raise
    except Exception as error:  # a damaged pickle may raise any exception
        reason = " ".join([type(error).__name__, *str(error).splitlines()[:1]])[:200]
        problem = f"not a whole torch checkpoint: {reason}"
        if others:
            problem += f" (it has {', '.join(others[:3])} with the weights: {HOW})"
        if isinstance(error, pickle.UnpicklingError):
            # Torch's message is a page of advice on how to run the code anyway: shorten it.
            refused = re.search(r"(?:GLOBAL|Unsupported \w+) ([a-zA-Z_][\w.]*)", str(error))
            what = f"asks for {refused[1]}" if refused else "is no plain pickle of tensors"
            problem = f"refused: it {what}, expected nothing but tensors, which run no code: {HOW}"
        raise InputError(f"{path}: {problem}") from error


def _check_uncompressed(path: pathlib.Path) -> None:
    """Check that an archive does not unpack to more than its size, as one of torch never does.

    Torch stores tensors as they are, but reads compressed ones too: some kilobytes could fill any
    memory.
    """
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(each.file_size for each in archive.infolist())
    if unpacked > size:
        raise InputError(
            f"{path}: found an archive of {size} bytes that unpacks to {unpacked}, expected a "
            "torch checkpoint, whose tensors are not compressed"
        )


def _array(path: pathlib.Path, name: str, tensor: Any) -> np.ndarray:
    try:
        half = str(tensor.dtype) in ("torch.float16", "torch.bfloat16")
        return (tensor.float() if half else tensor).detach().numpy()
    except (AttributeError, TypeError, RuntimeError) as error:  # sparse, 8-bit or meta tensors
        raise InputError(f"{path}: {name} is no plain tensor: {error}") from error


def write_torch(
    path: pathlib.Path,
    state: Mapping[str, np.ndarray],
    *,
    under: str,
    bare: bool,
    declared: str | None,
) -> None:
    """Write a state as torch does, whole or not at all.

    Args:
        path: the file.
        state: arrays by name.
        under: key of the file's dictionary that holds the state; empty: the file is the state.
        bare: whether the file is the one tensor by itself.
        declared: see `Content`.

    Raises:
        InputError: the file cannot be made.
        ModuleNotFoundError: torch is not installed.
    """
    import torch

    content: Any = {name: torch.from_numpy(np.array(array)) for name, array in state.items()}
    if declared is not None:
        content = collections.OrderedDict(content)
        content._metadata = {DECLARED: declared}
    if under:
        content = {under: content}
    if bare:
        (content,) = content.values()
    # Pass an open file, because torch writes the name of a path into the archive.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # torch's, after the disk's own
            reason = error.__context__ if isinstance(error.__context__, OSError) else error
            raise InputError(f"{path}: cannot be written: {str(reason).splitlines()[0]}") from error
