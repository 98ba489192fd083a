"""Files appear whole or not at all."""

import os
import pathlib

import numpy as np
import pytest

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import (
    atomic_folder,
    atomic_path,
    check_new_folder,
    check_target,
    write_json,
    write_npy,
)
from crisalad_jax.utils.temporaries import (
    holds_other_files,
    is_temporary,
    remove_temporaries,
    temporary_beside,
)


def test_the_file_appears_when_it_is_whole(tmp_path: pathlib.Path):
    path = tmp_path / "new" / "folder" / "numbers.npy"
    with atomic_path(path) as temporary:
        assert temporary.suffix == ".npy"
        assert temporary.parent == path.parent  # a rename within a folder is atomic
        temporary.write_bytes(b"12")
        assert not path.exists()
    assert path.read_bytes() == b"12"
    assert os.listdir(path.parent) == ["numbers.npy"]


def test_an_error_leaves_the_old_file_and_no_other(tmp_path: pathlib.Path):
    path = tmp_path / "numbers.npy"
    path.write_bytes(b"old")

    def fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"half")
            raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        fail()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["numbers.npy"]


def test_only_our_own_temporary_files_are_removed(tmp_path: pathlib.Path):
    """A user's hidden files look alike: a home folder is a folder of them."""
    theirs = {".env", ".bashrc", ".gitignore", ".0123456789ab", ".crisalad-notes", ".crisalad"}
    for name in theirs:
        (tmp_path / name).write_text("theirs")
    assert holds_other_files(tmp_path)
    ours = temporary_beside(tmp_path / "last.safetensors")
    assert is_temporary(ours)
    ours.write_text("cut off")
    remove_temporaries(tmp_path)
    assert set(os.listdir(tmp_path)) == theirs
    for name in theirs:
        (tmp_path / name).unlink()
    ours.write_text("cut off")
    assert not holds_other_files(tmp_path)


def test_two_writers_do_not_share_a_temporary_file(tmp_path: pathlib.Path):
    path = tmp_path / "numbers.txt"
    with atomic_path(path) as first, atomic_path(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # the last to finish


def test_a_folder_that_cannot_be_made_or_is_in_the_way_is_named(tmp_path: pathlib.Path):
    (tmp_path / "file").write_text("")
    (tmp_path / "taken").mkdir()
    for path in (tmp_path / "file" / "x.json", tmp_path / "file" / "deep" / "x.json"):
        with pytest.raises(InputError, match=f"^{path}: cannot be made: found {tmp_path}/file, "):
            write_json(path, {})
    with pytest.raises(InputError, match=f"^{tmp_path}/taken: found a folder"):
        write_json(tmp_path / "taken", {})
    assert sorted(os.listdir(tmp_path)) == ["file", "taken"]


def test_a_check_makes_nothing(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for path in ("x.json", "new/x.json", tmp_path / "new" / "deep" / "x.json"):
        check_target(path)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("dtype", ["float16", "float32"])
@pytest.mark.parametrize("shape", [(0, 3), (5, 3), (4000, 30)])
def test_an_array_is_written_as_numpy_writes_it(tmp_path, dtype, shape):
    array = np.random.default_rng(0).standard_normal(shape[::-1]).T.astype(dtype)
    write_npy(tmp_path / "ours.npy", array)
    np.save(tmp_path / "theirs.npy", np.ascontiguousarray(array))
    assert (tmp_path / "ours.npy").read_bytes() == (tmp_path / "theirs.npy").read_bytes()


def test_a_durable_file_is_on_the_disk_before_and_after_it_has_its_name(tmp_path, monkeypatch):
    """First its bytes, then its name: the order in which both are told to the disk."""
    told = []

    def spied(name, real):
        def call(first, *more):
            path = os.readlink(f"/proc/self/fd/{first}") if name == "fsync" else str(first)
            told.append((name, pathlib.Path(path).name[:1]))
            return real(first, *more)

        monkeypatch.setattr(os, name, call)

    spied("fsync", os.fsync)
    spied("replace", os.replace)
    folder = tmp_path / "folder"
    with atomic_path(folder / "file.json", durable=True) as temporary:
        temporary.write_text("whole")
    assert told == [("fsync", "."), ("replace", "."), ("fsync", "f")]
    assert os.listdir(folder) == ["file.json"]


def test_a_folder_appears_when_it_is_whole_or_not_at_all(tmp_path: pathlib.Path):
    path = tmp_path / "new" / "export"

    def write(*, fail: bool) -> None:
        with atomic_folder(path) as temporary:
            assert temporary.parent == path.parent
            (temporary / "a").write_text("1")
            assert not path.exists()
            if fail:
                raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        write(fail=True)
    assert os.listdir(tmp_path) == []
    write(fail=False)
    assert os.listdir(path.parent) == ["export"]
    assert os.listdir(path) == ["a"]


def test_only_an_empty_folder_is_replaced(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    empty, file = tmp_path / "empty", tmp_path / "file"
    empty.mkdir()
    file.write_text("")
    monkeypatch.chdir(empty)
    with pytest.raises(InputError, match=f"^{empty}: found the working directory"):
        check_new_folder(empty)
    monkeypatch.chdir(tmp_path)
    with atomic_folder(empty) as temporary:
        (temporary / "a").write_text("1")
    assert os.listdir(empty) == ["a"]
    for path, found in (
        (empty, f"^{empty}: found a folder with files in it"),
        (file, f"^{file}: found a file"),
        (file / "new", f"^{file}/new: cannot be made: found {file}, expected a folder"),
    ):
        with pytest.raises(InputError, match=found):
            check_new_folder(path)
