"""Files appear whole or not at all."""

import json
import os
import pathlib

import pytest

from crisalad_jax.errors import InputError
from crisalad_jax.files import (
    atomic_folder,
    atomic_path,
    check_new_folder,
    check_target,
    write_json,
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


def test_json_is_written_whole_or_not_at_all(tmp_path: pathlib.Path):
    path = tmp_path / "x.json"
    write_json(path, {"a": [1, 2.5, None]})
    assert json.loads(path.read_text()) == {"a": [1, 2.5, None]}
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert json.loads(path.read_text()) == {"a": [1, 2.5, None]}
    assert os.listdir(tmp_path) == ["x.json"]


def test_a_folder_appears_when_it_is_whole(tmp_path: pathlib.Path):
    path = tmp_path / "new" / "export"
    with atomic_folder(path) as temporary:
        assert temporary.parent == path.parent
        (temporary / "a").write_text("1")
        assert not path.exists()
    assert [p.name for p in path.iterdir()] == ["a"]
    assert os.listdir(path.parent) == ["export"]


def test_an_error_leaves_no_folder(tmp_path: pathlib.Path):
    path = tmp_path / "export"

    def fail() -> None:
        with atomic_folder(path) as temporary:
            (temporary / "a").write_text("half")
            raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        fail()
    assert os.listdir(tmp_path) == []


def test_only_an_empty_folder_is_replaced(tmp_path: pathlib.Path):
    (tmp_path / "empty").mkdir()
    with atomic_folder(tmp_path / "empty") as temporary:
        (temporary / "a").write_text("1")
    assert os.listdir(tmp_path / "empty") == ["a"]
    (tmp_path / "file").write_text("")
    for name, found in (("empty", "a folder with files in it"), ("file", "cannot be made: found")):
        with pytest.raises(InputError, match=f"^{tmp_path / name}.*{found}"):
            check_new_folder(tmp_path / name)
