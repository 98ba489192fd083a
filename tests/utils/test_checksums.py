"""Checksums against hashlib, and files that are changed by a byte or lack theirs."""

import collections
import hashlib
import json
import pathlib
import random
import re
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import safetensors
import safetensors.numpy

from crisalad_jax.checkpoints.safetensors_io import Contents, read_sealed, write_sealed
from crisalad_jax.utils.checksums import checked_safetensors, checksummed_json, sha256_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json

CHANGED = "found other bytes than were written, expected those of its checksum"
NONE = "found no checksum"
ZEROS = "0" * 64
# Zeros as those that stand for the digest while it is computed, a name that is not ASCII.
VALUE = {"zeros": ZEROS, "numbers": [1, 2.5, None, True], "Straße": {"of": "Zürich"}, "none": {}}
ARRAYS = {
    "zeros": np.frombuffer(ZEROS.encode(), np.uint8),
    "rows": np.random.default_rng(0).standard_normal((3, 4)).astype(np.float32),
}
FORM = "crisalad-jax some 2"


def by_hashlib(data: bytes) -> tuple[str, str]:
    """The digest in a file, and what it should be by the description of the format."""
    found = re.findall(rb'\\?"checksum\\?": \\?"([0-9a-f]{64})\\?"', data)
    assert len(found) == 1
    return found[0].decode(), hashlib.sha256(data.replace(found[0], ZEROS.encode())).hexdigest()


def flips(data: bytes, count: int) -> Iterator[tuple[int, bytes]]:
    """Copies with one other byte each, at places that differ.

    By turns any byte, and one that differs in a low bit: a letter, or digit, is mostly another one.
    """
    generator = random.Random(0)
    for turn, place in enumerate(generator.sample(range(len(data)), count)):
        other = generator.randrange(1, 256) if turn % 2 else 2 ** generator.randrange(3)
        yield place, data[:place] + bytes([data[place] ^ other]) + data[place + 1 :]


def load(path: pathlib.Path, *, verify: bool = True) -> Contents:
    with checked_safetensors(path, verify=verify):
        return read_sealed(path, FORM, "a file of some arrays")


def with_checksum(value: object) -> bytes:
    """JSON whose checksum is this value."""
    return (json.dumps({"checksum": value} | VALUE) + "\n").encode()


@pytest.fixture
def arrays(tmp_path) -> pathlib.Path:
    path = tmp_path / "a.safetensors"
    write_sealed(path, ARRAYS, FORM, VALUE)
    return path


# As they are written


@pytest.mark.parametrize("indent", [None, 2])
def test_json_holds_the_digest_of_its_own_bytes(tmp_path, indent):
    data = checksummed_json(VALUE, indent)
    found, expected = by_hashlib(data)
    assert found == expected != ZEROS
    value = json.loads(data)
    assert list(value) == ["checksum", *VALUE]
    assert value == {"checksum": found} | VALUE
    path = tmp_path / "x.json"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_json(path, "some values") == VALUE


def test_safetensors_hold_the_digest_of_their_own_bytes(arrays):
    found, expected = by_hashlib(arrays.read_bytes())
    assert found == expected != ZEROS
    # Any other program reads it as well.
    with safetensors.safe_open(arrays, framework="numpy") as file:
        (metadata,) = file.metadata().items()
    assert (metadata[0], json.loads(metadata[1])) == (FORM, {"checksum": found} | VALUE)
    theirs = safetensors.numpy.load_file(arrays)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        value, ours = load(arrays)
    assert value == VALUE
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(theirs[name], array)
        np.testing.assert_array_equal(ours[name], array)


def test_the_same_is_written_with_the_same_checksum_and_another_with_another(tmp_path):
    assert checksummed_json(VALUE) == checksummed_json(VALUE)
    digests = {
        by_hashlib(checksummed_json(value))[0]
        for value in (VALUE, VALUE | {"none": 0}, dict(reversed(VALUE.items())))
    }
    assert len(digests) == 3


@pytest.mark.parametrize("size", [0, 1, 2**20, 2**20 + 1, 3 * 2**20])
def test_the_digest_of_a_file_is_that_of_hashlib(tmp_path, size):
    """Also of one that is read in several portions."""
    data = np.random.default_rng(0).integers(0, 256, size, np.uint8)
    (tmp_path / "file").write_bytes(data.tobytes())
    assert sha256_of(tmp_path / "file") == hashlib.sha256(data.tobytes()).hexdigest()
    path = tmp_path / "a.safetensors"
    write_sealed(path, {"data": data}, FORM, {})
    assert np.array_equal(load(path).arrays["data"], data)
    found, expected = by_hashlib(path.read_bytes())
    assert found == expected
    if size:
        changed = bytearray(path.read_bytes())
        changed[-1] ^= 1
        path.write_bytes(changed)
        with pytest.raises(InputError, match=CHANGED):
            load(path)


# Changed


def test_one_other_byte_of_json_is_refused(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, VALUE)
    whole, refused = path.read_bytes(), collections.Counter[bool]()
    for place, data in flips(whole, 100):
        path.write_bytes(data)
        with pytest.raises(InputError) as error:
            read_json(path, "some values")
        message = str(error.value)
        assert message.startswith(f"{path}: found "), place
        assert "\n" not in message
        try:
            found = json.loads(data).get("checksum", "")
        except ValueError:
            found = ""  # no JSON
        still = re.fullmatch("[0-9a-f]{64}", found) is not None
        assert (CHANGED in message) == still, (place, message)
        refused[still] += 1
    assert refused.total() == 100
    assert min(refused[True], refused[False]) > 20
    path.write_bytes(whole)
    assert read_json(path, "some values") == VALUE


def test_json_that_may_lack_a_checksum_is_taken_for_an_old_file_only_if_the_key_has_changed(
    tmp_path,
):
    path = tmp_path / "x.json"
    write_json(path, VALUE)
    whole, passed = path.read_bytes(), set()
    key = whole.index(b"checksum")
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                value = read_json(path, "some values")
            except InputError:
                continue
        assert [NONE in str(one.message) for one in told] == [True]
        assert {name: value[name] for name in VALUE} == VALUE
        passed.add(place)
    assert passed <= set(range(key, key + len("checksum")))


def test_one_other_byte_of_safetensors_is_refused(arrays):
    whole, refused = arrays.read_bytes(), []
    for place, data in flips(whole, 100):
        arrays.write_bytes(data)
        with pytest.raises(InputError) as error:
            load(arrays)
        message = str(error.value)
        assert message.startswith(str(arrays)), place
        assert "\n" not in message
        refused.append(message)
    assert len(refused) == 100
    assert sum(CHANGED in message for message in refused) > 30  # the others are no safetensors
    arrays.write_bytes(whole)
    assert load(arrays).value == VALUE


@pytest.mark.parametrize("place", [b'"zeros\\":', b'"crisalad-jax some 2"', b'"rows":', b'"F32"'])
def test_one_other_byte_of_a_header_is_refused_whatever_the_byte(arrays, place):
    """A format's number may become another's, a type another type."""
    whole = arrays.read_bytes()
    assert whole.count(place) == 1
    at = whole.index(place) + len(place) - 2
    for other in set(range(256)) - {whole[at]}:
        arrays.write_bytes(whole[:at] + bytes([other]) + whole[at + 1 :])
        with pytest.raises(InputError):
            load(arrays)


def test_files_that_are_cut_or_longer_are_refused(arrays, tmp_path):
    whole = arrays.read_bytes()
    for data in (whole[:-1], whole[:-100], whole + b"\0", whole[:100], whole[:7], b""):
        arrays.write_bytes(data)
        with pytest.raises(InputError, match=rf"a\.safetensors: ({CHANGED}|not a whole)"):
            load(arrays)
    path = tmp_path / "x.json"
    write_json(path, VALUE)
    whole = path.read_bytes()
    for data in (whole[:-1], whole + b" ", b" " + whole, whole.replace(b"\n", b"\r\n"), b""):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"x\.json: found (other bytes|no JSON)"):
            read_json(path, "some values")


@pytest.mark.parametrize(
    ("digest", "words"),
    [
        (ZEROS, CHANGED),
        ("f" * 64, CHANGED),
        ("F" * 64, "found checksum 'F+', expected 64 hexadecimal digits"),
        (f" {ZEROS[1:]}", "expected 64 hexadecimal digits"),
        ("0" * 63, "expected 64 hexadecimal digits"),
        ("0" * 65, "expected 64 hexadecimal digits"),
        ("", "found checksum '', expected 64 hexadecimal digits"),
        ("٣" * 64, "expected 64 hexadecimal digits"),
        (None, "found checksum None, expected 64 hexadecimal digits"),
        (64 * 1.0, r"found checksum 64\.0, expected 64 hexadecimal digits"),
        ([ZEROS], "expected 64 hexadecimal digits"),
    ],
)
def test_a_checksum_that_is_none_is_refused(tmp_path, digest, words):
    path = tmp_path / "x.json"
    path.write_bytes(with_checksum(digest))
    with pytest.raises(InputError, match=rf"x\.json: .*{words}"):
        read_json(path, "some values")
    path = tmp_path / "a.safetensors"
    metadata = {FORM: json.dumps({"checksum": digest} | VALUE)}
    safetensors.numpy.save_file(ARRAYS, path, metadata=metadata)
    with pytest.raises(InputError, match=rf"a\.safetensors: {CHANGED}"):
        load(path)


def test_the_right_digest_in_uppercase_is_refused(arrays, tmp_path):
    path = tmp_path / "x.json"
    write_json(path, VALUE)
    for file, read, words in (
        (path, lambda: read_json(path, "some values"), "expected 64 hexadecimal digits"),
        (arrays, lambda: load(arrays), CHANGED),
    ):
        data = file.read_bytes()
        digest = by_hashlib(data)[0]
        assert digest != digest.upper()
        file.write_bytes(data.replace(digest.encode(), digest.upper().encode()))
        with pytest.raises(InputError, match=words):
            read()


# Without a checksum, of another format, and unverified


def test_json_without_a_checksum_is_refused_unless_anybody_may_write_it(tmp_path):
    path = tmp_path / "x.json"
    values: list[Any] = [VALUE, [1, 2], 3, None]
    for value in values:
        path.write_text(json.dumps(value))
        with pytest.raises(InputError, match=r"x\.json: found no checksum, expected some values"):
            read_json(path, "some values")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert read_json(path, "some values", sealed=False) == value


@pytest.mark.parametrize("verify", [True, False])
def test_safetensors_of_another_format_are_refused(tmp_path, verify):
    path = tmp_path / "a.safetensors"
    write_sealed(path, ARRAYS, "crisalad-jax some 1", VALUE)
    with pytest.raises(InputError, match=r"^\S+a\.safetensors: found .*'crisalad-jax some 1'"):
        load(path, verify=verify)


@pytest.mark.parametrize("verify", [True, False])
def test_safetensors_without_a_checksum_are_refused(tmp_path, verify):
    path = tmp_path / "a.safetensors"
    for value in (VALUE, [], 3):
        safetensors.numpy.save_file(ARRAYS, path, metadata={FORM: json.dumps(value)})
        with pytest.raises(InputError, match=r"\(metadata\): found no checksum, expected one in"):
            load(path, verify=verify)


def test_what_is_not_verified_is_not_compared(arrays):
    data = bytearray(arrays.read_bytes())
    data[-1] ^= 1
    arrays.write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.safetensors: {CHANGED}"):
        load(arrays)
    assert load(arrays, verify=False).value == VALUE


def test_an_error_of_the_block_is_kept_unless_the_file_has_changed(arrays):
    def fail(kind: type[Exception]) -> None:
        with checked_safetensors(arrays, verify=True):
            raise kind("of the block")

    with pytest.raises(InputError, match="of the block"):
        fail(InputError)
    data = bytearray(arrays.read_bytes())
    data[-1] ^= 1
    arrays.write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.safetensors: {CHANGED}") as error:
        fail(InputError)
    assert str(error.value.__cause__) == "of the block"
    with pytest.raises(ZeroDivisionError):
        fail(ZeroDivisionError)
