"""Read and write torch files without running any code in them."""

import collections
import contextlib
import pathlib
import pickle
import re
import shutil
import tempfile
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.utils.errors import InputError, few
from crisalad_jax.utils.files import atomic_path, wrap_os_errors

DECLARED = "crisalad-jax"
"""Key of the description of the model in public checkpoints that this package writes. It is in the
metadata of the state dict, which other programs ignore."""
HOW = "torch.save(model.state_dict(), FILE) writes a file of only the weights"
_UNDER = ("state_dict", "model_state_dict", "model", "teacher")
"""Keys under which files store the state."""
_PCA = ("mean_", "components_", "explained_variance_")
"""Arrays of a whitening, which AP-GeM's files store next to the state."""
_PCA_NAME = "Landmarks_clean"
"""Name of the published whitening (Revaud et al., ICCV 2019), if a file has several."""
_PCA_CLASSES = tuple(f"sklearn.decomposition.{module}.PCA" for module in ("pca", "_pca"))
"""Class of a pickled whitening: before scikit-learn 0.22, and since."""
_MOST = 100
"""Largest ratio of an unpacked file's size to that of the zip archive around it."""


class Content(NamedTuple):
    """The content of a public checkpoint."""

    state: dict[str, np.ndarray]
    """Arrays by name."""
    declared: str | None = None
    """Description of the model as JSON, if this package stored one; otherwise None."""
    mean: tuple[float, float, float] | None = None
    """Mean red, green and blue to subtract from pixels of 0 to 1; None if not in the checkpoint."""


class _Numpy:
    """A stand-in for a NumPy array stored with the weights, for its type, or for a scalar.

    Torch rejects any file with one, as for the recalls of a training run, and NumPy's own
    constructors would run on unchecked bytes. `array` checks the content before it makes the array.
    """

    def __init__(self, *made_of: Any) -> None:
        self.made_of = made_of
        self.state: Any = ()

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def array(self) -> np.ndarray:
        """Return an array of float32 or float64.

        Raises:
            TypeError, ValueError, AttributeError: the content is anything else.
        """
        _, shape, kind, by_column, data = self.state
        if kind.made_of[0] not in ("f4", "f8") or not isinstance(data, bytes):
            raise ValueError("no floats")
        order = {"<": "<", ">": ">"}[kind.state[1]]
        flat = np.frombuffer(data, order + kind.made_of[0])
        return flat.reshape(shape, order="F" if by_column else "C").astype(np.float32)


_NUMPY = (
    "numpy.dtype",
    "numpy.ndarray",
    *(
        f"numpy.{core}.multiarray.{name}"
        for core in ("core", "_core")  # before NumPy 2, and since
        for name in ("_reconstruct", "scalar")
    ),
)
"""Names that a pickled NumPy array or scalar refers to."""


def _stand_in(name: str) -> type:
    """Make a stand-in, a dictionary, for any other class or function that a file names.

    Making it runs no code in the file. Torch fills exactly this kind of dictionary with items, as
    for a `defaultdict`, and with attributes, as for an `argparse.Namespace`.
    """

    def new(_: type, *__: Any) -> Any:
        made = collections.OrderedDict()
        vars(made)["stands_for"] = name
        return made

    return type(name, (), {"__new__": new})


def read_torch(path: pathlib.Path) -> Content:
    """Read the state dict of a torch file, under any of the usual keys or at the top level.

    Raises:
        InputError: the file is incomplete, asks to run code, or holds anything but named tensors.
        ModuleNotFoundError: torch is not installed.
    """
    import torch

    state = whole = _load(path)
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
    metadata = getattr(state, "_metadata", None)  # as in any module's state_dict
    declared = metadata.get(DECLARED) if isinstance(metadata, dict) else None
    arrays = {name: _array(path, name, x) for name, x in state.items()}
    return Content(arrays | _whitening(path, whole), declared)


def _whitening(path: pathlib.Path, whole: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of AP-GeM's whitening, if any: stored as an object or as named tensors.

    Raises:
        InputError: it is neither; or its network has options that are not supported here.
    """
    found = whole.get("pca")
    if not isinstance(found, Mapping):
        return {}
    options = whole.get("model_options")
    for name in ("norm_features", "center_bias", "without_fc"):
        if isinstance(options, Mapping) and options.get(name):
            raise InputError(f"{path}: model_options: found {name}, expected it to be off")
    if len(found) != 1 and _PCA_NAME not in found:
        names = few(sorted(map(str, found)))
        raise InputError(f"{path}: pca: found {names}, expected {_PCA_NAME}, or only one")
    pca = found.get(_PCA_NAME, next(iter(found.values())))
    of_class = getattr(pca, "stands_for", None)
    if of_class in _PCA_CLASSES:
        pca = vars(pca)
    elif of_class is not None or not isinstance(pca, Mapping):
        raise InputError(
            f"{path}: pca: found {of_class or type(pca).__name__}, expected scikit-learn's PCA, or "
            f"tensors {', '.join(_PCA)}"
        )
    try:
        return {
            name: x.array() if isinstance(x := pca[name], _Numpy) else _array(path, name, x)
            for name in _PCA
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        arrays = ", ".join(_PCA)
        raise InputError(f"{path}: pca: expected arrays of floats {arrays}: {error!r}") from error


def _kind(value: Any) -> str:
    """Name what a file holds instead of a dictionary of tensors."""
    if isinstance(value, dict):
        return getattr(value, "stands_for", "nothing")
    if hasattr(value, "shape"):
        return f"one tensor by itself, of shape {tuple(value.shape)} (see `convert --backbone`)"
    return type(value).__name__


def read_tensor(path: pathlib.Path) -> np.ndarray:
    """Read a torch file that holds a single tensor.

    Raises:
        InputError: the file is incomplete, asks to run code, or holds anything else.
    """
    return _array(path, "the content", _load(path))


def _load(path: pathlib.Path) -> Any:
    """Read a file, with stand-ins for all classes and functions that it names."""
    import torch

    others: list[str] = []
    try:
        with warnings.catch_warnings(), _unpacked(path) as file:
            warnings.simplefilter("ignore")  # about deprecated formats
            if zipfile.is_zipfile(file):  # as torch's files have been since 1.6
                _check_uncompressed(file)
                named = torch.serialization.get_unsafe_globals_in_checkpoint(file)
                others = sorted(set(named) - set(_NUMPY))
            else:  # torch does not report what such a file names
                others = list(_PCA_CLASSES)
            stand_ins: list[Any] = [(_stand_in(name), name) for name in others]
            stand_ins += [(_Numpy, name) for name in _NUMPY]
            with torch.serialization.safe_globals(stand_ins):
                return torch.load(file, map_location="cpu", weights_only=True)
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
            what = f"asks for {refused[1]}" if refused else "is not a plain pickle of tensors"
            problem = f"refused: it {what}, expected nothing but tensors, which run no code: {HOW}"
        raise InputError(f"{path}: {problem}") from error


@contextlib.contextmanager
def _unpacked(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yield the single file inside a zip archive that is not torch's, or else the file itself.

    Raises:
        InputError: the archive unpacks to far more than its size, or there is no room for it.
    """
    with contextlib.ExitStack() as stack:
        names: list[str] = []
        if zipfile.is_zipfile(path):
            archive = stack.enter_context(zipfile.ZipFile(path))
            # macOS adds its own files.
            names = [n for n in archive.namelist() if not n.endswith("/") and "__MACOSX" not in n]
        if len(names) != 1:
            yield path
            return
        unpacked, size = archive.getinfo(names[0]).file_size, path.stat().st_size
        if unpacked > _MOST * size:
            raise InputError(
                f"{path}: found an archive of {size} bytes that unpacks to {unpacked}, expected a "
                f"checkpoint, at most {_MOST} times as large"
            )
        folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        target = folder / "file"
        with archive.open(names[0]) as source, wrap_os_errors(target), target.open("wb") as file:
            shutil.copyfileobj(source, file)
        yield target


def _check_uncompressed(path: pathlib.Path) -> None:
    """Check that an archive does not unpack to more than its size; torch's own never do.

    Torch stores tensors uncompressed, but also reads compressed ones: a few kilobytes could fill
    any memory.
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
        raise InputError(f"{path}: {name} is not a plain tensor: {error}") from error


def write_torch(
    path: pathlib.Path,
    state: Mapping[str, np.ndarray],
    *,
    under: str,
    bare: bool,
    declared: str | None,
) -> None:
    """Write arrays as a torch file, atomically.

    Args:
        path: the file.
        state: arrays by name, the state dict.
        under: key of the file's dictionary for the state dict; empty puts it at the top level.
        bare: whether to write just the one tensor, without a dictionary.
        declared: the model's description, as in `Content`; None writes none.

    Raises:
        InputError: the file cannot be written.
        ModuleNotFoundError: torch is not installed.
    """
    import torch

    content: Any = {name: torch.from_numpy(np.array(array)) for name, array in state.items()}
    if declared is not None:
        content = collections.OrderedDict(content)
        content._metadata = {DECLARED: declared}
    if under:
        whitening = {name: content.pop(name) for name in _PCA if name in content}
        content = {under: content} | ({"pca": {_PCA_NAME: whitening}} if whitening else {})
    if bare:
        (content,) = content.values()
    # Pass an open file, because torch writes the name of a path into the archive.
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # torch raises it after the disk's own error
            reason = error.__context__ if isinstance(error.__context__, OSError) else error
            raise InputError(f"{path}: cannot be written: {str(reason).splitlines()[0]}") from error
