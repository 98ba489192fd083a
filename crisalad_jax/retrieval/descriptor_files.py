"""Files of descriptors: .npy with a list of names, or HDF5 as hloc reads it.

d.npy          a row for each image
d.names.txt    a line for each image
d.npy.json     how they were made, and the digests of the files that belong together
d.h5           a group for each image; d.h5.json beside it
"""

import io
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import IO, Any, Self

import numpy as np

from crisalad_jax.config.checks import choose
from crisalad_jax.data.images import check_lines
from crisalad_jax.retrieval.chunks import as_rows
from crisalad_jax.utils.checksums import sha256_of, tell_unchecked
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import (
    atomic_path,
    check_one_array,
    check_source,
    npy_header,
    read_json,
    read_text,
    wrap_os_errors,
    write_json,
    write_npy,
)
from crisalad_jax.utils.shapes import Float, Float32, Int

Descriptors = Float[np.ndarray, "image descriptor"]
_DIGESTS = "files"
"""Key of the digests in the record, by the files' roles."""
_SUFFIXES = (".npy", ".h5")
_INFLATION = 1100
"""Largest ratio of numbers to bytes that deflate, HDF5's compression, reaches."""


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Check that descriptors can be written to a file of this suffix, before any work is done.

    Raises:
        InputError: the suffix is neither .npy nor .h5.
    """
    suffix = pathlib.Path(path).suffix
    choose(f"{path}: suffix of the descriptors' file", suffix, dict.fromkeys(_SUFFIXES))


def record_of(path: pathlib.Path) -> pathlib.Path:
    """Return the path of the JSON file that tells how the descriptors in `path` were made."""
    return path.with_name(f"{path.name}.json")


def targets(path: pathlib.Path) -> list[pathlib.Path]:
    """List all files that a set of descriptors in `path` consists of."""
    names = [_names_of(path)] if path.suffix == ".npy" else []
    return [path, *names, record_of(path)]


def _names_of(path: pathlib.Path) -> pathlib.Path:
    return path.with_suffix(".names.txt")


def write_descriptors(
    path: str | os.PathLike[str],
    descriptors: Descriptors,
    names: Sequence[str],
    record: Mapping[str, Any] | None = None,
    *,
    within: pathlib.Path | None = None,
    written: pathlib.Path | None = None,
) -> None:
    """Write descriptors, their images' names and a record of both.

    All files are written whole under temporary names. Then the record gets its name, and the others
    theirs. A process that is killed in between leaves a set whose digests differ from its record,
    and `read_descriptors` refuses that.

    Args:
        path: a file .npy or .h5.
        descriptors: a row for each image.
        names: of the images.
        record: how they were made, as JSON values.
        within: a folder for temporary files, see `files.atomic_path`.
        written: a .npy file of the descriptors on the same disk, which may be moved, not copied.

    Raises:
        InputError: another suffix, a name twice in a .h5, or a file that cannot be written.
    """
    check_suffix(path)
    path = pathlib.Path(path)
    if path.suffix == ".npy":
        _write_npy(path, descriptors, names, dict(record or {}), within, written)
    else:
        _write_h5(path, descriptors, names, dict(record or {}), within)


def _write_npy(
    path: pathlib.Path,
    descriptors: Descriptors,
    names: Sequence[str],
    record: dict[str, Any],
    within: pathlib.Path | None,
    written: pathlib.Path | None,
) -> None:
    # The files that are entered last are renamed first.
    with (
        atomic_path(path, within) as array,
        atomic_path(_names_of(path), within) as listed,
        atomic_path(record_of(path), within) as recorded,
    ):
        with wrap_os_errors(path):
            if written is None:
                write_npy(array, descriptors)
            else:
                os.replace(written, array)
        listed.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
        digests = {"descriptors": sha256_of(array), "names": sha256_of(listed)}
        write_json(recorded, {_DIGESTS: digests} | record)


class RowFile:
    """A .npy file of float32 rows, which are written in any order, some at a time.

    A memory map would end the process where the disk gets full; this raises OSError.
    """

    def __init__(self, path: pathlib.Path, count: int, length: int) -> None:
        """Make the file for so many rows of so many numbers."""
        header = npy_header(np.dtype(np.float32), (count, length))
        self._origin, self._row = len(header), 4 * length
        self._file = path.open("wb")
        self._file.write(header)

    def write(
        self, places: Int[np.ndarray, " n"], rows: Float32[np.ndarray, "n descriptor"]
    ) -> None:
        """Write rows at these places."""
        runs = np.split(np.arange(len(places)), np.flatnonzero(np.diff(places) != 1) + 1)
        for run in runs if len(places) else ():
            self._file.seek(self._origin + self._row * int(places[run[0]]))
            self._file.write(np.ascontiguousarray(rows[run]).data)

    def __enter__(self) -> Self:
        """Return the file itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()


def _write_h5(
    path: pathlib.Path,
    descriptors: Descriptors,
    names: Sequence[str],
    record: dict[str, Any],
    within: pathlib.Path | None,
) -> None:
    """Write a group for each image, with a dataset `global_descriptor`, as hloc does."""
    import h5py

    with atomic_path(path, within) as array, atomic_path(record_of(path), within) as written:
        with array.open("w+b", buffering=0) as raw:
            target = _NeverFull(raw)
            with h5py.File(target, "w") as file:
                for name, descriptor in zip(names, descriptors, strict=True):
                    if f"{name}/global_descriptor" in file:
                        raise InputError(
                            f"{path}: found the image name {name!r} twice, expected it once"
                        )
                    file.create_dataset(f"{name}/global_descriptor", data=descriptor)
            if target.error is not None:
                raise target.error
        write_json(written, {_DIGESTS: {"descriptors": sha256_of(array)}} | record)


class _NeverFull(io.RawIOBase):
    """A file that keeps the first error of the disk to itself: HDF5 would crash the process."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        count = memoryview(data).nbytes
        self._try(lambda: self._file.write(data))
        return count

    def truncate(self, size: int | None = None) -> int:
        self._try(lambda: self._file.truncate(size))
        return self.tell() if size is None else size

    def _try(self, change: Any) -> None:
        if self.error is None:
            try:
                change()
            except OSError as error:
                self.error = error

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(memoryview(buffer).nbytes)
        memoryview(buffer).cast("B")[: len(data)] = data
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True


def open_npy(path: str | os.PathLike[str], *, verify: bool = True) -> Descriptors:
    """Memory-map the array in a .npy file: float32, float16, float64 or bfloat16.

    Args:
        path: the file.
        verify: whether to read the file, and compare it with the digest in its record.

    Raises:
        InputError: there is no such file, it holds no matrix of such numbers, or other bytes than
            its record says.
    """
    path = pathlib.Path(path)
    check_source(path, "a .npy file of descriptors")
    check_one_array(path)
    if verify:
        _check_files(path, {"descriptors": path})
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # numpy's parser of headers raises errors of many kinds
        raise InputError(f"{path}: not a whole .npy file: {_words(error)}") from error
    if array.dtype.kind != "f" and array.dtype != np.dtype("V2"):
        raise InputError(
            f"{path}: found {array.dtype}, expected an array of floating-point numbers"
        )
    return as_rows(array, str(path))


def _words(error: BaseException) -> str:
    lines = str(error).splitlines()
    return lines[0] if lines else type(error).__name__


def read_descriptors(
    path: str | os.PathLike[str], *, verify: bool = True
) -> tuple[list[str], Descriptors]:
    """Read names and descriptors from a file of `write_descriptors` or of hloc, of any float type.

    A .npy file is memory-mapped: its rows are read when they are used. A note tells of a set
    without a record of its digests.

    Args:
        path: the file.
        verify: whether to read the files, and compare them with their digests.

    Raises:
        InputError: the file, or the names beside a .npy, is missing, not whole, of another set, or
            holds something else.
    """
    path = pathlib.Path(path)
    if path.suffix == ".npz":
        check_one_array(path)
    readers = {".npy": _read_npy, ".h5": _read_h5}
    read = choose(f"{path}: suffix of the descriptors' file", path.suffix, readers)
    check_source(path, "a file of descriptors")
    names, descriptors = read(path, verify)
    check_lines(names, path)
    return names, descriptors


def _check_files(path: pathlib.Path, files: Mapping[str, pathlib.Path]) -> None:
    """Compare files with the digests in the record of the set in `path`, if it has one."""
    record = record_of(path)
    if not record.is_file():
        tell_unchecked(path, f"no {record.name} with its checksum")
        return
    value = read_json(record, "a record of descriptors")
    digests = value.get(_DIGESTS)
    if not isinstance(digests, dict) or not digests.keys() >= files.keys():
        raise InputError(
            f"{record}: found no digests of {', '.join(files)}, expected them: {path.name} and "
            "this file do not belong together"
        )
    for role, file in files.items():
        if sha256_of(file) != digests[role]:
            raise InputError(
                f"{file}: found other bytes than {record.name} says, expected those that were "
                "written together: they were changed, or an extraction ended between the two; the "
                "same command finishes it"
            )


def _read_npy(path: pathlib.Path, verify: bool) -> tuple[list[str], Descriptors]:
    listed = _names_of(path)
    text = read_text(listed, f"the names of the images in {path.name}")
    if verify:
        _check_files(path, {"descriptors": path, "names": listed})
    names = text.splitlines()
    descriptors = open_npy(path, verify=False)
    if len(descriptors) != len(names):
        raise InputError(
            f"{path}: found {len(descriptors)} descriptors, expected {len(names)}, one for each "
            f"name in {listed.name}"
        )
    return names, descriptors


def _read_h5(path: pathlib.Path, verify: bool) -> tuple[list[str], Descriptors]:
    import h5py

    if verify:
        _check_files(path, {"descriptors": path})
    names: list[str] = []
    rows: list[np.ndarray] = []

    def take(name: str) -> None:
        group, _, last = name.rpartition("/")
        # Other groups are not opened: of a chain of them that takes the square of its length.
        item = file[name] if last == "global_descriptor" else None
        if not isinstance(item, h5py.Dataset):
            return
        if item.ndim != 1 or item.dtype.kind != "f" or (rows and item.shape != rows[0].shape):
            raise InputError(
                f"{path}: found {item.dtype} {item.shape} as {name}, expected floats "
                f"{rows[0].shape if rows else '(descriptor,)'}"
            )
        # The header may claim any size, or numbers of other files.
        stored = item.id.get_storage_size() * (1 if item.compression is None else _INFLATION)
        if item.external or item.is_virtual or item.nbytes > stored:
            raise InputError(
                f"{path}: found {item.nbytes} bytes of numbers as {name}, of which the file holds "
                f"{item.id.get_storage_size()}, expected all of them in this file"
            )
        names.append(group)
        rows.append(item[()])

    try:
        with h5py.File(path) as file:
            file.visit(take)
    except InputError:
        raise
    except Exception as error:  # damaged files end in errors of many kinds
        raise InputError(f"{path}: not a whole HDF5 file: {_words(error)}") from error
    if not rows:
        raise InputError(f"{path}: found no dataset global_descriptor, expected one for each image")
    return names, np.stack(rows)
