"""Locks of folders: one process at a time, whatever becomes of the one before it."""

import contextlib
import errno
import fcntl
import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.locks import lock
from crisalad_jax.utils.output import Note

LOCK = ".crisalad-lock"
REFUSED = "found another process that writes here"

HOLDER = """
import sys
from crisalad_jax.utils.locks import lock
with lock(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""
# Four children that take turns. Who finds another one inside fails by O_EXCL.
CONTENDERS = """
import os, sys, time
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.locks import lock
folder, inside = sys.argv[1:]
children = []
for _ in range(4):
    if child := os.fork():
        children.append(child)
        continue
    taken, end = 0, time.monotonic() + 1
    try:
        while time.monotonic() < end:
            try:
                with lock(folder):
                    os.close(os.open(inside, os.O_CREAT | os.O_EXCL))
                    os.unlink(inside)
                    taken += 1
            except InputError as error:
                assert "another process that writes here" in str(error), error
        os._exit(0 if taken else 3)
    except BaseException as error:
        print(repr(error), flush=True)
        os._exit(1)
print([os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children])
"""


@contextlib.contextmanager
def held(folder: pathlib.Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the lock of the folder until its stdin ends."""
    program = [sys.executable, "-c", HOLDER, str(folder)]
    pipe = subprocess.PIPE
    with subprocess.Popen(program, stdin=pipe, stdout=pipe, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.kill()


def is_free(folder: pathlib.Path) -> bool:
    try:
        with lock(folder):
            return True
    except InputError as error:
        if REFUSED not in str(error):
            raise
        return False


def contents(folder: pathlib.Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def fails_in(folder: pathlib.Path, work: Callable[[], object] = lambda: None) -> None:
    """An error while the lock is held."""

    def fail() -> None:
        with lock(folder):
            work()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()


def test_a_second_process_is_refused_and_told_of_the_first(tmp_path):
    folder = tmp_path / "out"
    with held(folder) as process:
        before = contents(folder)
        with pytest.raises(InputError) as error, lock(folder):
            pass
        assert str(error.value) == (
            f"{folder}: {REFUSED} (process {process.pid} on {socket.gethostname()}), "
            "expected to be the only one"
        )
        assert contents(folder) == before
        assert not is_free(folder)  # to be refused changes nothing
        process.communicate()  # ends its stdin
        assert process.returncode == 0
        assert os.listdir(folder) == []
        assert is_free(folder)


def test_a_process_is_refused_its_own_folder_and_two_have_two_locks(tmp_path):
    with lock(tmp_path), lock(tmp_path / "b"), lock(tmp_path / "b" / "c"):
        with pytest.raises(InputError, match=rf"{REFUSED} \(process {os.getpid()} on "):
            lock(tmp_path).__enter__()
        assert (tmp_path / LOCK).exists()
        assert not is_free(tmp_path / "b")
    assert is_free(tmp_path)


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    with held(tmp_path) as process:
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        # Its file is left, with its words.
        assert f"process {process.pid} on " in (tmp_path / LOCK).read_text()
        with lock(tmp_path):
            words = f"process {os.getpid()} on {socket.gethostname()}\n"
            assert (tmp_path / LOCK).read_text() == words
            assert not is_free(tmp_path)
    assert os.listdir(tmp_path) == []


def test_an_error_frees_the_lock_and_removes_what_was_made_for_it(tmp_path):
    folder = tmp_path / "new" / "deep"
    fails_in(folder)
    assert os.listdir(tmp_path) == []
    fails_in(folder, lambda: (folder / "work").write_text("half"))
    assert contents(tmp_path) == {"new/deep/work": b"half"}
    assert is_free(folder)
    empty = tmp_path / "empty"  # a folder that was there stays
    empty.mkdir()
    fails_in(empty)
    assert os.listdir(empty) == []


def test_a_users_files_are_untouched(tmp_path):
    for name in ("notes.txt", ".lock", ".crisalad-notes", "crisalad-lock", ".env"):
        (tmp_path / name).write_text(f"theirs: {name}")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / LOCK).write_text("of another folder")
    before = contents(tmp_path)
    assert len(before) == 6
    with lock(tmp_path):
        assert contents(tmp_path).items() > before.items()
    assert contents(tmp_path) == before
    fails_in(tmp_path)
    assert contents(tmp_path) == before


def test_a_holder_that_removes_its_file_meanwhile_does_not_give_two_locks(tmp_path, monkeypatch):
    """Between opening and locking: the lock would be of a file that is no longer there."""
    real, calls = fcntl.flock, []

    def meanwhile(file, how):
        calls.append(how)
        if len(calls) == 1:
            (tmp_path / LOCK).unlink()
        return real(file, how)

    monkeypatch.setattr(fcntl, "flock", meanwhile)
    with lock(tmp_path):
        assert len(calls) == 2
        assert not is_free(tmp_path)


def test_processes_that_race_are_never_two_inside(tmp_path):
    program = [sys.executable, "-c", CONTENDERS, str(tmp_path / "out"), str(tmp_path / "inside")]
    done = subprocess.run(program, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("[0, 0, 0, 0]\n", 0), done.stdout + done.stderr
    assert os.listdir(tmp_path) == ["out"]
    assert os.listdir(tmp_path / "out") == []


def test_a_folder_that_cannot_be_locked_is_one_line(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "out" / LOCK).mkdir(parents=True)
    for name, words in (
        ("file/deep", ": cannot make this folder: Not a directory"),
        ("out", f"/{LOCK}: cannot be written: Is a directory"),
    ):
        with pytest.raises(InputError, match=f"^{tmp_path / name}{words}"):
            lock(tmp_path / name).__enter__()
    assert sorted(os.listdir(tmp_path)) == ["file", "out"]


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_a_lock_that_is_a_link_changes_nothing_behind_it(tmp_path, link):
    mine, folder = tmp_path / "thesis.txt", tmp_path / "foreign"
    mine.write_text("mine")
    folder.mkdir()
    link(mine, folder / LOCK)
    with pytest.raises(InputError, match=f"^{folder / LOCK}: cannot be written: .*link"):
        lock(folder).__enter__()
    assert (mine.read_text(), os.listdir(folder)) == ("mine", [LOCK])


@pytest.mark.parametrize("kind", ["pipe", "a link to nothing"])
def test_a_lock_that_is_no_file_is_one_line(tmp_path, kind):
    if kind == "pipe":
        os.mkfifo(tmp_path / LOCK)
    else:
        (tmp_path / LOCK).symlink_to(tmp_path / "new")
    with pytest.raises(InputError, match=f"^{tmp_path / LOCK}: cannot be written: .*link"):
        lock(tmp_path).__enter__()
    assert os.listdir(tmp_path) == [LOCK]


def test_a_disk_without_locks_keeps_no_lock_file(tmp_path, monkeypatch):
    def without(file, how):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", without)
    with pytest.raises(InputError, match=f"{LOCK}: cannot be written: No locks available"):
        lock(tmp_path / "new").__enter__()
    assert os.listdir(tmp_path) == []


def test_the_next_writer_waits_and_tells_of_the_first(tmp_path):
    folder = tmp_path / "out"
    with held(folder) as process:
        assert process.stdin is not None
        # Ends the holder while this process waits.
        threading.Timer(0.3, process.stdin.close).start()
        words = rf"out: waiting for another process \(process {process.pid} on "
        second = lock(folder, wait=60)
        with pytest.warns(Note, match=words):
            second.__enter__()
        assert process.wait(10) == 0
        assert not is_free(folder)
        second.__exit__(None, None, None)
    assert is_free(folder)
