"""Fill the disk, forbid writing and take folders away while each verb works.

    python -m tests.attack.disks --out rows.json [--verbs NAME,...] [--ways WAY,...] [--sizes N]

Ways: `disk` is a small file system in memory, which needs root, in a mount namespace of this
process. `limit` is a limit on the size of a file, which needs nothing. Without --ways the first is
taken where it can be, else the second. `read-only` and `removed` are folders; root cannot be
refused a folder where nothing can be mounted.
"""

import argparse
import contextlib
import ctypes
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
import time
import unittest.mock
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from tests.attack.world import (
    ALL,
    NEEDS,
    Done,
    Row,
    World,
    command,
    files_in,
    forked,
    has_temporaries,
    import_everything,
    make_products,
    make_world,
    without_times,
    write_rows,
)

PROMISE = (
    "exit code 2 and one line; no temporaries, nothing half written, what was there as before; "
    "then the same command finishes with the same bits"
)
PAGE = 4096
FRACTIONS = (0.3, 0.02, 0.97, 0.6, 0.85)
"""How full the disk may get, of what the results take: those that come first in short runs."""

# What may stay behind of each verb: work that the same command goes on with.
RESUMABLE: Mapping[str, str] = {
    "train": r"run/.*",
    "compare": r"comparison/.*",
    "ablate": r"ablation/.*",
    "demo": r"demo/.*",
    "index": r"map/.*",
    "extract .npy": r"d\.npy\.partial/.*",
    "extract .h5": r"d\.h5\.partial/.*",
}
# Files that hold times, or are drawn from them.
_TIMED = re.compile(
    r"metrics\.jsonl|/tensorboard/|/state/|curves\.png|training\.(json|png)|speed\.json|index\.html|"
    r"table\.(md|csv|json)|results\.json|summary\.json|sittings\.json|test-\d\.json|map\.json|"
    r"config\.json|adapters\.json|\.names\.txt\.lock"
)


TARGETS: Mapping[str, tuple[str, ...]] = {
    "evaluate": ("table.json", "pictures/config.json", "report/index.html"),
    "extract .npy": ("d.npy", "d.names.txt", "d.npy.json", "pairs.txt"),
    "extract .h5": ("d.h5", "d.h5.json", "pairs.txt"),
    "query": ("answers.json", "gallery.png"),
    "pca": ("pca.safetensors",),
    "convert": ("public.pth",),
    "info": ("info.json",),
    "vocabulary": ("v.safetensors",),
}
"""Files that a verb replaces where they are there."""


def start(arguments: list[str], **options: object) -> Done:
    """Run a command in a process of its own; the demo in a smaller size."""
    limit = options.pop("file_limit", None)

    def work() -> int:
        from crisalad_jax.experiments import demo

        if limit is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))  # pyright: ignore
        small = demo.DemoConfig(train_places=24, test_places=12, epochs=1)
        with unittest.mock.patch.object(demo, "DemoConfig", return_value=small):
            return command(arguments)

    return forked(work, limit=400, **options)  # pyright: ignore


class Whole(NamedTuple):
    """What a verb does undisturbed."""

    files: dict[str, int]
    """Sizes of its files."""
    digests: dict[str, str]
    """Of those that hold no times."""
    seconds: float


def _contents(path: pathlib.Path) -> bytes:
    """Return what is to be the same in two runs."""
    if path.suffix != ".json":
        return path.read_bytes()
    return json.dumps(without_times(json.loads(path.read_text()))).encode()


def digests(folder: pathlib.Path) -> dict[str, str]:
    """Return the digests of all files but those that are made of times."""
    return {
        name: hashlib.sha256(_contents(folder / name)).hexdigest()
        for name in sorted(files_in(folder))
        if (folder / name).is_file() and not _TIMED.search(f"/{name}")
    }


def undisturbed(verb: str, world: World, out: pathlib.Path) -> Whole:
    """Run a verb with all the room it needs."""
    out.mkdir(parents=True)
    done = start(ALL[verb](world, out), cwd=out)
    assert done.code == 0, (verb, done.err)
    sizes = {n: (out / n).stat().st_size for n in files_in(out) if (out / n).is_file()}
    return Whole(sizes, digests(out), done.seconds)


def can_mount() -> bool:
    """Take a mount namespace for this process; return whether that and a small disk work."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(0x00020000):  # CLONE_NEWNS
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
def small_disk(folder: pathlib.Path, size: int) -> Iterator[Callable[[], None]]:
    """Yield what gives more room; `folder` is a small disk in the block."""
    folder.mkdir(parents=True)
    # The smallest has one page: that one is full.
    assert _mount(folder, size + PAGE) == 0
    (folder / "full").write_bytes(b"0" * PAGE)
    try:
        yield lambda: _remount(folder, "size=1g")
    finally:
        _unmount(folder)


def judge(
    row: Row, words: str, verb: str, out: pathlib.Path, done: Done, before: dict[str, bytes]
) -> None:
    """Note what a disturbed command did wrong."""
    wrong = []
    if not done.told_in_one_line():
        wrong.append(f"code {done.code}, said {len(done.err.splitlines())} lines: {done.err!r}")
    if out.exists():
        wrong += [f"left {name}" for name in has_temporaries(out)]
        left = files_in(out) - before.keys()
        kept = re.compile(RESUMABLE.get(verb, "$^"))
        wrong += [f"left {n}" for n in sorted(left) if not kept.fullmatch(n)]
        named = next(iter(RESUMABLE.get(verb, "").replace("\\", "").split("/")), "")
        if left and named not in done.err:
            wrong.append(f"does not name {named}, which it left")
        wrong += [f"changed {n}" for n, data in before.items() if _read(out / n) != data]
    row.note(not wrong, f"{words}: {'; '.join(wrong)[:600]}")


def _read(path: pathlib.Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _old(out: pathlib.Path, names: tuple[str, ...]) -> dict[str, bytes]:
    """Write earlier results, which a failure must leave."""
    for name in names:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(b"before")
    return dict.fromkeys(names, b"before")


def finish(row: Row, words: str, verb: str, world: World, out: pathlib.Path, whole: Whole) -> None:
    """Run the same command with room, and compare its files with the undisturbed ones."""
    done = start(ALL[verb](world, out), cwd=out.parent)
    found = digests(out)
    differ = sorted(
        n for n in found.keys() | whole.digests.keys() if found.get(n) != whole.digests.get(n)
    )
    differ = [name for name in differ if name != "before.txt"]
    right = done.code == 0 and not differ and not has_temporaries(out)
    row.note(right, f"{words}, again: code {done.code}, differ: {differ}: {done.err[-300:]!r}")


def attack(
    verb: str, way: str, world: World, folder: pathlib.Path, whole: Whole, sizes: int
) -> Row:
    """Attack one verb in one way."""
    row = Row(f"{TITLES[way]}: {verb}", PROMISE)
    if way in ("disk", "limit"):
        for number, fraction in enumerate(FRACTIONS[:sizes]):
            old = TARGETS.get(verb, ()) if number % 2 else ()
            _full(row, verb, way, world, folder / f"{way}-{number}", whole, fraction, old)
    elif way == "read-only":
        _read_only(row, verb, world, folder / way, whole)
    else:
        for number in range(sizes):
            _removed(row, verb, world, folder / f"{way}-{number}", whole, (number + 0.7) / sizes)
    print(f"{row.attack}: {row.tries} tries, {len(row.failures)} failures", file=sys.stderr)
    for line in row.failures:
        print(f"    {line}", file=sys.stderr)
    return row


def _full(
    row: Row,
    verb: str,
    way: str,
    world: World,
    folder: pathlib.Path,
    whole: Whole,
    fraction: float,
    old: tuple[str, ...],
) -> None:
    words = f"room for {100 * fraction:.0f} %" + (" over earlier files" if old else "")
    out, limit = folder / "out", None
    if way == "limit":
        limit = int(fraction * max(whole.files.values()))
        disk, words = contextlib.nullcontext(lambda: None), f"{words} of the largest file"
    else:
        pages = sum(-(-size // PAGE) for size in whole.files.values())
        room = int(fraction * (pages - 1)) + len(old)
        disk, words = small_disk(folder, room * PAGE), f"{words} ({room} pages)"
    with disk as more:
        out.mkdir(parents=True)
        before = _old(out, old)
        done = start(ALL[verb](world, out), cwd=folder, file_limit=limit)
        judge(row, words, verb, out, done, before)
        more()
        finish(row, words, verb, world, out, whole)
    shutil.rmtree(folder, ignore_errors=True)


def _read_only(row: Row, verb: str, world: World, folder: pathlib.Path, whole: Whole) -> None:
    if os.getuid():
        out = folder / "out"
        out.mkdir(parents=True)
        out.chmod(0o555)
        judge(row, "a folder mode 555", verb, out, start(ALL[verb](world, out), cwd=folder), {})
        out.chmod(0o755)
    elif MOUNTS:
        with small_disk(folder, 2**30):
            out = folder / "out"
            out.mkdir()
            _remount(folder, "ro")
            judge(row, "a disk to read", verb, out, start(ALL[verb](world, out), cwd=folder), {})
            _remount(folder, "rw")
            finish(row, "a disk to read", verb, world, out, whole)


def _removed(
    row: Row, verb: str, world: World, folder: pathlib.Path, whole: Whole, moment: float
) -> None:
    """Remove the folder of the results, again and again from a moment on, for half a second."""
    out = folder / "out"
    out.mkdir(parents=True)

    def remove(process: int) -> None:
        def work() -> None:
            time.sleep(moment * whole.seconds)
            shutil.rmtree(out, ignore_errors=True)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()

    done = start(ALL[verb](world, out), cwd=folder, during=remove)
    left = has_temporaries(folder)
    right = not left and (done.code == 0 or done.told_in_one_line())
    words = f"after {100 * moment:.0f} % of the time: code {done.code}, left {left}: {done.err!r}"
    row.note(right, words[:800])
    shutil.rmtree(folder, ignore_errors=True)


TITLES = {
    "disk": "full disk (a small file system in memory)",
    "limit": "full disk (a limit on the size of a file)",
    "read-only": "read-only folder",
    "removed": "folder removed during the work",
}
MOUNTS = False


def main() -> int:
    """Attack, and write the rows."""
    global MOUNTS
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--verbs", default=",".join(ALL))
    parser.add_argument("--ways", default=None)
    parser.add_argument("--sizes", type=int, default=len(FRACTIONS))
    given = parser.parse_args()
    MOUNTS = os.getuid() == 0 and can_mount()
    # Who is root writes into any folder: only a disk to read stops them.
    usual = ["disk" if MOUNTS else "limit", *["read-only"] * (MOUNTS or os.getuid() > 0), "removed"]
    ways = given.ways.split(",") if given.ways else usual
    if not MOUNTS and "disk" in ways:
        parser.error("--ways: found disk, expected limit: no file system can be mounted here")
    import_everything()
    with contextlib.ExitStack() as stack:
        folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        world = make_world(folder / "world")
        verbs = given.verbs.split(",")
        needed = dict.fromkeys(need for verb in verbs for need in NEEDS.get(verb, ()))
        make_products(world, tuple(needed))
        failed = False
        for verb in verbs:
            whole = undisturbed(verb, world, folder / "whole" / verb / "out")
            rows = [
                attack(verb, way, world, folder / "tried" / verb, whole, given.sizes)
                for way in ways
            ]
            write_rows(given.out, rows)
            failed = failed or any(row.failures for row in rows)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
