"""Checksums against hashlib, and files that are changed by a byte or lack theirs."""

import collections
import hashlib
import json
import random
import re
from collections.abc import Iterator

import numpy as np
import pytest

from crisalad_jax.utils.checksums import checksummed_json, sha256_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json

CHANGED = "found other bytes than were written, expected those of its checksum"
ZEROS = "0" * 64
# Zeros as those that stand for the digest while it is computed, a name that is not ASCII.
VALUE = {"zeros": ZEROS, "numbers": [1, 2.5, None, True], "Straße": {"of": "Zürich"}, "none": {}}


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


# As they are written


@pytest.mark.parametrize("indent", [None, 2])
def test_json_holds_the_digest_of_its_own_bytes(tmp_path, indent):
    data = checksummed_json(VALUE | {"checksum": "of another file"}, indent)
    found, expected = by_hashlib(data)
    assert found == expected != ZEROS
    assert list(json.loads(data).items()) == [("checksum", found), *VALUE.items()]
    path = tmp_path / "x.json"
    path.write_bytes(data)
    assert read_json(path, "some values") == VALUE


@pytest.mark.parametrize("size", [0, 3 * 2**20])
def test_the_digest_of_a_file_is_that_of_hashlib(tmp_path, size):
    """Also of one that is read in several portions."""
    data = np.random.default_rng(0).integers(0, 256, size, np.uint8)
    (tmp_path / "file").write_bytes(data.tobytes())
    assert sha256_of(tmp_path / "file") == hashlib.sha256(data.tobytes()).hexdigest()


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
            has_one = "checksum" in json.loads(data)
        except ValueError:
            has_one = False
        assert (CHANGED in message) == has_one, (place, message)
        refused[has_one] += 1
    assert refused.total() == 100
    assert min(refused[True], refused[False]) > 20
    path.write_bytes(whole)
    assert read_json(path, "some values") == VALUE


def test_files_that_are_cut_or_longer_are_refused(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, VALUE)
    whole = path.read_bytes()
    for data in (whole[:-1], whole + b" ", b" " + whole, whole.replace(b"\n", b"\r\n"), b""):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"x\.json: found (other bytes|no JSON)"):
            read_json(path, "some values")


@pytest.mark.parametrize(
    "digest", [ZEROS, "f" * 64, "0" * 63, "", "٣" * 64, "\ud800", None, [ZEROS]]
)
def test_a_wrong_checksum_is_refused(tmp_path, digest):
    path = tmp_path / "x.json"
    path.write_bytes((json.dumps({"checksum": digest} | VALUE) + "\n").encode())
    with pytest.raises(InputError, match=rf"x\.json: {CHANGED}"):
        read_json(path, "some values")


# Without a checksum, of another format, and unverified


def test_json_without_a_checksum_is_refused_unless_anybody_may_write_it(tmp_path):
    path = tmp_path / "x.json"
    for value in (VALUE, [1, 2], None):
        path.write_text(json.dumps(value))
        with pytest.raises(InputError, match=r"x\.json: found no checksum, expected some values"):
            read_json(path, "some values")
        assert read_json(path, "some values", sealed=False) == value
