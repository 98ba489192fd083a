"""Kill commands at random moments: what they leave is whole, and the same command ends alike.

    python -m tests.attack.kills --out rows.json [--scale 1] [--seed 0] [--only training maps ...]

A chain is one folder, in which a command is killed several times and then finishes. Most commands
are forks of this process, which has imported everything; some are programs of their own, killed
while they import. Moments are of two kinds: at any time of a whole run, and soon after a certain
work has begun, so that saves and commits, which are short, are met too.
"""

import contextlib
import dataclasses
import functools
import importlib
import json
import mmap
import os
import pathlib
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from tests.attack.world import (
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
    with_flag,
    without_times,
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

    def _count(self, number: int) -> slice:
        return slice(1 + 4 * number, 5 + 4 * number)

    def times(self, name: str) -> int:
        """Return how often the child has begun this work."""
        return int.from_bytes(self._memory[self._count(self.names.index(name))], "little")

    def say(self, name: str) -> None:
        """Count in the child that it handles signals (start), is busy, has done all (the end)."""
        count = self._count(self.names.index(name))
        self._memory[count] = (self.times(name) + 1).to_bytes(4, "little")

    def install(self) -> None:
        """Mark the functions, in the child."""
        for name, path in self._paths.items():
            self._wrap(name, path)

    def _wrap(self, work: str, path: str) -> None:
        module, _, name = path.partition(":")
        *classes, name = name.split(".")
        holder = functools.reduce(getattr, classes, importlib.import_module(module))
        real = getattr(holder, name)

        def call(*given: Any, **options: Any) -> Any:
            before, self._memory[0] = self._memory[0], self.names.index(work)
            self.say(work)
            try:
                return real(*given, **options)
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


def marked(given: Sequence[str], marks: Marks, *settings: tuple[Any, str, Any]) -> Callable:
    """Return the work of a child: a command, with its marks, and attributes set to other values."""

    def work() -> int:
        for holder, name, value in settings:
            assert hasattr(holder, name)  # or it is not what the command uses
            setattr(holder, name, value)
        marks.install()
        code = command(given, ready=lambda: marks.say("start"))
        marks.say("the end")
        return code

    return work


Go = Callable[..., Done]
"""Runs a command in a folder, as go(folder) or go(folder, during)."""
Files = Callable[[pathlib.Path], dict[str, Any]]
"""Returns what is in a folder, without what differs in two runs."""


class Whole(NamedTuple):
    """A command, and what it does undisturbed."""

    go: Go
    files: Files
    expected: dict[str, Any]
    """What `files` returns after a whole run."""
    seconds: float


def undisturbed(go: Go, folder: pathlib.Path, files: Files) -> Whole:
    """Run a command twice, and check that both write the same."""
    folders = [folder / f"whole{number}" for number in range(2)]
    done = [go(each) for each in folders]
    assert not any(each.code for each in done), done
    first, second = map(files, folders)
    assert first == second, differences(first, second)
    return Whole(go, files, first, done[1].seconds)


def a_moment(
    bench: Bench,
    marks: Marks,
    seconds: float,
    times: Sequence[int],
    spreads: Sequence[float],
    weights: Sequence[int] | None = None,
) -> Moment:
    """Draw a moment to kill at: in the whole run, or soon after some work has begun.

    Args:
        bench: draws.
        marks: of the child.
        seconds: of the whole run.
        times: of each work, the last beginning that is drawn.
        spreads: most seconds after a beginning, one of which is drawn.
        weights: of each work; None draws each as often.
    """
    if bench.random.random() < 0.3:
        return Moment(marks, signal.SIGKILL, after=bench.random.uniform(0, seconds))
    ((work, most),) = bench.random.choices(list(zip(marks.works, times, strict=True)), weights)
    after = bench.random.uniform(0, bench.random.choice(spreads))
    nth = bench.random.randint(1, most)
    return Moment(marks, signal.SIGKILL, after=after, work=work, nth=nth)


def runs(
    bench: Bench, marks: Marks, given: Callable[[pathlib.Path], list[str]], *settings: Any
) -> Go:
    """Return what runs a command that writes into a folder, as `marked` does, in a fork."""

    def go(out: pathlib.Path, during: Callable[[int], None] | None = None) -> Done:
        marks.clear()
        out.mkdir(parents=True, exist_ok=True)
        work = marked(given(out), marks, *settings)
        return forked(work, cwd=bench.folder, during=during, limit=600)

    return go


def kill_at(
    go: Go,
    moment: Callable[[], Moment],
    row: Row | None = None,
    wrong_with: Callable[[pathlib.Path], str] = lambda chain: "",
) -> Callable[[pathlib.Path], tuple[str, int]]:
    """Return a kill at a moment that is drawn, after each of which a row gets what is wrong."""

    def kill(chain: pathlib.Path) -> tuple[str, int]:
        when = moment()
        done = go(chain, when)
        if done.code and row is not None:
            bad = wrong_with(chain)
            row.note(not bad, f"{chain.name}, {when}: {bad}")
        return when.during or "the end", done.code

    return kill


def kill_chains(
    bench: Bench,
    folder: pathlib.Path,
    whole: Whole,
    kills: int,
    kill: Callable[[pathlib.Path], tuple[str, int]],
    row: Row,
    *,
    most: int | None = None,
    prepare: Callable[[pathlib.Path, int], None] = lambda chain, number: None,
) -> list[tuple[list[str], str]]:
    """Kill a command in one folder after another, in each until it has finished.

    Args:
        bench: says how it goes on.
        folder: of the chains.
        whole: the command.
        kills: number of all.
        kill: runs the command in a chain's folder and kills it; returns what the command was doing,
            and its exit code.
        row: of the chains.
        most: kills in a chain; None leaves it to them.
        prepare: makes a chain's folder, of this number.

    Returns:
        For each chain what its kills met, and what was wrong at its end.
    """
    ends, killed = [], 0
    while killed < kills:
        chain, met, wrong = folder / f"chain{len(ends)}", [], []
        prepare(chain, len(ends))
        while killed < kills and len(met) != most:
            name, code = kill(chain)
            if code == 0:
                break  # it had finished
            killed += 1
            met.append(name)
            if code != -signal.SIGKILL:
                wrong.append(f"exit code {code} at {name}")
        done = whole.go(chain)
        if done.code:
            wrong.append(done.err[-300:])
        else:
            wrong += differences(whole.files(chain), whole.expected)
        words = f"seed {bench.seed}, chain {len(ends)}, {met}: {wrong}"
        row.note(not wrong, words)
        ends.append((met, words if wrong else ""))
        if not wrong:
            shutil.rmtree(chain)
        bench.say(f"{row.attack}: {killed} of {kills} kills, {row.tries} chains")
    return ends


def contents(folder: pathlib.Path) -> dict[str, Any]:
    """Return what two runs of training write alike: names, weights, results and log."""
    found: dict[str, Any] = {}
    for name in files_in(folder):
        path = folder / name
        if path.suffix == ".safetensors":
            found[name] = path.read_bytes()
        elif path.name in ("metrics.jsonl", "result.json"):
            lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
            found[name] = [without_times(json.loads(line)) for line in lines]
        elif ".crisalad-" in name or not any(part in f"/{name}" for part in OF_ONE_RUN):
            found[name] = None
    return found


OF_ONE_RUN = ("/state/", "/tensorboard/")
"""What other programs name by time, and what is not the end of a run."""
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


def recipe_of_chains(folder: pathlib.Path) -> pathlib.Path:
    """Write a configuration whose steps, of a small model with dropout, are traced in a second."""
    from crisalad_jax.config.io import to_plain
    from crisalad_jax.nn.aggregators.gem import GemConfig
    from tests.conftest import MODEL, RECIPE

    backbone = dataclasses.replace(MODEL.backbone, depth=1)
    model = dataclasses.replace(MODEL, backbone=backbone, aggregator=GemConfig())
    path = folder / "recipe.json"
    config = dataclasses.replace(RECIPE, model=model, epochs=6, patience=None, save_top_k=2)
    write_json(path, to_plain(config))
    return path


def train_arguments(world: World, recipe: pathlib.Path, out: pathlib.Path) -> list[str]:
    """Return a command that trains by this configuration."""
    return [
        *("train", "--data", str(world.path("city")), "--out", str(out), "--config", str(recipe)),
        *("--val", str(world.path("town")), "--quiet"),
    ]


def attack_training(bench: Bench, scale: float) -> list[Row]:
    """Kill runs of training, some as programs of their own while they start."""
    import crisalad_jax.training.run_files

    kills, chains = part_of(200, scale, least=3), part_of(40, scale)
    programs = part_of(20, scale, least=0)
    folder = bench.folder / "training"
    folder.mkdir()
    recipe = recipe_of_chains(folder)

    def train(out: pathlib.Path) -> list[str]:
        return train_arguments(bench.world, recipe, out / "run")

    often = (crisalad_jax.training.run_files, "SAVE_SECONDS", -1.0)
    go = runs(bench, TRAINING, train, often)
    whole = undisturbed(go, folder, contents)
    startup = 0.0
    if programs:
        begun = time.monotonic()
        bench.program(train(folder / "program")).communicate()
        startup = time.monotonic() - begun
        assert contents(folder / "program") == whole.expected
    starting: set[pathlib.Path] = set()

    def prepare(chain: pathlib.Path, number: int) -> None:
        if programs and number % max(chains // programs, 1) == 0:
            starting.add(chain)

    times, weights = (1, 4, 4, 4, 4, 4, 1), (1, 1, 4, 5, 2, 2, 1)
    moment = functools.partial(
        a_moment, bench, TRAINING, whole.seconds, times, (0.002, 0.02, 0.2), weights
    )

    def kill(chain: pathlib.Path) -> tuple[str, int]:
        if chain in starting:
            starting.discard(chain)
            program = bench.program(train(chain))
            try:
                program.wait(bench.random.uniform(0, startup))
            except subprocess.TimeoutExpired:
                program.kill()
            program.communicate()
            return "a program as it starts", program.returncode
        name, code = kill_at(go, moment)(chain)
        writing = any("tmp" in path.name for path in (chain / "run" / "state").glob("*"))
        return "a state is written" if writing else name, code

    of_chains = Row(
        "kills of training, chains", "killed runs end with the bits of an uninterrupted run"
    )
    of_kills = {
        name: Row(f"kills of training: {name}", "the same command resumes")
        for name in ("a program as it starts", "a state is written", *TRAINING.names)
    }
    most = -(-kills // chains)
    for met, bad in kill_chains(
        bench, folder, whole, kills, kill, of_chains, most=most, prepare=prepare
    ):
        for name in met:
            of_kills[name].note(not bad, bad)
    return [of_chains, *(row for row in of_kills.values() if row.tries)]


def is_told(error: Exception) -> bool:
    """Return whether an error is one of ours, in one line."""
    return isinstance(error, InputError) and "\n" not in str(error)


IMAGES, TOGETHER = 24, 2
"""Images of a map or a set, and how many of them are described together."""


def describes(bench: Bench, verb: str, name: str, marks: Marks, module: Any) -> Go:
    """Return what runs `index` or `extract` over pictures, in small parts, into a folder."""
    from tests.conftest import write_picture

    images = bench.folder / f"images of {name}"
    for number in range(IMAGES):
        write_picture(images / "sub" / f"@{100 + number}@500@10@S@{number:03d}@.jpg", number)

    def given(out: pathlib.Path) -> list[str]:
        return [
            *(verb, "--weights", str(bench.world.path("weights.safetensors")), "--quiet"),
            *("--images", str(images), "--out", str(out / name), "--batch-size", str(TOGETHER)),
        ]

    return runs(bench, marks, given, (module, "SEGMENT", TOGETHER))


INDEXING = Marks(
    {
        "opening the map": "crisalad_jax.retrieval.maps.build:open_for_appending",
        "appending": "crisalad_jax.retrieval.maps.appending:AppendableMap.append",
        "a descriptors' file": "crisalad_jax.retrieval.maps.file_store:FileStore.add",
        "a record": "crisalad_jax.retrieval.segments:write_record",
    }
)


def map_files(out: pathlib.Path) -> dict[str, Any]:
    """Return the bytes of a map's descriptors, and its JSON but for times and its name."""
    folder = out / "map"
    found: dict[str, Any] = {p.name: p.read_bytes() for p in (folder / "segments").iterdir()}
    found["map.json"] = (folder / "map.json").read_bytes()
    for name in found:
        if name.endswith(".json"):
            found[name] = without_times(json.loads(found[name]))
    del found["map.json"]["created"], found["map.json"]["collection"]
    return found | dict.fromkeys(has_temporaries(out))


def attack_maps(bench: Bench, scale: float) -> list[Row]:
    """Kill `index`, read maps after each kill, and search a map while it grows."""
    import crisalad_jax.retrieval.maps.build
    from crisalad_jax.retrieval.maps.map import Map
    from crisalad_jax.retrieval.maps.metadata import has_images

    folder = bench.folder / "maps"
    go = describes(bench, "index", "map", INDEXING, crisalad_jax.retrieval.maps.build)
    whole = undisturbed(go, folder, map_files)
    with Map.open(folder / "whole0" / "map") as opened:
        names = [image.name for image in opened.images]
        rows = np.concatenate(list(opened.descriptors))
    assert len(names) == IMAGES

    def wrong_with(out: pathlib.Path) -> str:
        """Return what is wrong with a map; nothing if it has the first images, or none."""
        if not has_images(out / "map"):
            try:
                Map.open(out / "map").close()
                return "a map without images was opened"
            except InputError as error:
                return "" if is_told(error) else str(error)
        with Map.open(out / "map") as opened:
            count = len(opened)
            found = [image.name for image in opened.images]
            same = np.array_equal(np.concatenate(list(opened.descriptors)), rows[:count])
            prefix = found == names[:count] and same and count % TOGETHER == 0
        return "" if prefix else f"{count} images, not the first ones"

    moment = functools.partial(
        a_moment, bench, INDEXING, whole.seconds, (1, 3, 3, 3), (0.0005, 0.005, 0.05)
    )
    at_each = Row("kills of index: each moment", "the map opens with the first images, or has none")
    of_chains = Row("kills of index: chains", "the map ends with the bits of an uninterrupted one")
    kill = kill_at(go, moment, at_each, wrong_with)
    kills = part_of(50, scale, least=4)
    kill_chains(bench, folder, whole, kills, kill, of_chains)
    return [at_each, of_chains, *attack_readers(folder, go, rows, bench.say)]


CHANGING = Marks(
    {
        "opening the map": "crisalad_jax.retrieval.maps.corrections:open_for_appending",
        "changing": "crisalad_jax.retrieval.maps.appending:AppendableMap.change",
        "a descriptors' file": "crisalad_jax.retrieval.maps.file_store:FileStore.add",
        "a record": "crisalad_jax.retrieval.segments:write_record",
    }
)


def map_state(folder: pathlib.Path) -> list[tuple]:
    """Return all that a map says of its images, and their descriptors."""
    from crisalad_jax.retrieval.maps.map import Map

    with Map.open(folder) as opened:
        rows = np.concatenate(list(opened.descriptors))
        return [(*image, row.tobytes()) for image, row in zip(opened.images, rows, strict=True)]


def attack_changes(bench: Bench, scale: float) -> list[Row]:
    """Kill `map remove`, `replace` and `merge`, each in a copy of one map, and do it again."""
    import crisalad_jax.retrieval.maps.build
    import crisalad_jax.retrieval.maps.corrections
    from tests.conftest import write_picture

    folder, build = bench.folder / "changes", crisalad_jax.retrieval.maps.build
    corrections = crisalad_jax.retrieval.maps.corrections
    weights = ["--weights", str(bench.world.path("weights.safetensors"))]
    assert describes(bench, "index", "map", INDEXING, build)(folder / "base").code == 0
    images = bench.folder / "images of map"
    new, more = (shutil.copytree(images, bench.folder / name) for name in ("new", "more"))
    (more / "sub").rename(more / "other")
    for number in range(3, 9):
        write_picture(new / "sub" / f"@{100 + number}@500@10@S@{number:03d}@.jpg", 50 + number)

    def index_more(out: pathlib.Path) -> list[str]:
        return ["index", *weights, "--quiet", "--images", str(more), "--out", str(out / "map")]

    assert (
        runs(bench, INDEXING, index_more, (build, "SEGMENT", TOGETHER))(folder / "more").code == 0
    )
    verbs = {
        "remove": ["sub/*@00[2-7]@.jpg"],
        "replace": ["--images", str(new), *weights, "--batch-size", str(TOGETHER)],
        "merge": [str(folder / "more" / "map")],
    }
    rows = []
    for verb, words in verbs.items():

        def given(out: pathlib.Path, verb: str = verb, words: Sequence[str] = words) -> list[str]:
            return ["map", verb, str(out / "map"), *words, "--quiet"]

        go = runs(bench, CHANGING, given, (corrections, "SEGMENT", TOGETHER))
        shutil.copytree(folder / "base", folder / verb)
        done = go(folder / verb)
        assert done.code == 0, done
        either = [map_state(folder / name / "map") for name in ("base", verb)]
        assert either[0] != either[1]
        row = Row(f"kills of map: {verb}", "the map before or after; the same command finishes")
        killed = 0
        while killed < part_of(20, scale, least=3):
            chain = folder / f"{verb}{row.tries}"
            shutil.copytree(folder / "base", chain)
            times = (1, 1, 1 if verb == "remove" else 3, 1 if verb == "remove" else 3)
            spreads = (0.0005, 0.005, 0.05)
            when = a_moment(bench, CHANGING, done.seconds, times, spreads)
            code = go(chain, when).code
            killed += code != 0
            found, again = map_state(chain / "map"), go(chain)
            wrong = [] if code in (0, -signal.SIGKILL) else [f"exit code {code}"]
            wrong += [] if found in either else ["neither before nor after"]
            ended = again.code == 0 and map_state(chain / "map") == either[1]
            wrong += [] if ended else [f"it ended otherwise: {again.err[-300:]}"]
            wrong += has_temporaries(chain)
            row.note(not wrong, f"seed {bench.seed}, {chain.name}, {when}: {wrong}")
            if not wrong:
                shutil.rmtree(chain)
        bench.say(f"{row.attack}: {killed} kills, {row.tries} tries")
        rows.append(row)
    return rows


def attack_readers(
    folder: pathlib.Path, go: Go, rows: np.ndarray, say: Callable[[str], None]
) -> list[Row]:
    """Search a map in a loop while another process makes it, then move it and ask it again."""
    from crisalad_jax.retrieval.maps.map import Map
    from crisalad_jax.retrieval.neighbours import exact_similarities

    growing, ended = folder / "growing", folder / "ended"
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

    def read(out: pathlib.Path) -> int:
        counts, tries, failures = set(), 0, []
        last = False
        while not last:
            last = ended.exists()
            try:
                with Map.open(out / "map") as opened:
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
            assert go(growing).code == 0
        finally:
            ended.touch()

    while_growing = Row(
        "searches of a map while it grows", "each answer is that of the first images, no errors"
    )
    done = forked(lambda: read(growing), cwd=folder, during=make)
    if done.code != 0:
        while_growing.note(False, f"the reader ended with code {done.code}: {done.err[-300:]}")
    else:
        while_growing.tries, counts, while_growing.failures = json.loads(done.out)
        say(f"searches while a map grows: {while_growing.tries}, of maps of {counts} images")
    moved = Row("a map in another folder", "it answers as before")
    growing.rename(folder / "elsewhere")
    done = forked(lambda: read(folder / "elsewhere"), cwd=folder)
    right = done.code == 0 and json.loads(done.out) == [1, [IMAGES], []]
    moved.note(right, f"{done.out}{done.err[-300:]}")
    return [while_growing, moved]


EXTRACTING = Marks(
    {
        "part of the tokens": "crisalad_jax.retrieval.segments:write_record",
        "writing descriptors": "crisalad_jax.retrieval.extract:write_descriptors",
    }
)


def attack_extract(suffix: str, bench: Bench, scale: float) -> list[Row]:
    """Kill `extract`, half of the chains over an older set, and read the set after each kill."""
    import crisalad_jax.retrieval.extract
    from crisalad_jax.retrieval.descriptor_files import read_descriptors, write_descriptors

    folder, name = bench.folder / suffix[1:], f"d{suffix}"
    go = describes(bench, "extract", name, EXTRACTING, crisalad_jax.retrieval.extract)

    def read(out: pathlib.Path) -> tuple[list[str], np.ndarray]:
        names, descriptors = read_descriptors(out / name)
        return names, np.array(descriptors)

    def set_files(out: pathlib.Path) -> dict[str, Any]:
        return {
            path.name: path.read_bytes() if path.is_file() else None
            for path in out.iterdir()
            if not path.name.startswith(".crisalad-")
        }

    whole = undisturbed(go, folder, set_files)
    names, new = read(folder / "whole0")
    old = np.ascontiguousarray(new[::-1])
    had_old: set[pathlib.Path] = set()

    def prepare(chain: pathlib.Path, number: int) -> None:
        if number % 2:
            chain.mkdir()
            had_old.add(chain)
            write_descriptors(chain / name, old, names)

    def wrong_with(chain: pathlib.Path) -> str:
        try:
            found, descriptors = read(chain)
        except InputError as error:
            return "" if is_told(error) else f"refused in several lines: {error}"
        except Exception as error:
            return f"raised {error!r}"
        sets = [new, old] if chain in had_old else [new]
        right = found == names and any(np.array_equal(descriptors, each) for each in sets)
        return "" if right else "read a mixture"

    moment = functools.partial(
        a_moment, bench, EXTRACTING, whole.seconds, (4, 1), (0.002, 0.005, 0.02)
    )
    at_each = Row(
        f"kills of extract {suffix}: each moment",
        "read_descriptors gives the old set, the new one, or refuses in one line",
    )
    of_chains = Row(
        f"kills of extract {suffix}: chains", "the set has the bits of an uninterrupted one"
    )
    kill = kill_at(go, moment, at_each, wrong_with)
    kills = part_of(20, scale, least=3)
    kill_chains(bench, folder, whole, kills, kill, of_chains, prepare=prepare)
    return [at_each, of_chains]


COMPARING = Marks(
    {
        "training": "crisalad_jax.experiments.comparison.runner:fit",
        "evaluating": "crisalad_jax.experiments.comparison.runner:evaluate",
        "timing": "crisalad_jax.experiments.comparison.runner:race",
    }
)


def attack_compare(bench: Bench, scale: float) -> list[Row]:
    """Kill a small comparison."""
    folder = bench.folder / "comparing"
    given = functools.partial(arguments, "compare", bench.world)
    go = runs(bench, COMPARING, given)
    whole = undisturbed(go, folder, contents)
    spread = 0.3 * whole.seconds
    moment = functools.partial(a_moment, bench, COMPARING, whole.seconds, (1, 1, 1), [spread])
    row = Row("kills of compare", "the comparison ends with the weights and ranks of a whole one")
    kills = part_of(5, scale)
    kill_chains(bench, folder, whole, kills, kill_at(go, moment), row)
    return [row]


def attack_compare_on_ray(bench: Bench, scale: float) -> list[Row]:
    """Kill workers of a comparison of two runs at once on Ray, and the command itself."""
    folder = bench.folder / "comparing on ray"
    ends = "the comparison ends as a whole one, and finished runs are left as they are"
    rows = {name: Row(f"kills of compare on Ray: {name}", ends) for name in ("worker", "command")}

    def start(out: pathlib.Path) -> subprocess.Popen[bytes]:
        given = arguments("compare", bench.world, out)
        given = with_flag(with_flag(given, "--seeds", "3"), "--epochs", "20")
        return bench.program(with_flag(given, "--jobs", "2"))

    def ended(program: subprocess.Popen[bytes]) -> str:
        """Wait for its end; return what is wrong with that."""
        _, err = program.communicate(timeout=900)
        return err.decode()[-300:] if program.returncode else ""

    def workers(out: pathlib.Path) -> list[int]:
        """The processes that write into runs."""
        texts = (path.read_text().split() for path in out.glob("*/*/*/.crisalad-lock"))
        return sorted({int(words[1]) for words in texts if words})

    def finished(out: pathlib.Path) -> dict[pathlib.Path, int]:
        """When each finished run got its result."""
        paths = out.glob("*/*/*/result.json")
        return {p: p.stat().st_mtime_ns for p in paths if json.loads(p.read_text())["ranks"]}

    begun = time.monotonic()
    assert not ended(start(folder / "whole"))
    seconds, expected = time.monotonic() - begun, contents(folder / "whole")
    kills, chain = dict.fromkeys(rows, part_of(10, scale)), 0
    while left := [name for name, count in kills.items() if count]:
        out, wrong, before, met = folder / f"chain{chain}", [], {}, []
        while (name := bench.random.choice(left)) and kills[name]:
            program = start(out)
            with contextlib.suppress(subprocess.TimeoutExpired):
                program.wait(bench.random.uniform(0.2, 1) * seconds)
            before |= finished(out)
            victims = workers(out) if name == "worker" else [program.pid]
            if program.poll() is None and victims:
                with contextlib.suppress(ProcessLookupError):  # a worker may just have ended
                    os.kill(bench.random.choice(victims), signal.SIGKILL)
                    kills[name] -= 1
                    met.append(name)
            said = ended(program)
            if program.returncode == 0:
                break
            if program.returncode != -signal.SIGKILL or name == "worker":
                wrong.append(said)
        wrong += filter(None, [ended(start(out))])
        wrong += differences(contents(out), expected)
        wrong += [str(path) for path, when in before.items() if finished(out).get(path) != when]
        for name in met:
            rows[name].note(not wrong, f"seed {bench.seed}, chain {chain}, {met}: {wrong}")
        chain += 1
        bench.say(f"kills of compare on Ray: {kills} are left")
    return [*rows.values()]


ATTACKS: Mapping[str, Attack] = {
    "training": attack_training,
    "maps": attack_maps,
    "map changes": attack_changes,
    "extract .npy": functools.partial(attack_extract, ".npy"),
    "extract .h5": functools.partial(attack_extract, ".h5"),
    "compare": attack_compare,
    "compare on Ray": attack_compare_on_ray,
}


if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__))
