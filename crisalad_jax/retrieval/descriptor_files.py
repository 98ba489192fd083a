"""Files of descriptors: .npy with a list of names, or HDF5 as hloc reads it.

d.npy          a row for each image
d.names.txt    a line for each image
d.npy.json     how they were made, and the digests of the files that belong together
d.h5           a group for each image; d.h5.json is next to it
"""

import contextlib
import io
import os
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from crisalad_jax.config.checks import choose
from crisalad_jax.data.images import check_lines
from crisalad_jax.retrieval.chunks import Descriptors, as_rows
from crisalad_jax.utils.checksums import sha256_of, tell_unchecked
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import (
    atomic_path,
    check_source,
    npy_header,
    read_json,
    read_text,
    wrap_os_errors,
    write_json,
    write_npy,
)
from crisalad_jax.utils.output import one_line
from crisalad_jax.utils.shapes import Float, Int

_DIGESTS = "files"
"""Key of the digests in the record, by the roles of the files."""
MADE_BY = "model_sha256"
"""Key of the `model_hash` in the record of descriptors that this package made."""
_SUFFIXES = (".npy", ".h5")


def record_of(path: pathlib.Path) -> pathlib.Path:
    """Return the path of the JSON file that records how the descriptors in `path` were made."""
    return path.with_name(f"{path.name}.json")


def read_record(path: pathlib.Path) -> dict[str, Any]:
    """Read how the descriptors in `path` were made; return {} if they have no record."""
    record = record_of(path)
    return read_json(record, "a record of descriptors") if record.is_file() else {}


def targets(path: pathlib.Path) -> list[pathlib.Path]:
    """List the files of descriptors in `path`: the file itself, its names (.npy) and its record.

    Raises:
        InputError: the suffix is neither .npy nor .h5.
    """
    choose(f"{path}: suffix of the descriptors' file", path.suffix, dict.fromkeys(_SUFFIXES))
    return [*_files_of(path).values(), record_of(path)]


def _files_of(path: pathlib.Path) -> dict[str, pathlib.Path]:
    """Return the files whose digests the record holds, by their roles."""
    names = {"names": path.with_suffix(".names.txt")} if path.suffix == ".npy" else {}
    return {"descriptors": path, **names}


def write_descriptors(
    path: str | os.PathLike[str],
    descriptors: Descriptors,
    names: Sequence[str],
    record: Mapping[str, Any] | None = None,
    *,
    within: pathlib.Path | None = None,
    written: pathlib.Path | None = None,
) -> None:
    """Write descriptors, the names of their images and a record of how they were made.

    All files are written completely under temporary names. Then the record is renamed, and after it
    the others. A process killed in between leaves files whose digests differ from the record, which
    `read_descriptors` refuses.

    Args:
        path: a .npy or .h5 file.
        descriptors: a row for each image.
        names: names of the images.
        record: how they were made, as JSON values; None records only the digests of the files.
        within: a folder for temporary files (`files.atomic_path`); None is that of `path`.
        written: a .npy file of the descriptors on the same disk, to be moved instead of copied.

    Raises:
        InputError: the suffix is unknown, a .h5 repeats a name, or a file cannot be written.
    """
    path = pathlib.Path(path)
    targets(path)
    with contextlib.ExitStack() as stack:
        # The files that are entered last are renamed first.
        enter = stack.enter_context
        files = {role: enter(atomic_path(file, within)) for role, file in _files_of(path).items()}
        recorded = enter(atomic_path(record_of(path), within))
        if path.suffix == ".h5":
            _write_h5(files["descriptors"], descriptors, names, path)
        else:
            with wrap_os_errors(path):
                if written is None:
                    write_npy(files["descriptors"], descriptors)
                else:
                    os.replace(written, files["descriptors"])
            files["names"].write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
        digests = {role: sha256_of(file) for role, file in files.items()}
        write_json(recorded, {_DIGESTS: digests, **(record or {})})


def write_rows(
    path: pathlib.Path,
    shape: tuple[int, int],
    parts: Iterable[tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n descriptor"]]],
) -> None:
    """Write a .npy file of float32 rows, which arrive in any order, some at a time.

    A full disk raises OSError. With a memory map, it would kill the process.

    Args:
        path: the file.
        shape: number of rows, and their length.
        parts: pairs of row indices, and the rows to write there.
    """
    header = npy_header(np.dtype(np.float32), shape)
    with path.open("wb") as file:
        file.write(header)
        for places, rows in parts:
            for place, row in zip(places, np.ascontiguousarray(rows, np.float32), strict=True):
                file.seek(len(header) + row.nbytes * int(place))
                file.write(row.data)


def _write_h5(
    target: pathlib.Path, descriptors: Descriptors, names: Sequence[str], path: pathlib.Path
) -> None:
    """Write a group for each image, with a dataset `global_descriptor`, as hloc does."""
    import h5py

    with _NeverFull(target, "w+") as raw:
        with h5py.File(raw, "w") as file:
            for name, descriptor in zip(names, descriptors, strict=True):
                if f"{name}/global_descriptor" in file:
                    raise InputError(
                        f"{path}: found the image name {name!r} twice, expected it once"
                    )
                file.create_dataset(f"{name}/global_descriptor", data=descriptor)
        if raw.error is not None:
            raise raw.error


class _NeverFull(io.FileIO):
    """A file that stores the first disk error instead of raising it: HDF5 would crash on it."""

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        self._try(super().write, data)
        return memoryview(data).nbytes

    def truncate(self, size: int | None = None, /) -> int:
        self._try(super().truncate, size)
        return self.tell() if size is None else size

    def _try(self, change: Callable[..., object], value: Any) -> None:
        if self.error is None:
            try:
                change(value)
            except OSError as error:
                self.error = error


def open_npy(path: str | os.PathLike[str], *, verify: bool = True) -> Descriptors:
    """Memory-map the array in a .npy file: float32, float16, float64 or bfloat16.

    Args:
        path: the file.
        verify: whether to compare the whole file with the digest in its record, if it has one.

    Raises:
        InputError: the file does not exist, does not hold a matrix of such numbers, or does not
            match its record.
    """
    path = pathlib.Path(path)
    check_source(path, "a .npy file of descriptors")
    if verify:
        _check_files(path, ["descriptors"])
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # numpy's header parser raises errors of many kinds
        raise InputError(f"{path}: not a whole .npy file: {one_line(error)}") from error
    if array.dtype.kind != "f" and array.dtype != np.dtype("V2"):
        raise InputError(
            f"{path}: found {array.dtype}, expected an array of floating-point numbers"
        )
    return as_rows(array, str(path))


def read_descriptors(
    path: str | os.PathLike[str], *, verify: bool = True
) -> tuple[list[str], Descriptors]:
    """Read the names and descriptors (of any float type) that `write_descriptors` or hloc wrote.

    A .npy file is memory-mapped: its rows are read when they are used. If the files have no record
    of their digests, a warning says so.

    Args:
        path: a .npy or .h5 file.
        verify: whether to read the files completely, and compare them with their digests.

    Raises:
        InputError: the suffix is unknown; or the file, or the list of names next to a .npy, is
            missing, incomplete, from another set, or holds something else.
    """
    path = pathlib.Path(path)
    readers = {".npy": _read_npy, ".h5": _read_h5}
    read = choose(f"{path}: suffix of the descriptors' file", path.suffix, readers)
    check_source(path, "a file of descriptors")
    if verify:
        _check_files(path, list(_files_of(path)))
    names, descriptors = read(path)
    check_lines(names, path)
    return names, descriptors


def _check_files(path: pathlib.Path, roles: Sequence[str]) -> None:
    """Compare files with the digests in the record of the set in `path`, if it has one."""
    record, files = record_of(path), _files_of(path)
    if not record.is_file():
        tell_unchecked(path, f"no {record.name} with its checksum")
        return
    digests = read_json(record, "a record of descriptors").get(_DIGESTS)
    for role in roles:
        if not isinstance(digests, dict) or digests.get(role) != sha256_of(files[role]):
            raise InputError(
                f"{files[role]}: found other bytes than {record.name} says, expected those that "
                "were written together: one was changed, or an extraction was killed between the "
                "two; the same command finishes it"
            )


def _read_npy(path: pathlib.Path) -> tuple[list[str], Descriptors]:
    listed = _files_of(path)["names"]
    names = read_text(listed, f"the names of the images in {path.name}").splitlines()
    descriptors = open_npy(path, verify=False)
    if len(descriptors) != len(names):
        raise InputError(
            f"{path}: found {len(descriptors)} descriptors, expected {len(names)}, one for each "
            f"name in {listed.name}"
        )
    return names, descriptors


def _read_h5(path: pathlib.Path) -> tuple[list[str], Descriptors]:
    import h5py

    found: list[str] = []
    try:
        with h5py.File(path) as file:
            file.visit(found.append)
            found = [name for name in found if name.endswith("/global_descriptor")]
            rows: Any = np.stack([file[name][()] for name in found])  # pyright: ignore
    except Exception as error:  # damaged files raise errors of many kinds
        reason = one_line(error)
        raise InputError(f"{path}: not a whole HDF5 file of descriptors: {reason}") from error
    return [name.removesuffix("/global_descriptor") for name in found], as_rows(rows, str(path))
