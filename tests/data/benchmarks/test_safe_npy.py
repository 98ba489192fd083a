"""Pickled arrays against numpy's own reader, and pickles that would rather do something else."""

import os
import pickle
import struct
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.benchmarks.npy_lists import read_npy
from tests.data.benchmarks.trees import ragged, refused


def write_object_array(path: Path, pickled: bytes, shape: tuple[int, ...] = (1,)) -> Path:
    with path.open("wb") as file:
        header = {"descr": "|O", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(pickled)
    return path


def by_numpy_1(pickled: bytes) -> bytes:
    """The same pickle with the names of numpy's modules before version 2."""
    assert b"numpy._core" in pickled
    if pickled[1] < 4:
        return pickled.replace(b"numpy._core", b"numpy.core")
    # From protocol 4 on a name has its length in front, and a frame too.
    for part in (b"multiarray", b"numeric"):
        new, old = b"numpy._core." + part, b"numpy.core." + part
        pickled = pickled.replace(bytes([len(new)]) + new, bytes([len(old)]) + old)
    assert b"numpy._core" not in pickled
    return pickled[:2] + pickled[11:] if pickled[2:3] == b"\x95" else pickled


RAGGED = ragged(
    np.array([3, 1, 2]),
    [np.int64(4), 5],
    np.array([], np.int32),
    (np.uint8(6), -1, 2**40),
    np.array([["a", "bc"]]),
    np.array([b"xyz", b""]),
    "text",
    None,
    np.float32(1.5),
    np.bool_(True),
    np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
)


def assert_same(found: object, expected: object) -> None:
    assert isinstance(found, type(expected))
    if isinstance(expected, np.ndarray):
        assert found.shape == expected.shape
        # numpy turns the bytes of what it has read around, to the machine's order.
        assert found.dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
        for a, b in zip(found.ravel(), expected.ravel(), strict=True):
            assert_same(a, b)
    elif isinstance(expected, list | tuple):
        for a, b in zip(found, expected, strict=True):
            assert_same(a, b)
    else:
        assert found == expected


@pytest.mark.parametrize("rename", [bytes, by_numpy_1], ids=["numpy 2", "numpy 1"])
@pytest.mark.parametrize("protocol", range(2, 6))
def test_equals_numpys_reader(tmp_path, protocol: int, rename: Callable[[bytes], bytes]):
    pickled = rename(pickle.dumps(RAGGED, protocol=protocol))
    path = write_object_array(tmp_path / "a.npy", pickled, RAGGED.shape)
    with warnings.catch_warnings():  # numpy 2 complains of the old names
        warnings.simplefilter("ignore", DeprecationWarning)
        assert_same(np.load(path, allow_pickle=True), RAGGED)
    found = read_npy(path)
    assert type(found) is np.ndarray
    assert_same(found, RAGGED)


class Call:
    """Calls something when unpickled."""

    def __init__(self, function: Callable, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(5))
@pytest.mark.parametrize(
    ("call", "name"),
    [
        (Call(eval, "1"), "(builtins|__builtin__).eval"),
        (Call(getattr, "", "join"), "(builtins|__builtin__).getattr"),
        (Call(np.load, "x"), "numpy.load"),
        (Call(bytearray, 10**12), "(builtins|__builtin__).bytearray"),
    ],
)
def test_no_other_name_is_looked_up(tmp_path, call, name, protocol):
    path = write_object_array(tmp_path / "a.npy", pickle.dumps(call, protocol=protocol))
    with refused(f"the file asks for {name}"):
        read_npy(path)


def test_a_payload_does_not_run(tmp_path):
    target = tmp_path / "ran"
    path = tmp_path / "a.npy"
    np.save(path, ragged([0], Call(os.mkdir, str(target))), allow_pickle=True)
    with refused(r"a.npy: cannot be read .* asks for (posix|nt)\.mkdir"):
        read_npy(path)
    assert not target.exists()
    # The payload is a real one: an ordinary load runs it.
    np.load(path, allow_pickle=True)
    assert target.exists()


BAD = {
    "a place in the memo": b"K\x00r\xff\xff\xff\x7f",
    "bytes": b"\x8e" + struct.pack("<Q", 10**13),
    "text": b"X" + struct.pack("<I", 2**32 - 1),
    "a code of the registry": b"\x82\x01",
    "something outside": b"Pid\n",
    "a buffer outside": b"\x97",
    "a changed class": b"cnumpy\nndarray\nN}X\x01\x00\x00\x00xK\x01s\x86b",
    "a dictionary": b"}",
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_array_is_refused_and_takes_no_memory(tmp_path, case):
    """Six bytes would make the unpickler in C allocate 32 GB."""
    path = write_object_array(tmp_path / "a.npy", b"\x80\x04" + BAD[case] + b".")
    tracemalloc.start()
    try:
        with refused(r"a\.npy: cannot be read as an array: "):
            read_npy(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2**20
    assert not hasattr(np.ndarray, "x")


def test_damaged_files(tmp_path):
    path = tmp_path / "a.npy"
    with refused(r"a\.npy: found no such file"):
        read_npy(path)
    np.save(path, ragged([1, 2], [3]), allow_pickle=True)
    whole = path.read_bytes()
    another, version = whole[:128] + pickle.dumps([1, 2]), whole[:6] + b"\x09" + whole[7:]
    for data in (b"", whole[:-20], b"0 1\n1 2\n", another, version):
        path.write_bytes(data)
        with refused(r"a\.npy: cannot be read"):
            read_npy(path)
