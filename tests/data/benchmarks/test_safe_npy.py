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
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.benchmarks.safe_npy import read_npy, unpickle
from crisalad_jax.retrieval.descriptor_files import open_npy, read_descriptors
from crisalad_jax.utils.errors import InputError
from tests.data.benchmarks.trees import ragged


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
    assert isinstance(found, type(expected)) or isinstance(expected, np.ndarray)
    if isinstance(expected, np.ndarray):
        assert isinstance(found, np.ndarray)
        assert found.shape == expected.shape
        # numpy turns the bytes of what it has read around, to the machine's order.
        assert found.dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
        for a, b in zip(found.ravel(), expected.ravel(), strict=True):
            assert_same(a, b)
    elif isinstance(expected, list | tuple):
        assert isinstance(found, type(expected))
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


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    array=arrays.arrays(
        st.one_of(
            arrays.integer_dtypes(endianness="?"),
            arrays.floating_dtypes(endianness="?", sizes=(32, 64)),
            arrays.boolean_dtypes(),
            arrays.unicode_string_dtypes(endianness="?"),
        ),
        arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
    ),
    fortran=st.booleans(),
)
def test_plain_arrays_equal_numpys_reader(tmp_path, array, fortran):
    np.save(tmp_path / "a.npy", np.asfortranarray(array) if fortran else array)
    found, expected = read_npy(tmp_path / "a.npy"), np.load(tmp_path / "a.npy")
    assert (found.shape, found.dtype) == (expected.shape, expected.dtype)
    np.testing.assert_array_equal(found, expected)


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
        (Call(os.system, "true"), r"(posix|nt)\.system"),
        (Call(eval, "1"), "(builtins|__builtin__).eval"),
        (Call(getattr, "", "join"), "(builtins|__builtin__).getattr"),
        (Call(np.load, "x"), "numpy.load"),
        (Call(np.frombuffer, b"1"), "numpy.*frombuffer"),
        (Call(np.add, 1, 2), r"numpy\._core.*|numpy\.add|_ufunc_reconstruct"),
        (Call(bytearray, 10**12), "(builtins|__builtin__).bytearray"),
        (Call(complex, 1, 2), "(builtins|__builtin__).complex"),
    ],
)
def test_no_other_name_is_looked_up(call, name, protocol):
    with pytest.raises(pickle.UnpicklingError, match=f"the file asks for {name}"):
        unpickle(pickle.dumps(call, protocol=protocol))


def test_a_payload_does_not_run(tmp_path):
    target = tmp_path / "ran"
    path = tmp_path / "a.npy"
    np.save(path, ragged([0], Call(os.mkdir, str(target))), allow_pickle=True)
    with pytest.raises(InputError, match=r"a.npy: cannot be read .* asks for (posix|nt)\.mkdir"):
        read_npy(path)
    assert not target.exists()
    # The payload is a real one: an ordinary load runs it.
    np.load(path, allow_pickle=True)
    assert target.exists()


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def name(module: str, attribute: str) -> bytes:
    return f"c{module}\n{attribute}\n".encode()


NDARRAY, DTYPE = name("numpy", "ndarray"), name("numpy", "dtype")
RECONSTRUCT = name("numpy.core.multiarray", "_reconstruct")
SCALAR = name("numpy.core.multiarray", "scalar")
BUFFER = name("numpy.core.numeric", "_frombuffer")
INT64 = (
    DTYPE
    + text("i8")
    + b"\x89\x88\x87R(K\x03"
    + text("<")
    + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
)
OBJECT = INT64.replace(text("i8"), text("O8")).replace(text("<"), text("|"))
EMPTY = RECONSTRUCT + NDARRAY + b"K\x00\x85C\x01b\x87R"
HUGE = b"\x8a\x06" + (10**13).to_bytes(6, "little")
BILLION = b"\x8a\x05" + (10**10).to_bytes(5, "little")


def built(shape: bytes, dtype: bytes, contents: bytes, array: bytes = EMPTY) -> bytes:
    """An array to which a pickle gives a state."""
    return array + b"(K\x01" + shape + dtype + b"\x89" + contents + b"tb"


def doubled(levels: int) -> bytes:
    """Pairs of the same pair, and so on: 2**levels items once they are written out."""
    pickled = b"K\x00"
    for _ in range(levels):
        pickled += b"2\x86"
    return pickled


BOMBS = {
    "numbers": (built(HUGE + b"\x85", INT64, b"C\x00"), "another number of bytes"),
    "objects": (built(HUGE + b"\x85", OBJECT, b"]"), "another number of objects"),
    "an empty side": (built(HUGE + b"K\x00\x86", INT64, b"C\x01a"), "another number of bytes"),
    "a negative side": (built(b"J\xff\xff\xff\xff\x85", INT64, b"C\x00"), "a shape that is none"),
    "text as a side": (built(BILLION + text("a") + b"\x86", INT64, b"C\x00"), "a shape that is"),
    "an item": (
        built(b"K\x00\x85", INT64.replace(text("i8"), text("U99999")), b"C\x00"),
        "items of 399996 bytes",
    ),
    "a larger item": (
        built(b"K\x00\x85", INT64.replace(text("i8"), text("U536870911")), b"C\x00"),
        "a data type that is none of numbers",
    ),
    "without contents": (RECONSTRUCT + NDARRAY + HUGE + b"\x85C\x01b\x87R", "without contents"),
    "ndarray itself": (NDARRAY + HUGE + b"\x85\x85R", "not callable"),
    "a buffer": (BUFFER + b"(C\x00" + INT64 + HUGE + b"\x85" + text("C") + b"tR", "found 0 bytes"),
    "a number as a buffer": (
        BUFFER + b"(" + BILLION + INT64 + b"K\x01\x85" + text("C") + b"tR",
        "found int, expected bytes",
    ),
    "the memo": (b"K\x00r\xff\xff\xff\x7f", "past the file's end"),
    "bytes": (b"\x8e" + struct.pack("<Q", 10**13), "remain|expected"),
    "text": (b"X" + struct.pack("<I", 2**32 - 1), "remain|expected"),
    "the same bytes often": (
        b"C\xff"
        + b"a" * 248
        + b"1234567q\x00"
        + built(b"K\xff\x85", INT64.replace(text("i8"), text("S1")), b"h\x00") * 20,
        "larger than the file",
    ),
    "a message": (RECONSTRUCT + NDARRAY + doubled(60) + b"C\x01b\x87R", "without contents"),
    "a data type": (DTYPE + doubled(60) + b"\x89\x88\x87R", "a data type that is none of numbers"),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_claims_are_not_believed(tmp_path, bomb):
    pickled, message = BOMBS[bomb]
    path = write_object_array(tmp_path / "a.npy", b"\x80\x04" + pickled + b".")
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=message) as caught:
            read_npy(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # The file itself, what Python notes of the operations, and the exceptions.
    assert peak < 2**20
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300 + len(str(path))


def test_a_header_is_not_believed(tmp_path):
    for shape, descr in (((10**13,), "<i8"), ((0,), "<U536870911"), ((10**6, 10**6), "|u1")):
        with (tmp_path / "a.npy").open("wb") as file:
            header = {"descr": descr, "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, header)
        with pytest.raises(InputError, match=r"found (0 bytes for|items of 2147483644 bytes)"):
            read_npy(tmp_path / "a.npy")


REFUSED = {
    "fields": (
        built(b"K\x01\x85", INT64.replace(b"NNNJ", text("|") + b"NNJ"), b"C\x08abcdefgh"),
        "several fields",
    ),
    "metadata": (
        built(b"K\x01\x85", INT64.replace(b"K\x03", b"K\x04")[:-2] + b"Ntb", b"C\x08abcdefgh"),
        "another numpy",
    ),
    "a byte order": (
        built(b"K\x01\x85", INT64.replace(text("<"), text("x")), b"C\x08abcdefgh"),
        "another numpy",
    ),
    "records": (
        built(b"K\x01\x85", INT64.replace(text("i8"), text("i8,O")), b"C\x08abcdefgh"),
        "none of numbers",
    ),
    "void": (
        built(b"K\x01\x85", INT64.replace(text("i8"), text("V8")), b"C\x08abcdefgh"),
        "none of numbers",
    ),
    "objects as bytes": (built(b"K\x01\x85", OBJECT, b"C\x08abcdefgh"), "number of objects"),
    "an object as a number": (SCALAR + OBJECT + b"C\x08abcdefgh\x86R", "that is an object"),
    "objects in a buffer": (
        BUFFER + b"(C\x08abcdefgh" + OBJECT + b"K\x01\x85" + text("C") + b"tR",
        "in an order that is not known",
    ),
    "a type in place of numpy's": (
        RECONSTRUCT + SCALAR + b"K\x00\x85C\x01b\x87R",
        "without contents",
    ),
    "a data type in place of numpy's": (
        built(b"K\x01\x85", b"K\x05", b"C\x08abcdefgh"),
        "found int, expected a data type",
    ),
    "a changed function": (RECONSTRUCT + b"}b", "found EMPTY_DICT"),
    "a function with a state": (
        RECONSTRUCT + b"N" + text("__defaults__") + b"\x86b",
        "changes a f",
    ),
    "a class with a state": (NDARRAY + b"N" + text("x") + b"\x86b", "changes a class"),
    "a state after the contents": (
        built(b"K\x01\x85", INT64, b"C\x08abcdefgh")
        + b"(K\x01"
        + HUGE
        + b"\x85"
        + INT64
        + b"\x89C\x00tb",
        "another number of bytes",
    ),
    "a state of an array of a buffer": (
        built(
            HUGE + b"\x85",
            INT64,
            b"C\x00",
            BUFFER + b"(C\x08abcdefgh" + INT64 + b"K\x01\x85" + text("C") + b"tR",
        ),
        "TypeError",
    ),
    "another encoding": (
        name("_codecs", "encode") + text("a") + text("rot13") + b"\x86R",
        "latin1",
    ),
    "a dictionary": (b"}", "found EMPTY_DICT"),
    "a set": (b"\x8f", "found EMPTY_SET"),
    "an object of a class": (NDARRAY + b")\x81", "found NEWOBJ"),
    "an old object": (b"(inumpy\nndarray\n", "found INST"),
    "a number of a register": (b"\x82\x01", "found EXT1"),
    "something outside": (b"Pid\n", "found PERSID"),
    "a buffer outside": (b"\x97", "found NEXT_BUFFER"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_no_array_needs_is_refused(tmp_path, case):
    pickled, message = REFUSED[case]
    path = write_object_array(tmp_path / "a.npy", b"\x80\x04" + pickled + b".")
    with pytest.raises(InputError, match=message) as caught:
        read_npy(path)
    assert str(caught.value).startswith(f"{path}: cannot be read as an array: ")


def test_the_pieces_of_these_pickles_are_sound():
    """Without what is wrong in them they are read, so it is that which is refused."""
    found = unpickle(
        b"\x80\x04" + built(b"K\x01\x85", INT64, b"C\x08" + bytes([7, *[0] * 7])) + b"."
    )
    assert (found.tolist(), found.dtype) == ([7], np.int64)
    found = unpickle(b"\x80\x04" + built(b"K\x02\x85", OBJECT, b"](K\x01NeN0") + b".")
    assert found.tolist() == [1, None]
    found = unpickle(b"\x80\x04" + SCALAR + INT64 + b"C\x08" + bytes([9, *[0] * 7]) + b"\x86R.")
    assert found == 9
    buffer = BUFFER + b"(C\x08" + bytes([5, *[0] * 7]) + INT64 + b"K\x01\x85" + text("C") + b"tR"
    assert unpickle(b"\x80\x04" + buffer + b".").tolist() == [5]


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "text", "another object", "version"])
def test_damaged_files(tmp_path, damage):
    path = tmp_path / "a.npy"
    np.save(path, ragged([1, 2], [3]), allow_pickle=True)
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        replacement = {
            "empty": b"",
            "cut": content[:-20],
            "text": b"0 1\n1 2\n",
            "another object": content[:128] + pickle.dumps([1, 2]),
            "version": content[:6] + b"\x09" + content[7:],
        }
        path.write_bytes(replacement[damage])
    words = "found no such file" if damage == "missing" else "cannot be read"
    with pytest.raises(InputError, match=rf"a\.npy: {words}") as caught:
        read_npy(path)
    assert "\n" not in str(caught.value)


def test_an_archive_of_arrays_is_told(tmp_path):
    """Under its own suffix, another one, or in place of the file that is read."""
    array = np.arange(3)
    np.savez(tmp_path / "gt.npz", matches=array, other=array)
    words = (
        r"gt\.npz: found an \.npz archive of matches, other, expected one array: "
        r"numpy\.save\('gt\.npy', numpy\.load\('gt\.npz'\)\['matches'\]\) writes it"
    )
    for path in (tmp_path / "gt.npz", tmp_path / "gt.npy"):
        with pytest.raises(InputError, match=words):
            read_npy(path)
    with pytest.raises(InputError, match=words):
        open_benchmark(tmp_path / "gt.npz")
    with pytest.raises(InputError, match=words):
        read_descriptors(tmp_path / "gt.npz")
    with pytest.raises(InputError, match=words):
        open_npy(tmp_path / "gt.npz")
    (tmp_path / "gt.npz").rename(tmp_path / "gt.npy")
    with pytest.raises(InputError, match=r"gt\.npy: found an \.npz archive of matches, other"):
        read_npy(tmp_path / "gt.npy")
    # What the message says works, also next to the archive.
    np.save(tmp_path / "one.npy", np.load(tmp_path / "gt.npy")["matches"])
    np.savez(tmp_path / "one.npz", array)
    assert read_npy(tmp_path / "one.npy").tolist() == [0, 1, 2]
