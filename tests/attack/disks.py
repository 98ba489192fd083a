"""Fill the disk, forbid writing and take folders away while each verb works.

    python -m tests.attack.disks --out rows.json [--scale 1] [--only VERB ...]

A full disk is a small file system in memory, which needs root, in a mount namespace of this
process; where that cannot be, and for `VERB limited`, it is a limit on the size of a file. Root
cannot be refused a folder where nothing can be mounted.
"""

import contextlib
import ctypes
import functools
import hashlib
import json
import os
import pathlib
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping

from tests.attack.world import (
    COMMANDS,
    Attack,
    Bench,
    Done,
    Row,
    World,
    arguments,
    carry_out,
    command,
    differences,
    files_in,
    forked,
    has_temporaries,
    part_of,
    without_times,
)

PROMISE = (
    "exit code 2 and one line; no temporaries, nothing half written, what was there as before; "
    "then the same command finishes with the same bits"
)
PAGE = 4096
FRACTIONS = (0.3, 0.02, 0.97, 0.6, 0.85)
"""How full the disk may get, of what the results take: those that come first in short runs."""
RESUMABLE: Mapping[str, str] = {
    "train": "run",
    "compare": "comparison",
    "ablate": "ablation",
    "demo": "demo",
    "index": "map",
    "extract .npy": "d.npy.partial",
    "extract .h5": "d.h5.partial",
}
"""Folders that may stay behind: work that the same command goes on with."""
# Files that hold times, or are drawn from them.
_TIMED = re.compile(
    r"metrics\.jsonl|/tensorboard/|/state/|curves\.(png|svg|pdf)|training\.(json|png|svg|pdf)|speed\.json|index\.html|"
    r"table\.(md|csv|json)|results\.json|summary\.json|sittings\.json|test-\d\.json|map\.json|"
    r"config\.json|adapters\.json|\.names\.txt\.lock"
)
TARGETS: Mapping[str, tuple[str, ...]] = {
    "evaluate": ("table.json", "pictures/config.json", "report/index.html"),
    "extract .npy": ("d.npy", "d.names.txt", "d.npy.json"),
    "extract .h5": ("d.h5", "d.h5.json"),
    "pairs": ("pairs.txt",),
    "query": ("answers.json", "gallery.png"),
    "pca": ("pca.safetensors",),
    "convert": ("public.pth",),
    "info": ("info.json",),
    "vocabulary": ("v.safetensors",),
}
"""Files that a verb replaces where they are there."""


def _digest(path: pathlib.Path) -> str:
    """Return the digest of what is to be the same in two runs."""
    data = path.read_bytes()
    if path.suffix == ".json":
        data = json.dumps(without_times(json.loads(data))).encode()
    return hashlib.sha256(data).hexdigest()


def digests(folder: pathlib.Path) -> dict[str, str]:
    """Return the digests of all files but those that are made of times."""
    names = [name for name in files_in(folder) if not _TIMED.search(f"/{name}")]
    return {name: _digest(folder / name) for name in names if (folder / name).is_file()}


class Verb:
    """A command, and what it does undisturbed."""

    def __init__(self, name: str, world: World, out: pathlib.Path) -> None:
        """Run it with all the room it needs."""
        self.name, self._world = name, world
        out.mkdir(parents=True)
        done = self.start(out)
        assert done.code == 0, (name, done.err)
        self.seconds, self.digests = done.seconds, digests(out)
        files = [out / name for name in files_in(out)]
        self.sizes = [path.stat().st_size for path in files if path.is_file()]

    def start(
        self,
        out: pathlib.Path,
        *,
        file_limit: int | None = None,
        during: Callable[[int], None] | None = None,
    ) -> Done:
        """Run it in a process of its own, which may write no files larger than the limit."""

        def work() -> int:
            if file_limit is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, file_limit))
            return command(arguments(self.name, self._world, out))

        return forked(work, cwd=out.parent, limit=400, during=during)


@functools.cache
def can_mount() -> bool:
    """Take a mount namespace for this process; return whether that and a small disk work."""
    libc = ctypes.CDLL(None, use_errno=True)
    if os.getuid() or libc.unshare(0x00020000):  # CLONE_NEWNS
        return False
    private = subprocess.run(["mount", "--make-rprivate", "/"], capture_output=True)
    with tempfile.TemporaryDirectory() as folder:
        if private.returncode or _mount(pathlib.Path(folder), 4 * PAGE):
            return False
        _unmount(pathlib.Path(folder))
    return True


def _mount(folder: pathlib.Path, size: int) -> int:
    options = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    return subprocess.run(options, capture_output=True).returncode


def _remount(folder: pathlib.Path, option: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{option}", str(folder)], check=True)


def _unmount(folder: pathlib.Path) -> None:
    subprocess.run(["umount", "-l", str(folder)], check=True)


@contextlib.contextmanager
def small_disk(folder: pathlib.Path, size: int) -> Iterator[None]:
    """Let `folder` be a small disk in the block."""
    folder.mkdir(parents=True)
    # The smallest has one page: that one is full.
    assert _mount(folder, size + PAGE) == 0
    (folder / "full").write_bytes(b"0" * PAGE)
    try:
        yield
    finally:
        _unmount(folder)


def judge(
    row: Row, words: str, verb: Verb, out: pathlib.Path, done: Done, old: tuple[str, ...] = ()
) -> None:
    """Note what a disturbed command did wrong; `old` are files that hold OLD."""
    wrong = []
    if not done.told_in_one_line():
        wrong.append(f"code {done.code}, said {len(done.err.splitlines())} lines: {done.err!r}")
    if out.exists():
        wrong += [f"left {name}" for name in has_temporaries(out)]
        left = files_in(out) - {*old}
        kept = RESUMABLE.get(verb.name, "nothing")
        wrong += [f"left {n}" for n in sorted(left) if not n.startswith(f"{kept}/")]
        if left and kept not in done.err:
            wrong.append(f"does not name {kept}, which it left")
        for name in old:
            if not (out / name).is_file() or (out / name).read_bytes() != OLD:
                wrong.append(f"changed {name}")
    row.note(not wrong, f"{words}: {'; '.join(wrong)[:600]}")


OLD = b"before"


def finish(row: Row, words: str, verb: Verb, out: pathlib.Path) -> None:
    """Run the same command with room, and compare its files with the undisturbed ones."""
    done = verb.start(out)
    differ = differences(digests(out), verb.digests)
    right = done.code == 0 and not differ and not has_temporaries(out)
    row.note(right, f"{words}, again: code {done.code}, differ: {differ}: {done.err[-300:]!r}")


def fill(way: str, verb: Verb, folder: pathlib.Path, sizes: int, row: Row) -> None:
    """Give a verb less room than it needs, every second time over earlier files."""
    for number, fraction in enumerate(FRACTIONS[:sizes]):
        old = TARGETS.get(verb.name, ()) if number % 2 else ()
        words = f"room for {100 * fraction:.0f} %" + (" over earlier files" if old else "")
        disk, limit = folder / str(number), None
        if way == "limit":
            limit = int(fraction * max(verb.sizes))
            words, small = f"{words} of the largest file", contextlib.nullcontext()
        else:
            pages = sum(-(-size // PAGE) for size in verb.sizes)
            room = int(fraction * (pages - 1)) + len(old)
            words, small = f"{words} ({room} pages)", small_disk(disk, room * PAGE)
        with small:
            out = disk / "out"
            out.mkdir(parents=True)
            for name in old:
                (out / name).parent.mkdir(exist_ok=True)
                (out / name).write_bytes(OLD)
            judge(row, words, verb, out, verb.start(out, file_limit=limit), old)
            if way != "limit":
                _remount(disk, "size=1g")
            finish(row, words, verb, out)
        shutil.rmtree(disk)


def forbid(verb: Verb, folder: pathlib.Path, _: int, row: Row) -> None:
    """Let a verb write where it may not: to a disk to read, or as a user into a folder to read."""
    out = folder / "out"

    def try_it(forbid: Callable[[], object], allow: Callable[[], object]) -> None:
        out.mkdir(parents=True)
        forbid()
        judge(row, "nothing can be written", verb, out, verb.start(out))
        allow()
        finish(row, "nothing can be written", verb, out)

    if can_mount():
        with small_disk(folder, 2**30):
            try_it(lambda: _remount(folder, "ro"), lambda: _remount(folder, "rw"))
    else:
        try_it(lambda: out.chmod(0o555), lambda: out.chmod(0o755))


def remove(verb: Verb, folder: pathlib.Path, sizes: int, row: Row) -> None:
    """Remove the folder of the results once, at moments spread over the work."""
    for number in range(sizes):
        moment = (number + 0.7) / sizes
        out = folder / str(number) / "out"
        out.mkdir(parents=True)
        removal = functools.partial(shutil.rmtree, out, ignore_errors=True)
        timer = threading.Timer(moment * verb.seconds, removal)
        done = verb.start(out, during=lambda process, timer=timer: timer.start())
        left = has_temporaries(out.parent)
        right = not left and (done.code == 0 or done.told_in_one_line())
        words = f"after {100 * moment:.0f} % of the time: code {done.code}, left {left}"
        row.note(right, f"{words}: {done.err!r}"[:800])
        shutil.rmtree(out.parent, ignore_errors=True)


Way = Callable[[Verb, pathlib.Path, int, Row], None]
DISK: tuple[str, Way] = (
    "full disk (a small file system in memory)",
    functools.partial(fill, "disk"),
)
LIMIT: tuple[str, Way] = (
    "full disk (a limit on the size of a file)",
    functools.partial(fill, "limit"),
)
READ_ONLY: tuple[str, Way] = ("read-only folder", forbid)
REMOVED: tuple[str, Way] = ("folder removed during the work", remove)


def attack(name: str, limited: bool, bench: Bench, scale: float) -> list[Row]:
    """Attack one verb, in all ways that there are here or by a limit alone."""
    ways = [LIMIT]
    if not limited:
        # Who is root writes into any folder: only a disk to read stops them.
        refuses = can_mount() or os.getuid()
        ways = [DISK if can_mount() else LIMIT, *[READ_ONLY] * bool(refuses), REMOVED]
    folder = bench.folder / "tried" / f"{name}, limited: {limited}"
    verb = Verb(name, bench.world, folder / "whole" / "out")
    rows = []
    for title, way in ways:
        row = Row(f"{title}: {name}", PROMISE)
        way(verb, folder / title, part_of(len(FRACTIONS), scale), row)
        rows.append(row)
    return rows


LIMITED = {f"{verb} limited": functools.partial(attack, verb, True) for verb in COMMANDS}
ATTACKS: Mapping[str, Attack] = {
    **{verb: functools.partial(attack, verb, False) for verb in COMMANDS},
    **LIMITED,
}

if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__, optional=list(LIMITED), keep=False))
