"""Downloads from a server on loopback that fails as real ones do."""

import copy
import os
import pathlib
import resource
from collections.abc import Iterator

import numpy as np
import pytest

from crisalad_jax.utils import download as downloads
from crisalad_jax.utils.download import MissingFileError, download
from crisalad_jax.utils.errors import InputError
from tests.file_server import FileServer, file_server

SIZE = 300_000
DATA = np.random.default_rng(0).bytes(SIZE)
OTHER = np.random.default_rng(1).bytes(SIZE)


@pytest.fixture
def server() -> Iterator[FileServer]:
    with file_server() as server:
        server.files["/file"] = DATA
        yield server


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    # Long enough for loopback on a loaded machine where nothing stalls.
    for name, value in (("_TIMEOUT", 5.0), ("_ATTEMPTS", 2), ("_PAUSE", 0.01)):
        monkeypatch.setattr(downloads, name, value)


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "https_proxy", "all_proxy", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)


def fetch(server: FileServer, folder: pathlib.Path) -> pathlib.Path:
    download(server.url("/file"), folder / "here", label="file", quiet=True)
    assert sorted(os.listdir(folder)) == ["here"]
    return folder / "here"


def fails(server: FileServer, folder: pathlib.Path, words: str) -> InputError:
    with pytest.raises(InputError, match=words) as error:
        fetch(server, folder)
    assert not (folder / "here").exists()
    assert str(error.value).startswith(f"{server.url('/file')}: ")
    assert "\n" not in str(error.value)
    return error.value


def cut_short(server: FileServer, folder: pathlib.Path, size: int) -> None:
    """Leave the beginning of a file, as if the program had ended there."""
    server.cuts = [size, 0]
    fails(server, folder, f"found {size:,} bytes of 300,000")
    assert (folder / "here.part").read_bytes() == DATA[:size]
    server.asked.clear()


CUT = {"cuts": [100_000]}
REST = "bytes=100000-"


def test_a_part_that_begins_elsewhere_is_not_joined(server, tmp_path):
    cut_short(server, tmp_path, 100_000)
    server.shift = 10
    assert fetch(server, tmp_path).read_bytes() == DATA
    assert server.asked == [("/file", REST), ("/file", None)]


@pytest.mark.parametrize(
    ("answers", "asked"),
    [
        ({}, [None]),
        (CUT, [None, REST]),
        (CUT | {"etag": None, "modified": "Mon, 01 Jan 2024 00:00:00 GMT"}, [None, REST]),
        (CUT | {"ranges": False}, [None, REST]),
        # Without a strong tag and a time another file would not be noticed.
        (CUT | {"etag": None}, [None, None]),
        (CUT | {"etag": 'W/"1"'}, [None, None]),
        ({"statuses": [503]}, [None, None]),
    ],
)
def test_a_file_arrives_and_a_cut_is_gone_on_from(server, tmp_path, answers, asked):
    vars(server).update(copy.deepcopy(answers))
    assert fetch(server, tmp_path).read_bytes() == DATA
    assert server.asked == [("/file", wanted) for wanted in asked]


@pytest.mark.parametrize(
    ("answers", "words", "count"),
    [
        ({"files": {}}, "found HTTP 404 Not Found, expected the file", 1),
        ({"statuses": [403]}, "found HTTP 403 Forbidden", 1),
        ({"statuses": [500, 429]}, "found HTTP 429 Too Many Requests, .*attempts: 2", 2),
    ],
)
def test_what_does_not_arrive_is_told_and_nothing_stays(server, tmp_path, answers, words, count):
    vars(server).update(copy.deepcopy(answers))
    error = fails(server, tmp_path, words)
    assert isinstance(error, MissingFileError) == ("404" in words)
    assert os.listdir(tmp_path) == []
    assert len(server.asked) == count


def test_a_whole_unfinished_file_is_not_asked_for(server, tmp_path):
    cut_short(server, tmp_path, 200_000)
    (tmp_path / "here.part").write_bytes(DATA)
    assert fetch(server, tmp_path).read_bytes() == DATA
    assert server.asked == []


@pytest.mark.parametrize("obeys", [True, False])
def test_a_changed_file_starts_again(server, tmp_path, obeys):
    cut_short(server, tmp_path, 100_000)
    server.files["/file"], server.etag = OTHER, '"2"'
    if not obeys:  # a server that sends a part of the other file, whatever the condition
        server.modified = '"1"'
    assert fetch(server, tmp_path).read_bytes() == OTHER


@pytest.mark.parametrize("size", [250_000, 50_000])  # the second is shorter than the beginning
def test_a_file_of_another_length_starts_again(server, tmp_path, size):
    cut_short(server, tmp_path, 100_000)
    server.files["/file"] = OTHER[:size]
    assert fetch(server, tmp_path).read_bytes() == OTHER[:size]


def test_a_note_that_is_damaged_starts_again(server, tmp_path):
    cut_short(server, tmp_path, 100_000)
    (tmp_path / "here.part.json").write_text("{")
    assert fetch(server, tmp_path).read_bytes() == DATA
    assert server.asked == [("/file", None)]


def test_a_megabyte_begins_the_count_again(server, tmp_path):
    server.files["/file"] = large = OTHER * 12
    server.cuts = [1_000_000] * 3
    assert fetch(server, tmp_path).read_bytes() == large


def test_a_stalled_server_is_given_up_and_asked_again(server, tmp_path, monkeypatch):
    monkeypatch.setattr(downloads, "_TIMEOUT", 0.3)
    server.stalls = 2
    fails(server, tmp_path, "found a broken connection .*attempts: 2")
    assert server.asked == [("/file", None), ("/file", "bytes=10-")]
    assert fetch(server, tmp_path).read_bytes() == DATA


def test_redirects_are_followed_with_the_range(server, tmp_path):
    server.files["/there"] = server.files.pop("/file")
    server.moved["/file"] = "/there"
    cut_short(server, tmp_path, 100_000)
    assert fetch(server, tmp_path).read_bytes() == DATA
    assert server.asked == [("/file", "bytes=100000-"), ("/there", "bytes=100000-")]


def test_a_proxy_of_the_environment_is_used(server, tmp_path, monkeypatch):
    monkeypatch.setenv("http_proxy", server.url(""))
    address = "http://models.invalid/file"
    server.files[address] = OTHER
    download(address, tmp_path / "here", label="file", quiet=True)
    assert (tmp_path / "here").read_bytes() == OTHER
    assert server.asked == [(address, None)]


def test_no_server(tmp_path):
    with file_server() as gone:
        pass
    fails(gone, tmp_path, "found no answer .*attempts: 2")
    assert os.listdir(tmp_path) == []


def test_a_folder_as_address(tmp_path):
    (tmp_path / "to").mkdir()
    for path in (tmp_path / "none", tmp_path):
        with pytest.raises(MissingFileError, match="found no such file"):
            download(path.as_uri(), tmp_path / "to" / "here", label="", quiet=True)
    (tmp_path / "there").write_bytes(DATA)
    download((tmp_path / "there").as_uri(), tmp_path / "to" / "here", label="", quiet=True)
    assert (tmp_path / "to" / "here").read_bytes() == DATA
    assert os.listdir(tmp_path / "to") == ["here"]


def test_a_disk_that_gets_full_leaves_nothing(server, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(InputError, match="here: cannot be written: File too large"):
            fetch(server, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(tmp_path) == []


def test_the_bar_shows_megabytes(server, tmp_path, capfd):
    download(server.url("/file"), tmp_path / "here", label="a model")
    assert "a model" in (shown := capfd.readouterr().err)
    assert "MB/s" in shown
