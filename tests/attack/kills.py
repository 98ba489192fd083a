"""Kill commands at random moments: what they leave is whole, and the same command ends alike.

    python -m tests.attack.kills --out rows.json [--scale 1] [--seed 0] [--only training maps ...]

A chain is one folder, in which a command is killed several times and then finishes. Most commands
are forks of this process, which has imported everything; some are programs of their own, killed
while they import. Moments are of two kinds: at any time of a whole run, and soon after a certain
work has begun, so that saves and commits, which are short, are met too.
"""

import argparse
import dataclasses
import importlib
import json
import mmap
import os
import pathlib
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from tests.attack.world import (
    ROOT,
    VERBS,
    Done,
    Row,
    World,
    files_in,
    forked,
    has_temporaries,
    import_everything,
    keep_programs,
    make_world,
    without_times,
    write_rows,
)


class Marks:
    """What a forked child is doing, in memory that it shares with this process.

    A mark is the number of some work. The child sets it at the work's beginning, and the mark of
    the work around it at the end.
    """

    def __init__(self, works: Mapping[str, str]) -> None:
        """Take the functions that are marked, as module:name or module:class.name."""
        self.names = ["start", *works, "busy", "the end"]
        self.works = list(works)
        self._paths = works
        self._memory = mmap.mmap(-1, 1 + 4 * len(self.names))

    def clear(self) -> None:
        """Begin again, before a child starts."""
        self._memory[:] = bytes(len(self._memory))

    @property
    def now(self) -> str:
        """What the child is doing, or did when it was killed."""
        return self.names[self._memory[0]]

    def times(self, name: str) -> int:
        """Return how often the child has begun this work."""
        place = 1 + 4 * self.names.index(name)
        return int.from_bytes(self._memory[place : place + 4], "little")

    def say(self, name: str) -> None:
        """Say in the child that it handles signals (start), is busy, or has done all (the end)."""
        place = 1 + 4 * self.names.index(name)
        self._memory[place : place + 4] = (1).to_bytes(4, "little")

    def install(self) -> None:
        """Mark the functions, in the child."""
        for number, path in enumerate(self._paths.values(), start=1):
            self._wrap(number, path)

    def _wrap(self, number: int, path: str) -> None:
        module, _, name = path.partition(":")
        *classes, name = name.split(".")
        holder: Any = importlib.import_module(module)
        for each in classes:
            holder = getattr(holder, each)
        real = getattr(holder, name)
        place = 1 + 4 * number

        def call(*arguments: Any, **options: Any) -> Any:
            before, self._memory[0] = self._memory[0], number
            count = int.from_bytes(self._memory[place : place + 4], "little") + 1
            self._memory[place : place + 4] = count.to_bytes(4, "little")
            try:
                return real(*arguments, **options)
            finally:
                self._memory[0] = before

        setattr(holder, name, call)


class Moment:
    """When a child gets its signal."""

    def __init__(
        self, marks: Marks, number: int, *, after: float, work: str | None = None, nth: int = 1
    ) -> None:
        """Take the signal, and the time: seconds after the start, or after some work's beginning.

        Args:
            marks: of the child.
            number: of the signal.
            after: seconds.
            work: its name; None is the start of the process.
            nth: which time that this work begins.
        """
        self._marks, self.number, self._after = marks, number, after
        self._work, self._nth = work, nth
        self.during = ""
        """What the child was doing then; empty if it had ended."""
        self.sent = 0.0
        self.before: dict[str, int] = {}
        """How often each work had begun then."""

    def __call__(self, process: int) -> None:
        """Wait for the moment, and send the signal."""
        watcher = os.pidfd_open(process)

        def ends_in(seconds: float) -> bool:
            return bool(select.select([watcher], [], [], seconds)[0])

        try:
            if self._work is not None:
                while self._marks.times(self._work) < self._nth:
                    if ends_in(0.001):
                        return
            if ends_in(self._after):
                return
            self.during, self.sent = self._marks.now, time.monotonic()
            self.before = {name: self._marks.times(name) for name in self._marks.names}
            os.kill(process, self.number)
        finally:
            os.close(watcher)

    def __str__(self) -> str:
        """Return words for a report."""
        of = "the start" if self._work is None else f"{self._work} {self._nth}"
        return f"{self._after:.3f} s after {of}"


def command(arguments: Sequence[str], marks: Marks, *settings: tuple[Any, str, Any]) -> Callable:
    """Return the work of a child: a command, with its marks, and attributes set to other values."""

    def work() -> int:
        from crisalad_jax.__main__ import keep_on_without_reader
        from crisalad_jax.cli import main
        from crisalad_jax.utils.signals import end_at_signals

        for holder, name, value in settings:
            setattr(holder, name, value)
        marks.install()
        end_at_signals()
        keep_on_without_reader()
        marks.say("start")
        code = main(list(arguments))
        sys.stdout.flush()
        marks.say("the end")
        return code

    return work


@dataclasses.dataclass
class Bench:
    """What all attacks share."""

    world: World
    folder: pathlib.Path
    random: random.Random
    seed: int
    environment: Mapping[str, str]
    """Of programs of their own."""
    say: Callable[[str], None]

    def program(self, arguments: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
        """Start the command line as users do."""
        return subprocess.Popen(
            [sys.executable, "-m", "crisalad_jax", *arguments],
            cwd=ROOT,
            env={**os.environ, **self.environment},
            stdin=subprocess.DEVNULL,
            stdout=options.pop("stdout", subprocess.PIPE),
            stderr=subprocess.PIPE,
            **options,
        )


def differences(found: pathlib.Path, expected: pathlib.Path) -> list[str]:
    """List in which files two runs of training differ: weights in bytes, the log but for times."""
    wrong = []
    weights = {path.relative_to(expected) for path in expected.rglob("*.safetensors")}
    there = {path.relative_to(found) for path in found.rglob("*.safetensors")}
    wrong += [f"{name}: in one only" for name in sorted(weights ^ there)]
    for name in sorted(weights & there):
        if (found / name).read_bytes() != (expected / name).read_bytes():
            wrong.append(f"{name}: other bytes")
    if log_of(found) != log_of(expected):
        wrong.append("metrics.jsonl")
    return wrong + has_temporaries(found)


def log_of(run: pathlib.Path) -> list[Any]:
    """Read the log of a run but for its times."""
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [without_times(json.loads(line)) for line in lines]


TRAINING = Marks(
    {
        "opening the run": "crisalad_jax.training.run_files:RunFiles.load",
        "loading a state": "crisalad_jax.checkpoints.train_state:StateStore.load",
        "steps": "crisalad_jax.training.loop:_Loop._take_round",
        "saving": "crisalad_jax.training.run_files:RunFiles.save",
        "validating": "crisalad_jax.training.validation:Validator.validate",
        "keeping the best": "crisalad_jax.training.run_files:RunFiles.save_if_best",
        "closing": "crisalad_jax.training.run_files:RunFiles.close",
    }
)
WEIGHT_OF_WORK = {"opening the run": 1, "loading a state": 1, "steps": 4, "saving": 5}
WEIGHT_OF_WORK |= {"validating": 2, "keeping the best": 2, "closing": 1}
EPOCHS = 6


def recipe_of_chains(folder: pathlib.Path) -> pathlib.Path:
    """Write a configuration whose steps, of a small model with dropout, are traced in a second."""
    from crisalad_jax.config.io import to_plain
    from crisalad_jax.nn.aggregators.gem import GemConfig
    from crisalad_jax.nn.backbones.vit import ViTConfig
    from crisalad_jax.nn.config import ModelConfig
    from crisalad_jax.nn.cross_image import CrossImageConfig
    from tests.conftest import RECIPE

    model = ModelConfig(
        image_size=(42, 56),
        backbone=ViTConfig(dim=32, depth=1, heads=2, position_grid=3),
        aggregator=GemConfig(),
        cross_image=CrossImageConfig(heads=2, feedforward=16),
    )
    path = folder / "recipe.json"
    config = dataclasses.replace(RECIPE, model=model, epochs=EPOCHS, patience=None, save_top_k=2)
    write_json(path, to_plain(config))
    return path


def train_arguments(world: World, recipe: pathlib.Path, out: pathlib.Path) -> list[str]:
    """Return a command that trains by this configuration."""
    return [
        *("train", "--data", f"{world.city}", "--out", f"{out}", "--config", f"{recipe}"),
        *("--val", f"{world.town}", "--quiet"),
    ]


def attack_training(bench: Bench, kills: int, chains: int, programs: int) -> list[Row]:
    """Kill runs of training, some as programs of their own while they start."""
    import crisalad_jax.training.run_files

    folder = bench.folder / "training"
    folder.mkdir()
    recipe = recipe_of_chains(folder)
    often = (crisalad_jax.training.run_files, "SAVE_SECONDS", -1.0)

    def go(out: pathlib.Path, during: Callable[[int], None] | None = None) -> Done:
        TRAINING.clear()
        work = command(train_arguments(bench.world, recipe, out), TRAINING, often)
        return forked(work, cwd=folder, during=during)

    whole = folder / "whole"
    done = go(whole)
    assert done.code == 0, done.err
    seconds, startup = done.seconds, 0.0
    if programs:
        again = [folder / f"whole{n}" for n in range(2)]
        seconds, begun = go(again[0]).seconds, time.monotonic()
        program = bench.program(train_arguments(bench.world, recipe, again[1]))
        program.communicate()
        startup = time.monotonic() - begun
        wrong = [line for each in again for line in differences(each, whole)]
        assert not wrong, wrong

    of_chains = Row(
        "kills of training, chains", "killed runs end with the bits of an uninterrupted run"
    )
    of_kills = {
        name: Row(f"kills of training: {name}", "the same command goes on")
        for name in ("a program as it starts", "a state is written", *TRAINING.names)
    }

    def kill(out: pathlib.Path, as_program: bool) -> tuple[str, int]:
        if as_program:
            after = bench.random.uniform(0, startup)
            program = bench.program(train_arguments(bench.world, recipe, out))
            try:
                program.wait(after)
                name = ""
            except subprocess.TimeoutExpired:
                program.kill()
                name = "a program as it starts"
            program.communicate()
            return name, program.returncode
        if bench.random.random() < 0.4:
            moment = Moment(TRAINING, signal.SIGKILL, after=bench.random.uniform(0, seconds))
        else:
            (work,) = bench.random.choices(*zip(*WEIGHT_OF_WORK.items(), strict=True))
            nth = bench.random.randint(1, 4) if work not in ("opening the run", "closing") else 1
            after = bench.random.uniform(0, bench.random.choice([0.002, 0.02, 0.2]))
            moment = Moment(TRAINING, signal.SIGKILL, after=after, work=work, nth=nth)
        done = go(out, moment)
        writing = any("tmp" in path.name for path in (out / "state").glob("*"))
        return moment.during and ("a state is written" if writing else moment.during), done.code

    killed = 0
    for chain in range(10 * chains):
        left = kills - killed
        if not left and chain >= chains:
            break
        out, begun = folder / f"chain{chain}", time.monotonic()
        number = min(left, -(-left // max(chains - chain, 1)))
        met, bad = [], ""
        with_program = programs > 0 and chain % max(chains // programs, 1) == 0
        while len(met) < number and not bad:
            as_program = with_program and not met
            name, code = kill(out, as_program)
            if name and code == -signal.SIGKILL:
                met.append(name)
            elif code == 0:
                break  # it had finished
            else:
                bad = f"exit code {code} at {name or 'its end'}"
        killed += len(met)
        if not bad:
            done = go(out)
            wrong = differences(out, whole) if done.code == 0 else [done.err[-300:]]
            bad = "; ".join(wrong)
        words = f"seed {bench.seed}, chain {chain} ({', '.join(met)}): {bad}"
        of_chains.note(not bad, words)
        for name in met:
            of_kills[name].note(not bad, words)
        if not bad:
            shutil.rmtree(out)
        bench.say(
            f"training: {killed} of {kills} kills, chain {chain}, "
            f"{time.monotonic() - begun:.1f} s, {len(of_chains.failures)} failures"
        )
    return [of_chains, *(row for row in of_kills.values() if row.tries)]


def is_told(error: Exception) -> bool:
    """Return whether an error is one of ours, in one line."""
    return isinstance(error, InputError) and "\n" not in str(error)


INDEXING = Marks(
    {
        "opening the map": "crisalad_jax.retrieval.maps.build:open_for_appending",
        "appending": "crisalad_jax.retrieval.maps.map:Map.append",
        "a descriptors' file": "crisalad_jax.retrieval.maps.file_store:FileStore.add",
        "a record": "crisalad_jax.retrieval.segments:write_record",
    }
)
IMAGES, TOGETHER = 24, 2
"""Images of a map, and how many of them are appended together."""


def write_images(folder: pathlib.Path, first: int, count: int) -> None:
    """Write pictures with a position in their names."""
    from tests.conftest import write_picture

    for number in range(first, first + count):
        write_picture(folder / "sub" / f"@{100 + number}@500@10@S@{number:03d}@.jpg", number)


def map_files(folder: pathlib.Path) -> dict[str, bytes]:
    """Return the bytes of a map's descriptors, and its JSON but for times and its name."""
    found = {p.name: p.read_bytes() for p in sorted((folder / "segments").iterdir())}
    for name in found:
        if name.endswith(".json"):
            found[name] = json.dumps(without_times(json.loads(found[name]))).encode()
    description = without_times(json.loads((folder / "map.json").read_text()))
    del description["created"], description["collection"]
    return found | {"map.json": json.dumps(description).encode()}


def a_moment(
    bench: Bench,
    marks: Marks,
    seconds: float,
    times: Sequence[int],
    spreads: Sequence[float],
) -> Moment:
    """Draw a moment to kill at: in the whole run, or soon after some work has begun.

    Args:
        bench: draws.
        marks: of the child.
        seconds: of the whole run.
        times: of each work, the last beginning that is drawn.
        spreads: most seconds after a beginning, one of which is drawn.
    """
    if bench.random.random() < 0.3:
        return Moment(marks, signal.SIGKILL, after=bench.random.uniform(0, seconds))
    work, most = bench.random.choice(list(zip(marks.works, times, strict=True)))
    after = bench.random.uniform(0, bench.random.choice(spreads))
    nth = bench.random.randint(1, most)
    return Moment(marks, signal.SIGKILL, after=after, work=work, nth=nth)


def kill_chains(
    bench: Bench,
    folder: pathlib.Path,
    kills: int,
    go: Callable[..., Done],
    moment: Callable[[], Moment],
    at_each: tuple[Row, Callable[[pathlib.Path], str]] | None,
    at_end: tuple[Row, Callable[[pathlib.Path], list[str]]],
    *,
    prepare: Callable[[pathlib.Path, int], None] = lambda chain, number: None,
) -> None:
    """Kill a command in one folder after another, in each until it has finished.

    Args:
        bench: draws and says.
        folder: of the chains.
        kills: number of all.
        go: runs the command in a chain's folder, with what is called during it.
        moment: draws when to kill.
        at_each: a row, and what is wrong with a chain's folder after a kill.
        at_end: a row, and what is wrong with it after the command.
        prepare: makes a chain's folder, of this number.
    """
    killed = number = 0
    while killed < kills:
        chain, met = folder / f"chain{number}", []
        prepare(chain, number)
        words = f"seed {bench.seed}, chain {number}"
        while killed < kills:
            when = moment()
            done = go(chain, when)
            if done.code == 0:
                break
            killed += 1
            met.append(when.during)
            if at_each is not None:
                bad = at_each[1](chain)
                bad = bad or (f"exit code {done.code}" if done.code != -signal.SIGKILL else "")
                at_each[0].note(not bad, f"{words}, {when}: {bad}")
        if done.code != 0:
            done = go(chain)
        wrong = [done.err[-300:]] if done.code else at_end[1](chain)
        at_end[0].note(not wrong, f"{words}, {met}: {wrong}")
        bench.say(f"{at_end[0].attack}: {killed} of {kills} kills, chain {number}")
        number += 1


def attack_maps(bench: Bench, kills: int) -> list[Row]:
    """Kill `index`, read maps after each kill, and search a map while it grows."""
    import crisalad_jax.retrieval.maps.build
    from crisalad_jax.retrieval.maps.map import Map
    from crisalad_jax.retrieval.maps.metadata import has_images

    folder = bench.folder / "maps"
    images = folder / "images"
    write_images(images, 0, IMAGES)
    small = (crisalad_jax.retrieval.maps.build, "SEGMENT", TOGETHER)

    def go(out: pathlib.Path, during: Callable[[int], None] | None = None) -> Done:
        INDEXING.clear()
        arguments = [
            *("index", "--weights", f"{bench.world.weights}", "--images", f"{images}"),
            *("--out", f"{out}", "--batch-size", f"{TOGETHER}", "--quiet"),
        ]
        return forked(command(arguments, INDEXING, small), cwd=folder, during=during)

    whole = folder / "whole"
    done = go(whole)
    assert done.code == 0, done.err
    seconds = go(folder / "whole1").seconds
    expected = map_files(whole)
    assert map_files(folder / "whole1") == expected
    with Map.open(whole) as opened:
        names = [image.name for image in opened.images]
        rows = np.concatenate(list(opened.descriptors))
    assert len(names) == IMAGES

    def wrong_with(out: pathlib.Path) -> str:
        """Return what is wrong with a map; nothing if it has the first images, or none."""
        if not has_images(out):
            try:
                Map.open(out).close()
                return "a map without images was opened"
            except InputError as error:
                return "" if is_told(error) else str(error)
        with Map.open(out) as opened:
            count = len(opened)
            found = [image.name for image in opened.images]
            same = np.array_equal(np.concatenate(list(opened.descriptors)), rows[:count])
            prefix = found == names[:count] and same and count % TOGETHER == 0
        return "" if prefix else f"{count} images, not the first ones"

    at_each = Row("kills of index: each moment", "the map opens with the first images, or has none")
    of_chains = Row("kills of index: chains", "the map ends with the bits of an uninterrupted one")

    def wrong_at_end(out: pathlib.Path) -> list[str]:
        return ["other bits"] * (map_files(out) != expected) + has_temporaries(out)

    def moment() -> Moment:
        return a_moment(bench, INDEXING, seconds, (1, 3, 3, 3), (0.0005, 0.005, 0.05))

    kill_chains(bench, folder, kills, go, moment, (at_each, wrong_with), (of_chains, wrong_at_end))
    return [at_each, of_chains, *attack_readers(bench, folder, go, rows)]


def attack_readers(
    bench: Bench,
    folder: pathlib.Path,
    go: Callable[[pathlib.Path], Done],
    rows: np.ndarray,
) -> list[Row]:
    """Search a map in a loop while another process makes it, then move it and ask it again."""
    from crisalad_jax.retrieval.maps.map import Map
    from crisalad_jax.retrieval.neighbours import exact_similarities

    out, ended = folder / "growing", folder / "ended"
    query, place = (each.ravel() for each in np.indices((IMAGES, IMAGES)))
    all_of = exact_similarities(rows, rows, query, place).reshape(IMAGES, IMAGES)

    def wrong_with(opened: Map) -> str:
        count = len(opened)
        indices, similarities = opened.search(rows, 5)
        order = np.argsort(-all_of[:, :count], axis=1, kind="stable")[:, :5]
        if not np.array_equal(indices, order):
            return f"other answers than of the first {count} images"
        right = np.array_equal(similarities, np.take_along_axis(all_of, order, axis=1))
        return "" if right else f"other similarities than of the first {count} images"

    def read() -> int:
        counts, tries, failures = set(), 0, []
        last = False
        while not last:
            last = ended.exists()
            try:
                with Map.open(out) as opened:
                    tries += 1
                    counts.add(len(opened))
                    wrong = wrong_with(opened)
            except InputError as error:
                wrong = str(error) if counts or last or not is_told(error) else ""
            except Exception as error:
                wrong = repr(error)
            failures += [wrong] if wrong else []
        print(json.dumps([tries, sorted(counts), failures[:20]]))
        return 0

    def make(_: int) -> None:
        try:
            assert go(out).code == 0
        finally:
            ended.touch()

    read_there = Row(
        "searches of a map while it grows", "each answer is that of the first images, no errors"
    )
    done = forked(read, cwd=folder, during=make)
    if done.code != 0:
        read_there.note(False, f"the reader ended with code {done.code}: {done.err[-300:]}")
    else:
        tries, counts, failures = json.loads(done.out)
        read_there.tries, read_there.failures = tries, failures
        bench.say(f"searches while a map grows: {tries}, of maps of {counts} images")
    moved = Row("a map in another folder", "it answers as before")
    (folder / "else" / "where").mkdir(parents=True)
    os.rename(out, folder / "else" / "where" / "map")
    out = folder / "else" / "where" / "map"
    ended.touch()
    done = forked(read, cwd=folder)
    right = done.code == 0 and json.loads(done.out) == [1, [IMAGES], []]
    moved.note(right, f"{done.out}{done.err[-300:]}")
    return [read_there, moved]


EXTRACTING = Marks(
    {
        "part of the tokens": "crisalad_jax.retrieval.segments:write_record",
        "writing descriptors": "crisalad_jax.retrieval.extract:write_descriptors",
    }
)


def attack_extract(bench: Bench, suffix: str, kills: int) -> list[Row]:
    """Kill `extract`, half of the chains over an older set, and read the set after each kill."""
    import crisalad_jax.retrieval.extract
    from crisalad_jax.retrieval.descriptor_files import read_descriptors, write_descriptors

    folder = bench.folder / suffix[1:]
    images = folder / "images"
    write_images(images, 0, IMAGES)
    small = (crisalad_jax.retrieval.extract, "SEGMENT", TOGETHER)

    def go(out: pathlib.Path, during: Callable[[int], None] | None = None) -> Done:
        EXTRACTING.clear()
        arguments = [
            *("extract", "--weights", f"{bench.world.weights}", "--images", f"{images}"),
            *("--out", f"{out}", "--batch-size", f"{TOGETHER}", "--quiet"),
        ]
        return forked(command(arguments, EXTRACTING, small), cwd=folder, during=during)

    def read(path: pathlib.Path) -> tuple[list[str], np.ndarray]:
        names, descriptors = read_descriptors(path)
        return names, np.array(descriptors)

    def bytes_of(path: pathlib.Path) -> dict[str, bytes]:
        return {each.name: each.read_bytes() for each in path.parent.iterdir() if each.is_file()}

    whole = folder / "whole" / f"d{suffix}"
    whole.parent.mkdir()
    done = go(whole)
    assert done.code == 0, done.err
    again = folder / "again" / f"d{suffix}"
    again.parent.mkdir()
    seconds = go(again).seconds
    expected = bytes_of(whole)
    assert bytes_of(again) == expected
    names, new = read(whole)
    old = np.ascontiguousarray(new[::-1])

    had_old: set[pathlib.Path] = set()

    def in_chain(chain: pathlib.Path, during: Callable[[int], None] | None = None) -> Done:
        return go(chain / whole.name, during)

    def wrong_with(chain: pathlib.Path) -> str:
        try:
            found, descriptors = read(chain / whole.name)
        except InputError as error:
            return "" if is_told(error) else f"refused in several lines: {error}"
        except Exception as error:
            return f"raised {error!r}"
        sets = [new, old] if chain in had_old else [new]
        right = found == names and any(np.array_equal(descriptors, each) for each in sets)
        return "" if right else "read a mixture"

    at_each = Row(
        f"kills of extract {suffix}: each moment",
        "read_descriptors gives the old set, the new one, or refuses in one line",
    )
    of_chains = Row(
        f"kills of extract {suffix}: chains", "the set has the bits of an uninterrupted one"
    )

    def prepare(chain: pathlib.Path, number: int) -> None:
        chain.mkdir()
        if number % 2:
            had_old.add(chain)
            write_descriptors(chain / whole.name, old, names)

    def wrong_at_end(chain: pathlib.Path) -> list[str]:
        found = bytes_of(chain / whole.name)
        whole_ones = {n: data for n, data in found.items() if not n.startswith(".crisalad-")}
        folders = [path.name for path in chain.iterdir() if path.is_dir()]
        return ["other bits"] * (whole_ones != expected) + folders

    def moment() -> Moment:
        return a_moment(bench, EXTRACTING, seconds, (4, 1), (0.002, 0.005, 0.02))

    ends = (at_each, wrong_with), (of_chains, wrong_at_end)
    kill_chains(bench, folder, kills, in_chain, moment, *ends, prepare=prepare)
    return [at_each, of_chains]


COMPARING = Marks(
    {
        "training": "crisalad_jax.experiments.comparison.runner:fit",
        "evaluating": "crisalad_jax.experiments.comparison.runner:evaluate",
        "timing": "crisalad_jax.experiments.comparison.runner:race",
    }
)


def attack_compare(bench: Bench, kills: int) -> list[Row]:
    """Kill a small comparison."""
    folder = bench.folder / "comparing"
    folder.mkdir()

    def go(out: pathlib.Path, during: Callable[[int], None] | None = None) -> Done:
        COMPARING.clear()
        work = command(VERBS["compare"](bench.world, out), COMPARING)
        return forked(work, cwd=folder, during=during, limit=600)

    def wrong_with(out: pathlib.Path) -> list[str]:
        found, expected = out / "comparison", folder / "whole" / "comparison"
        (run,) = expected.rglob("run")
        wrong = differences(found / run.relative_to(expected), run)
        for path in expected.rglob("result.json"):
            other = found / path.relative_to(expected)
            values = [without_times(json.loads(each.read_text())) for each in (path, other)]
            wrong += [] if values[0] == values[1] else [path.name]
        names = [
            {n for n in files_in(each) if "/tensorboard/" not in n and "/state/" not in n}
            for each in (found, expected)
        ]
        return wrong + sorted(names[0] ^ names[1])

    go(folder / "whole")
    seconds = go(folder / "again").seconds
    assert not wrong_with(folder / "again"), wrong_with(folder / "again")
    row = Row("kills of compare", "the comparison ends with the weights and ranks of a whole one")

    def moment() -> Moment:
        return a_moment(bench, COMPARING, seconds, (1, 1, 1), (0.3 * seconds,))

    kill_chains(bench, folder, kills, go, moment, None, (row, wrong_with))
    return [row]


ATTACKS: Mapping[str, Callable[[Bench, float], list[Row]]] = {
    "training": lambda bench, scale: attack_training(
        bench,
        kills=part_of(200, scale, least=3),
        chains=part_of(40, scale),
        programs=part_of(20, scale, least=0),
    ),
    "maps": lambda bench, scale: attack_maps(bench, part_of(50, scale, least=4)),
    "extract .npy": lambda bench, scale: attack_extract(bench, ".npy", part_of(20, scale, least=3)),
    "extract .h5": lambda bench, scale: attack_extract(bench, ".h5", part_of(20, scale, least=3)),
    "compare": lambda bench, scale: attack_compare(bench, part_of(5, scale)),
}


def part_of(count: int, scale: float, least: int = 1) -> int:
    """Return a part of the full count of tries."""
    return max(least, round(scale * count))


def open_bench(folder: pathlib.Path, seed: int) -> Bench:
    """Make a bench in an empty folder; the compiled programs are kept beside."""
    import_everything()
    environment = keep_programs(folder / "programs") | {"PYTHONPATH": str(ROOT)}
    begun = time.monotonic()

    def say(line: str) -> None:
        print(f"[{time.monotonic() - begun:5.0f} s] {line}", file=sys.stderr, flush=True)

    world = make_world(folder / "world")
    return Bench(world, folder, random.Random(seed), seed, environment, say)


def carry_out(attacks: Mapping[str, Callable[[Bench, float], list[Row]]], description: str) -> int:
    """Run attacks as the arguments say, write their rows, and return the exit code."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="report to add rows to")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="part of the full counts; 0 for a handful"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=attacks, default=list(attacks))
    given = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGHUP):  # ignored under nohup and in the background
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    failures = []
    with tempfile.TemporaryDirectory() as temporary:
        bench = open_bench(pathlib.Path(temporary), given.seed)
        for name in given.only:
            rows = attacks[name](bench, given.scale)
            write_rows(given.out, rows)
            for row in rows:
                bench.say(f"{row.attack}: {row.tries} tries, {len(row.failures)} failures")
                failures += row.failures
    print(*failures[:20], sep="\n")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, (__doc__ or "").splitlines()[0]))
