"""Run commands in surroundings that a program seldom meets: other users, homes, disks, locales.

    python -m tests.attack.surroundings --out rows.json [--scale 1] [--only KIND ...]

Other users and disks need root. Programs are started as users start them.
"""

import functools
import os
import pathlib
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import NamedTuple

from tests.attack import disks
from tests.attack.world import (
    COMMANDS,
    ROOT,
    Attack,
    Bench,
    Row,
    arguments,
    carry_out,
    differences,
    part_of,
)

PROMISE = "the same files as elsewhere, or exit code 2 and one line; no traceback"
NOBODY = 65534
VERBS = ("extract .npy", "query", "info", "index", "pca", "convert", "evaluate", "export")


class Surroundings(NamedTuple):
    """What is unusual."""

    python: tuple[str, ...] = ()
    """Flags of the interpreter."""
    environment: Mapping[str, str | None] = {}
    """Variables, and those that are not there; HOME and TMP are folders of the try."""
    user: int | None = None
    prepare: Callable[[pathlib.Path], object] = lambda folder: None
    """Is given the folder that has `home` and `tmp`."""


def _read_only_home(folder: pathlib.Path) -> None:
    (folder / "home").chmod(0o555)


def _without_memory(folder: pathlib.Path) -> None:
    """Hide /dev/shm, in the mount namespace that `disks.can_mount` made."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4k,ro", "tmpfs", "/dev/shm"], check=True)


KINDS: Mapping[str, Surroundings] = {
    "another user": Surroundings(user=NOBODY),
    "a home to read": Surroundings(user=NOBODY, prepare=_read_only_home),
    "no home": Surroundings(environment={"HOME": "/nonexistent", "XDG_CACHE_HOME": None}),
    "no /dev/shm": Surroundings(prepare=_without_memory),
    "/tmp full": Surroundings(environment={"TMPDIR": "FOLDER/full"}),
    "20 columns": Surroundings(environment={"COLUMNS": "20"}),
    "python -O": Surroundings(python=("-O",)),
    "python -W error": Surroundings(python=("-W", "error")),
    "C locale": Surroundings(environment={"LC_ALL": "C", "PYTHONUTF8": "0"}),
    "switches of JAX": Surroundings(
        environment={"JAX_DISABLE_JIT": "1", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    ),
}


def _make(folder: pathlib.Path) -> None:
    for path in (folder, folder / "out", folder / "home", folder / "tmp"):
        path.mkdir(parents=True, exist_ok=True)
        path.chmod(0o777)


def _start(kind: Surroundings, verb: str, bench: Bench, folder: pathlib.Path) -> tuple[int, str]:
    """Run a verb, which writes into `folder`/out; return its exit code and what it said."""
    environment = {**os.environ, **bench.environment, "PYTHONPATH": str(ROOT)}
    environment |= {"HOME": str(folder / "home"), "TMPDIR": str(folder / "tmp")}
    for name, value in kind.environment.items():
        if value is None:
            environment.pop(name, None)
        else:
            environment[name] = value.replace("FOLDER", str(folder))
    done = subprocess.run(
        [
            sys.executable,
            *kind.python,
            "-m",
            "crisalad_jax",
            *arguments(verb, bench.world, folder / "out"),
        ],
        cwd=folder,
        env=environment,
        user=kind.user,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=300,
    )
    return done.returncode, done.stderr


@functools.cache
def _undisturbed(verb: str, bench_id: int) -> dict[str, str]:
    bench = _BENCHES[bench_id]
    out = bench.folder / "surroundings" / "usual" / verb.replace(" ", "")
    _make(out)
    code, err = _start(Surroundings(), verb, bench, out)
    assert code == 0, (verb, err)
    return disks.digests(out / "out")


_BENCHES: dict[int, Bench] = {}


def attack(name: str, bench: Bench, scale: float) -> list[Row]:
    """Run verbs in one kind of surroundings."""
    kind, row = KINDS[name], Row(f"surroundings: {name}", PROMISE)
    if (kind.user is not None or "shm" in name or "full" in name) and not disks.can_mount():
        return []
    _BENCHES[id(bench)] = bench
    for verb in VERBS:
        arguments(verb, bench.world, bench.folder)  # makes what it reads
    if kind.user is not None and not _open_to_all(bench):
        return []
    for verb in VERBS[: part_of(len(VERBS), scale, least=1)]:
        assert verb in COMMANDS
        usual = _undisturbed(verb, id(bench))
        folder = bench.folder / "surroundings" / name.replace("/", "") / verb.replace(" ", "")
        folder.mkdir(parents=True)
        _make(folder)
        kind.prepare(folder)
        if "full" in name:
            with disks.small_disk(folder / "full", 0):
                code, err = _start(kind, verb, bench, folder)
        else:
            code, err = _start(kind, verb, bench, folder)
        wrong = []
        if "Traceback" in err or "\nSystemError" in err:
            wrong.append("a traceback")
        if code == 0:
            differ = differences(disks.digests(folder / "out"), usual)
            wrong += [f"differ: {differ}"] if differ else []
        elif code != 2 or not err.splitlines()[-1].startswith("crisalad: "):
            wrong.append(f"code {code}")
        row.note(not wrong, f"{verb}: {'; '.join(wrong)}: {err[-500:]!r}")
        shutil.rmtree(folder, ignore_errors=True)
    if "shm" in name:
        subprocess.run(["umount", "/dev/shm"], check=True)
    return [row]


def _open_to_all(bench: Bench) -> bool:
    """Let other users read the world and Python; return whether they can reach them."""
    for path in (bench.folder, *bench.folder.rglob("*")):
        path.chmod(0o777 if path.is_dir() else 0o644)
    python = pathlib.Path(sys.base_prefix)
    closed = [each for each in python.parents if not each.stat().st_mode & 1]
    if closed:  # in this process's namespace of mounts
        kept = bench.folder / "python"
        kept.mkdir(exist_ok=True)
        for command in (
            f"mount --bind {python} {kept}",
            f"mount -t tmpfs -o mode=755 tmpfs {closed[-1]}",
            f"mkdir -p {python}",
            f"mount --bind {kept} {python}",
            f"umount {kept}",
        ):
            subprocess.run(command.split(), check=True)
    return all(each.stat().st_mode & 1 for each in bench.folder.parents)


ATTACKS: Mapping[str, Attack] = {name: functools.partial(attack, name) for name in KINDS}

if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__))
