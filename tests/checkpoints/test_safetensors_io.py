"""Safetensors files and their checksums, and files that are changed by a byte or lack theirs."""

import hashlib
import json
import pathlib
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from crisalad_jax.checkpoints.safetensors_io import read_sealed, write_safetensors, write_sealed
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.temporaries import is_temporary
from tests.utils.test_checksums import flips

CHANGED = "found other bytes than were written, expected those of its checksum"
# A name that is not ASCII.
VALUE = {"numbers": [1, 2.5, None, True], "Straße": {"of": "Zürich"}, "none": {}}
ARRAYS = {
    "rows": np.random.default_rng(0).standard_normal((3, 4)).astype(np.float32),
    "number": np.float64(3)[...],
    "nothing": np.zeros((0, 2), np.int32),
}
FORM = "crisalad-jax some 2"


def load(path: pathlib.Path, *, verify: bool = True) -> Any:
    return read_sealed(path, FORM, "a file of some arrays", verify=verify)


@pytest.fixture
def path(tmp_path: pathlib.Path) -> pathlib.Path:
    write_sealed(tmp_path / "a.safetensors", ARRAYS, FORM, VALUE)
    return tmp_path / "a.safetensors"


def test_a_file_holds_the_digest_of_its_contents(path):
    """By the description of the format, and any other program reads it as well."""
    digest = hashlib.sha256(json.dumps(VALUE).encode())
    theirs = safetensors.numpy.load_file(path)
    assert theirs.keys() == ARRAYS.keys()
    for name, array in sorted(ARRAYS.items()):
        np.testing.assert_array_equal(theirs[name], array)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(hashlib.sha256(array.tobytes()).digest())
    with safetensors.safe_open(path, framework="numpy") as file:
        ((form, text),) = file.metadata().items()
    assert (form, json.loads(text)) == (FORM, {"checksum": digest.hexdigest()} | VALUE)
    value, ours = load(path)
    assert value == VALUE
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(ours[name], array)
        assert ours[name].dtype == array.dtype


def test_what_a_kill_leaves_is_what_the_next_writer_removes(tmp_path, monkeypatch):
    """The library writes `.tmpXXXXXX` beside the file that it is given, and then renames it."""
    write, seen = safetensors.numpy.save_file, []

    def killed(arrays, target, **options):
        folder = pathlib.Path(target).parent
        (folder / ".tmpErgpBx").touch()  # its own, of an earlier kill
        write(arrays, target, **options)
        seen.extend(path for path in tmp_path.iterdir() if not is_temporary(path))

    monkeypatch.setattr(safetensors.numpy, "save_file", killed)
    write_sealed(tmp_path / "a.safetensors", ARRAYS, FORM, VALUE)
    assert seen == []
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


def test_one_other_byte_is_refused(path):
    whole, refused = path.read_bytes(), 0
    for place, data in flips(whole, 200):
        path.write_bytes(data)
        with pytest.raises(InputError) as error:
            load(path)
        assert str(error.value).startswith(str(path)), place
        assert "\n" not in str(error.value)
        refused += CHANGED in str(error.value)
    assert refused > 40  # the others are no safetensors
    path.write_bytes(whole)
    assert load(path)[0] == VALUE


@pytest.mark.parametrize("place", [b'"none\\":', b'"crisalad-jax some 2"', b'"rows":', b'"F32"'])
def test_one_other_byte_of_a_header_is_refused_whatever_the_byte(path, place):
    """A format's number may become another's, a type another type."""
    whole = path.read_bytes()
    at = whole.index(place) + len(place) - 2
    for other in set(range(256)) - {whole[at]}:
        path.write_bytes(whole[:at] + bytes([other]) + whole[at + 1 :])
        with pytest.raises(InputError):
            load(path)


def test_files_that_are_cut_or_longer_are_refused(path):
    whole = path.read_bytes()
    other = b"PK\3\4" + bytes(1000)  # a torch file begins so
    for data in (whole[:-1], whole + b"\0", whole[:100], whole[:7], b"", other):
        path.write_bytes(data)
        with pytest.raises(
            InputError, match=r"not a whole safetensors file .*, expected a file of"
        ):
            load(path)


@pytest.mark.parametrize("digest", ["f" * 64, "", None, ["0" * 64]])
def test_another_checksum_is_refused_unless_it_is_not_verified(path, digest):
    metadata = {FORM: json.dumps({"checksum": digest} | VALUE)}
    safetensors.numpy.save_file(ARRAYS, path, metadata=metadata)
    with pytest.raises(InputError, match=rf"a\.safetensors: {CHANGED}"):
        load(path)
    assert load(path, verify=False)[0] == VALUE


@pytest.mark.parametrize("verify", [True, False])
@pytest.mark.parametrize("value", [VALUE, []])
def test_a_file_without_a_checksum_is_refused(path, value, verify):
    safetensors.numpy.save_file(ARRAYS, path, metadata={FORM: json.dumps(value)})
    with pytest.raises(InputError, match=r"\(metadata\): found no checksum, expected one in"):
        load(path, verify=verify)


def test_an_array_in_another_order_is_written_as_it_reads(path):
    """The library writes memory: columns first, it would be another array."""
    array = np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3))
    write_safetensors(path, {"a": array, "b": np.float32(3)}, {})
    found = safetensors.numpy.load_file(path)
    np.testing.assert_array_equal(found["a"], array)
    assert found["b"].shape == ()
