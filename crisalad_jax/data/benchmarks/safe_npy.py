"""Reading .npy files, pickled ones included, without running code from them.

The formats are NumPy enhancement proposal 1 (.npy) and Python's pickletools (opcodes of a pickle).
Published ground truths are arrays of lists, which numpy can only save as a pickle.
"""

import io
import math
import pathlib
import pickle
import pickletools
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_one_array, read_bytes

_KINDS = re.compile(r"[?biufcSUO]\d{0,5}")
_LARGEST_ITEM = 2**16
"""Largest item in bytes: numpy allocates one even if it is empty. The longest path has 16 KiB."""

_OPERATIONS = frozenset(
    (
        *("PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "DUP"),
        *("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE", "GET", "BINGET", "LONG_BINGET"),
        *("NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1", "BININT2"),
        *("LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
        *("STRING", "BINSTRING", "SHORT_BINSTRING"),
        *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
        *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
        *("EMPTY_LIST", "LIST", "APPEND", "APPENDS"),
        *("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
        *("GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD"),
    )
)
_MEMO = ("PUT", "BINPUT", "LONG_BINPUT")


def read_npy(path: pathlib.Path) -> np.ndarray:
    """Read a .npy file; a pickled one may hold lists, tuples, text, bytes, numbers and arrays.

    Memory use is bounded by the file's size, whatever array sizes the file claims.

    Raises:
        InputError: the file is missing, damaged, or holds anything else.
    """
    archive = path.with_suffix(".npz")
    check_one_array(archive if archive.exists() and not path.exists() else path)
    data = read_bytes(path, "a .npy file")
    try:
        return _load(data)
    except Exception as error:  # a damaged pickle can raise anything at all
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: cannot be read as an array: {type(error).__name__}: {reason}"
        ) from error


def _load(data: bytes) -> np.ndarray:
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise ValueError(f"found .npy version {version}, expected (1, 0) or (2, 0)")
    shape, fortran_order, dtype = readers[version](file)
    rest = data[file.tell() :]
    if not dtype.hasobject:
        return _from_bytes(rest, dtype, shape, "F" if fortran_order else "C")
    array = unpickle(rest)
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise ValueError(f"found a pickled {type(array).__name__}, expected an array of {shape}")
    return np.asarray(array)


def unpickle(data: bytes) -> Any:
    """Load a pickle of lists, tuples, text, bytes, numbers and arrays, without running code.

    Raises:
        pickle.UnpicklingError: it asks for anything else.
        Exception: it is damaged.
    """
    for operation, argument, _ in pickletools.genops(data):
        if operation.name not in _OPERATIONS:
            raise pickle.UnpicklingError(f"found {operation.name}, which no array needs")
        # The unpickler's memo is a plain array, allocated up to its largest index.
        if operation.name in _MEMO and not 0 <= int(argument or 0) <= len(data):
            raise pickle.UnpicklingError(f"found {operation.name} {argument}, past the file's end")
    return _Unpickler(data).load()


def _from_bytes(data: bytes, dtype: np.dtype, shape: tuple[int, ...], order: Any) -> np.ndarray:
    """View bytes as a read-only array; there must be exactly as many as the array needs."""
    if len(data) != _size(shape) * dtype.itemsize:
        raise ValueError(f"found {len(data)} bytes for {shape} of {dtype}")
    if dtype.itemsize > _LARGEST_ITEM:
        raise ValueError(f"found items of {dtype.itemsize} bytes, expected {_LARGEST_ITEM} at most")
    flat = np.frombuffer(data, dtype) if data else np.empty(0, dtype)
    return flat.reshape(shape, order=order)


def _size(shape: Any) -> int:
    """Count the items of an array of this shape, after a check that all sides are integers."""
    if not isinstance(shape, tuple) or any(type(side) is not int or side < 0 for side in shape):
        raise ValueError("found a shape that is none")
    return math.prod(shape)


def _bytes(data: Any) -> bytes:
    """Return bytes as they are, or convert the text in which Python 2 spells them."""
    if isinstance(data, str):
        return data.encode("latin1")
    if not isinstance(data, bytes | bytearray):
        raise pickle.UnpicklingError(f"found {type(data).__name__}, expected bytes")
    return bytes(data)


class _Stand:
    """Wrap a function that replaces one of numpy's, so that a pickle can only call it."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("the file changes a function")


class _Unpickler(pickle.Unpickler):
    """Rebuild numpy's arrays by functions of this module, and refuse every other name."""

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")
        # A valid pickle has at least one byte for every byte or object of its arrays. A pickle
        # that makes many arrays of the same bytes exceeds this budget.
        self._left = len(data)
        array, scalar = _Stand(self._new_array), _Stand(_scalar)
        buffer = _Stand(_from_buffer)
        self._names = {
            ("numpy", "ndarray"): _NDARRAY,
            ("numpy", "dtype"): _Stand(_Dtype),
            ("_codecs", "encode"): _Stand(_encode),
            # Python 3 spells the bytes of an empty array for Python 2 as `bytes()`.
            ("__builtin__", "bytes"): _Stand(lambda: b""),
        }
        # numpy 2 moved its modules, and files of numpy 1 and 2 both exist.
        for core in ("numpy.core", "numpy._core"):
            self._names[f"{core}.multiarray", "_reconstruct"] = array
            self._names[f"{core}.multiarray", "scalar"] = scalar
            self._names[f"{core}.numeric", "_frombuffer"] = buffer

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        if (module_name, global_name) not in self._names:
            raise pickle.UnpicklingError(f"the file asks for {module_name}.{global_name}")
        return self._names[module_name, global_name]

    def _new_array(self, kind: Any, shape: Any, code: Any) -> "_Array":
        if kind is not _NDARRAY or shape != (0,):
            raise pickle.UnpicklingError("the file asks for an array without contents")
        array = _Array((0,), np.uint8)
        array.spend = self._spend
        return array

    def _spend(self, size: int) -> None:
        self._left -= size
        if self._left < 0:
            raise pickle.UnpicklingError("the arrays are larger than the file")


class _Nothing:
    """A placeholder for the class `numpy.ndarray`, of which a pickle needs only the name."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("the file changes a class")


_NDARRAY = _Nothing()


class _Dtype:
    """A data type as a pickle stores it: a code, then a state with the byte order."""

    __slots__ = ("dtype",)

    def __init__(self, code: Any, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str) or not _KINDS.fullmatch(code):
            raise pickle.UnpicklingError("the file asks for a data type that is none of numbers")
        self.dtype = np.dtype("O" if code[0] == "O" else code)
        if self.dtype.itemsize > _LARGEST_ITEM:
            raise pickle.UnpicklingError(f"the file asks for items of {self.dtype.itemsize} bytes")

    def __setstate__(self, state: Any) -> None:
        # Version 4 adds metadata, which no number needs. The last three items are sizes and flags.
        version, order, subarray, names, fields, *rest = state
        if version != 3 or len(rest) != 3 or order not in ("<", ">", "|"):
            raise pickle.UnpicklingError("the file has a data type of another numpy, or metadata")
        if (subarray, names, fields) != (None, None, None):
            raise pickle.UnpicklingError("the file asks for a data type of several fields")
        if order != "|":
            self.dtype = self.dtype.newbyteorder(order)


def _dtype(value: Any) -> np.dtype:
    if not isinstance(value, _Dtype):
        raise pickle.UnpicklingError(f"found {type(value).__name__}, expected a data type")
    return value.dtype


class _Array(np.ndarray):
    """An array that checks its contents, which a pickle sets after making the array."""

    spend: Callable[[int], None]

    def __setstate__(self, state: Any, /) -> None:
        _, shape, spelled, fortran_order, data = state
        dtype = _dtype(spelled)
        size = _size(shape)
        if dtype.hasobject:
            if not isinstance(data, list) or len(data) != size:
                raise pickle.UnpicklingError(f"found another number of objects than {shape} holds")
        else:
            data = _bytes(data)
            size *= dtype.itemsize
            if len(data) != size:
                raise pickle.UnpicklingError(f"found another number of bytes than {shape} takes")
        self.spend(size)
        del self.spend
        super().__setstate__((1, shape, dtype, fortran_order, data))


def _scalar(spelled: Any, data: Any) -> Any:
    dtype = _dtype(spelled)
    if dtype.hasobject:
        raise pickle.UnpicklingError("found a number that is an object")
    return _from_bytes(_bytes(data), dtype, (), "C")[()]


def _from_buffer(data: Any, spelled: Any, shape: Any, order: Any, axes: Any = None) -> np.ndarray:
    dtype = _dtype(spelled)
    if dtype.hasobject or axes is not None or order not in ("C", "F"):
        raise pickle.UnpicklingError("found an array in an order that is not known")
    return _from_bytes(_bytes(data), dtype, shape, order)


def _encode(text: str, encoding: str) -> bytes:
    """Encode text as bytes, as old pickles spell them."""
    if encoding != "latin1":
        raise pickle.UnpicklingError("the file spells bytes in another way than latin1")
    return text.encode("latin1")
