"""The cache of files at addresses: its bound, what goes first, kills, and several processes."""

import contextlib
import pathlib
import signal
import subprocess
import sys
import time

import fsspec
import pytest

from crisalad_jax.data import file_cache
from crisalad_jax.data.file_cache import FileCache
from crisalad_jax.utils.errors import InputError

LIMIT = 2**18
SIZE = 2**10 - 32
"""Of an image; its digests have the other bytes. Of 16 folders each has room for 16 such files."""


def held(folder: pathlib.Path) -> list[pathlib.Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def stored(folder: pathlib.Path) -> int:
    total = 0
    for path in held(folder):
        with contextlib.suppress(FileNotFoundError):  # another process has dropped it
            total += path.stat().st_size
    return total


@pytest.fixture
def far(monkeypatch):
    """fsspec's memory, and the paths that were read from it."""
    files, read = fsspec.filesystem("memory"), []
    real = type(files).cat_file

    def cat_file(self, path, *given, **options):
        read.append(path)
        return real(self, path, *given, **options)

    monkeypatch.setattr(type(files), "cat_file", cat_file)
    monkeypatch.setattr(file_cache, "_FOLDERS", 16)
    files.read = read
    files.mkdir("/far")
    yield files
    files.rm("/far", recursive=True)


def test_a_file_is_read_once_from_far_away(far, tmp_path):
    far.pipe("/far/a.jpg", b"abc")
    for _ in range(2):  # two runs, or processes
        cache = FileCache(tmp_path / "images", LIMIT)
        assert [cache.read("memory://far/a.jpg") for _ in range(3)] == [b"abc"] * 3
    assert far.read == ["/far/a.jpg"]
    (file,) = held(tmp_path)
    assert file.stat().st_size == 32 + 3


def test_a_changed_file_is_read_again_by_the_next_run(far, tmp_path):
    far.pipe("/far/a.jpg", b"abc")
    FileCache(tmp_path, LIMIT).read("memory://far/a.jpg")
    far.pipe("/far/a.jpg", b"def")
    assert FileCache(tmp_path, LIMIT).read("memory://far/a.jpg") == b"def"
    assert len(held(tmp_path)) == 1


@pytest.mark.parametrize("bytes", [b"", b"x" * 10, b"x" * 35])
def test_a_damaged_file_is_read_again(far, tmp_path, bytes):
    far.pipe("/far/a.jpg", b"abc")
    FileCache(tmp_path, LIMIT).read("memory://far/a.jpg")
    (file,) = held(tmp_path)
    whole = file.read_bytes()
    file.write_bytes(bytes)
    cache = FileCache(tmp_path, LIMIT)
    assert cache.read("memory://far/a.jpg") == b"abc"
    assert file.read_bytes() == whole


def test_the_room_is_bounded_and_what_was_used_last_stays(far, tmp_path):
    """512 files for room of 256: each folder gets 32 or so, and has 14 at most."""
    cache = FileCache(tmp_path, LIMIT)
    far.pipe("/far/used.jpg", b"u" * SIZE)
    for number in range(512):
        far.pipe(f"/far/{number}.jpg", bytes(SIZE))
        cache.read(f"memory://far/{number}.jpg")
        cache.read("memory://far/used.jpg")
        if number % 64 == 0:
            assert stored(tmp_path) <= LIMIT
    assert LIMIT * 3 / 4 < stored(tmp_path) <= LIMIT
    assert far.read.count("/far/used.jpg") == 1
    there = {path.name for path in held(tmp_path)}

    def is_there(number: int) -> bool:
        return file_cache._digest(f"memory://far/{number}.jpg".encode()).hex() in there

    # The last 64 are four or so of each folder's 14, the first 64 the oldest of some 32.
    assert all(map(is_there, range(448, 512)))
    assert not any(map(is_there, range(64)))


def test_what_is_larger_than_a_share_or_finds_no_room_is_read_from_far_away(far, tmp_path):
    far.pipe("/far/large.jpg", bytes(LIMIT // 16))
    far.pipe("/far/a.jpg", b"abc")
    assert FileCache(tmp_path, LIMIT).read("memory://far/large.jpg") == bytes(LIMIT // 16)
    cache = FileCache(tmp_path / "made", LIMIT)
    (tmp_path / "made").write_bytes(b"")  # no folder any more
    assert cache.read("memory://far/a.jpg") == b"abc"
    assert [path.name for path in held(tmp_path)] == ["made"]


def test_what_cannot_be_read_or_cached_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"^memory://far/none.jpg: cannot be read: found no such"):
        FileCache(tmp_path, LIMIT).read("memory://far/none.jpg")
    assert not held(tmp_path)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="found a file, expected a folder"):
        FileCache(tmp_path / "file", LIMIT)


PROGRAM = """
import pathlib, sys
from crisalad_jax.data import file_cache
seed, folder = int(sys.argv[1]), pathlib.Path(sys.argv[2])
state, read = lambda path: "state", lambda path: str(path).encode() * 50
file_cache.state_of, file_cache.read_remote = state, read
cache = file_cache.FileCache(folder, 2**20)
print("ready", flush=True)
for number in range(seed, 10**9, 7):
    address = f"s3://bucket/{number % 3000}.jpg"
    assert cache.read(address) == read(address), address
"""


@pytest.mark.slow
def test_processes_share_it_and_a_kill_leaves_no_half_file(tmp_path):
    """Four read and drop each other's files; each is killed five times."""
    programs: dict[int, subprocess.Popen[bytes]] = {}
    try:
        for turn in range(20):
            of = turn % 4
            if of in programs:
                assert programs[of].poll() is None, "it met a file of other bytes"
                programs[of].send_signal(signal.SIGKILL)
                programs[of].wait(60)
            given = [sys.executable, "-c", PROGRAM, str(of), str(tmp_path)]
            programs[of] = subprocess.Popen(given, stdout=subprocess.PIPE)
            assert programs[of].stdout is not None
            assert programs[of].stdout.readline() == b"ready\n"
            time.sleep(0.5)
            # Four files under temporary names may be there for a moment, or of killed processes.
            assert stored(tmp_path) <= 2**20
    finally:
        for program in programs.values():
            program.kill()
            program.wait(60)
    assert len(held(tmp_path)) > 500
