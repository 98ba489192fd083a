"""Signal commands at random moments: one line, an exit code, nothing left, and no work lost.

    python -m tests.attack.interruptions --out rows.json [--scale 1] [--seed 0] [--only NAME ...]

Most commands are forks of a process that has imported everything; some are programs of their own,
signalled while they import. No program can handle a signal before the interpreter runs its first
line: such tries are counted apart, and that time is measured.
"""

import hashlib
import os
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tests.attack.kills import (
    OF_ONE_RUN,
    Marks,
    Moment,
    contents,
    marked,
    recipe_of_chains,
    runs,
    train_arguments,
)
from tests.attack.world import (
    VERBS,
    Attack,
    Bench,
    Done,
    Row,
    arguments,
    carry_out,
    differences,
    files_in,
    forked,
    has_temporaries,
    one_line,
    part_of,
)

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LONGEST = 10.0
"""Seconds from a signal to the end of the program."""
CALLS = Marks(
    {
        "making a folder": "os:mkdir",
        "locking": "fcntl:flock",
        "renaming": "os:replace",
        "removing": "os:unlink",
        "the loop of training": "crisalad_jax.training.loop:_Loop.train",
        "saving": "crisalad_jax.training.run_files:RunFiles.save",
        "validating": "crisalad_jax.training.validation:Validator.validate",
        "keeping the best": "crisalad_jax.training.run_files:RunFiles.save_if_best",
        "logging": "crisalad_jax.training.run_files:RunFiles.log",
    }
)
TRAINING_CALLS = ("the loop of training", "saving", "validating", "keeping the best")


class Verb:
    """A command, and what it writes if nothing interrupts it."""

    def __init__(self, bench: Bench, name: str) -> None:
        """Run it twice: what both write alike, an interrupted one has to write too."""
        self.name, self._bench = name, bench
        self._recipe = recipe_of_chains(bench.folder) if name == "train" else None
        folders = [bench.folder / "whole" / f"{name} {n}" for n in range(2)]
        for folder in folders:
            done = self.go(folder)
            assert done.code == 0, (name, done.err)
            self.seconds = done.seconds
        first, second = map(self._files, folders)
        assert first.keys() == second.keys(), (name, first.keys() ^ second.keys())
        self._unstable = differences(first, second)
        self._expected = second
        assert len(self._unstable) < len(second), name

    def arguments(self, out: pathlib.Path) -> list[str]:
        """Return the command that writes into a folder."""
        if self._recipe is not None:
            return train_arguments(self._bench.world, self._recipe, out / "run")
        return arguments(self.name, self._bench.world, out)

    def go(
        self,
        out: pathlib.Path,
        during: Callable[[int], None] | None = None,
        settings: Sequence[tuple[Any, str, Any]] = (),
    ) -> Done:
        """Run it in a fork, with smaller settings where the command has none."""
        import crisalad_jax.retrieval.extract
        import crisalad_jax.retrieval.maps.build

        small = [
            (crisalad_jax.retrieval.maps.build, "SEGMENT", 4),
            (crisalad_jax.retrieval.extract, "SEGMENT", 4),
        ]
        return runs(self._bench, CALLS, self.arguments, *settings, *small)(out, during)

    def _files(self, out: pathlib.Path) -> dict[str, Any]:
        found: dict[str, Any] = {
            name: (out / name).read_bytes()
            for name in files_in(out)
            if (out / name).is_file() and not any(part in f"/{name}" for part in OF_ONE_RUN)
        }
        if self.name == "train":
            found |= {name: value for name, value in contents(out).items() if value is not None}
        return found

    def wrong_with(self, out: pathlib.Path, done: Done) -> list[str]:
        """List what a command that should have finished did not do as an uninterrupted one."""
        if done.code:
            return [done.err[-300:]]
        found = self._files(out)
        differ = differences(found, self._expected)
        both = found.keys() & self._expected.keys()
        return [name for name in differ if name not in both & {*self._unstable}] + left_in(out)


def left_in(folder: pathlib.Path) -> list[str]:
    """List temporary files, locks and empty folders; orbax clears its own at the next start."""
    empty = [name for name in files_in(folder) if (folder / name).is_dir()]
    return sorted({*has_temporaries(folder), *empty})


def wrong_end(number: int, code: int, err: str, sent: float) -> list[str]:
    """List what is wrong with the end, which was just now, of a program at a signal."""
    seconds = time.monotonic() - sent
    wrong = []
    if code != 128 + number:
        wrong.append(f"exit code {code}")
    if not one_line(err):
        wrong.append(f"not one line: {err[-300:]!r}")
    if seconds > LONGEST:
        wrong.append(f"{seconds:.1f} s after the signal")
    return wrong


class Tries:
    """The rows of an attack by signals."""

    def __init__(self, what: str) -> None:
        """Make empty rows."""
        self.ends = Row(f"signals, {what}: the end", "one line, code 130, 143 or 129, within 10 s")
        self.left = Row(
            f"signals, {what}: what is left", "no temporary file, no lock, no empty folder"
        )
        self.resumed = Row(
            f"signals, {what}: the same command", "it finishes with the bits of a whole one"
        )
        self.rows = [self.ends, self.left, self.resumed]

    def resume(self, verb: Verb, out: pathlib.Path, words: str) -> None:
        """Note what a signal has left, and whether the same command finishes."""
        left = left_in(out)
        self.left.note(not left, f"{words}: {left}")
        done = verb.go(out)
        if verb.name == "export" and "expected a new or empty one" in done.err:
            # An export whose last act was done refuses to write into its own folder.
            done = done._replace(code=0)
        wrong = verb.wrong_with(out, done)
        self.resumed.note(not wrong, f"{words}: {wrong}")


def attack_forks(what: str, verbs: Sequence[str], tries: int, bench: Bench) -> list[Row]:
    """Signal forks at moments spread over their work, or just after a call that changes files."""
    rows = Tries(what)
    for position, name in enumerate(verbs):
        verb = Verb(bench, name)
        for turn in range(tries // len(verbs) + (position < tries % len(verbs))):
            _one_fork(bench, verb, position + turn, rows)
        bench.say(f"signals: {name}, {verb.seconds:.1f} s a run")
    return rows.rows


def _one_fork(bench: Bench, verb: Verb, turn: int, rows: Tries) -> None:
    """Signal a command until a signal meets it at work, then run the same command."""
    number = SIGNALS[turn % len(SIGNALS)]
    for attempt in range(20):
        out = bench.folder / "signalled" / f"{verb.name} {turn} {attempt}"
        moment = _moment(bench, verb, number)
        done = verb.go(out, moment)
        if moment.during and CALLS.times("the end") == 0:
            break
        # It had ended: nothing may be missing then either.
        words = f"seed {bench.seed}, {verb.name}, {moment}, at its end: {done.err[-300:]}"
        rows.resumed.note(done.code in (0, 128 + number) and not left_in(out), words)
    words = f"seed {bench.seed}, {verb.name}, signal {number}, {moment} ({moment.during})"
    wrong = wrong_end(number, done.code, done.err, moment.sent)
    at_work = moment.during in TRAINING_CALLS and moment.before["logging"]
    if verb.name == "train" and at_work and "goes on" not in done.err:
        wrong.append(f"no word of the saved state: {done.err}")
    rows.ends.note(not wrong, f"{words}: {wrong}")
    rows.resume(verb, out, words)


def _moment(bench: Bench, verb: Verb, number: int) -> Moment:
    chance = bench.random.random()
    if chance < 0.5:
        after, work, nth = bench.random.uniform(0, 0.95 * verb.seconds), "start", 1
    else:
        calls = CALLS.works[:4]
        if verb.name in ("train", "compare", "demo") and chance < 0.8:
            calls = list(TRAINING_CALLS)
        work, nth = bench.random.choice(calls), bench.random.randint(1, 3)
        after = bench.random.uniform(0, bench.random.choice([0.0005, 0.005, 0.1]))
    return Moment(CALLS, number, after=after, work=work, nth=nth)


def handles(process: int) -> bool:
    """Return whether a process handles SIGHUP, the last of the signals that it begins to handle."""
    try:
        status = pathlib.Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False
    (caught,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught, 16) & 1 << (signal.SIGHUP - 1))


def attack_programs(bench: Bench, scale: float) -> list[Row]:
    """Signal programs of their own, from their first moment to the end of their imports."""
    rows = Tries("programs that start")
    early = Row(
        "signals before the first line of Python",
        "counted apart: the interpreter's own start, which no program can handle",
    )
    verbs = [Verb(bench, name) for name in ("info", "train", "index", "query", "extract .h5")]
    begun = time.monotonic()
    program = bench.program(["info", "--preset", "tiny"])
    while not handles(program.pid):
        time.sleep(0.0005)
    window = time.monotonic() - begun
    program.communicate()
    startup = time.monotonic() - begun
    early.promise += f" (here {1000 * window:.0f} ms of {1000 * startup:.0f} ms of a start)"
    for turn in range(part_of(30, scale)):
        verb, number = verbs[turn % len(verbs)], SIGNALS[turn % len(SIGNALS)]
        out = bench.folder / "programs started" / f"{turn}"
        out.mkdir(parents=True)
        after = bench.random.uniform(0, startup)
        program = bench.program(verb.arguments(out))
        time.sleep(after)
        handled, sent = handles(program.pid), time.monotonic()
        program.send_signal(number)
        err = program.communicate()[1].decode(errors="replace")
        words = f"seed {bench.seed}, {verb.name}, signal {number}, {after:.3f} s after its start"
        if handled:
            wrong = wrong_end(number, program.returncode, err, sent)
            rows.ends.note(not wrong, f"{words}: {wrong}")
        else:
            early.note(program.returncode != 0, f"{words}: it went on")
        rows.resume(verb, out, words)
    return [*rows.rows, early]


def attack_closed_output(bench: Bench, _: float) -> list[Row]:
    """Close standard output after one line, as `| head -1`, for each verb."""
    row = Row("standard output closed (| head -1)", "exit code 0, nothing on standard error")
    folder = bench.folder / "piped"
    # compare and demo print as the others, after minutes.
    verbs = {name: arguments(name, bench.world, folder / name) for name in QUICK}
    verbs["query --json -"] = [
        *("query", str(bench.world.path("images")), "--map", str(bench.world.path("map"))),
        *("--quiet", "--json", "-"),
    ]
    verbs["info --json -"] = ["info", "--preset", "tiny", "--json", "-"]
    for name, given in verbs.items():
        (folder / name).mkdir(parents=True)

        def work(given: Sequence[str] = given) -> int:
            head = subprocess.Popen(["head", "-1"], stdin=subprocess.PIPE)
            assert head.stdin is not None
            os.dup2(head.stdin.fileno(), 1)
            head.stdin.close()
            return marked(given, CALLS)()

        CALLS.clear()
        done = forked(work, cwd=bench.folder)
        beside = name.endswith("--json -")  # all but the JSON is told on standard error
        right = done.code == 0 and (not done.err or beside) and "Traceback" not in done.err
        row.note(right, f"{name}: {done.code} {done.err[-300:]}")
    return [row]


def attack_training(bench: Bench, scale: float) -> list[Row]:
    """Interrupt training twice, signal it while another process asks for its folder, and nohup."""
    verb = Verb(bench, "train")
    twice = Row(
        "Ctrl-C twice in training", "it ends at once, and the same command finishes identically"
    )
    waiting = Row(
        "a signal while a second process wants the same run",
        "the second is refused in one line, the first saves, the same command finishes identically",
    )
    ignored = Row("SIGHUP under nohup", "it continues, and finishes identically")
    for turn in range(part_of(5, scale)):
        out = bench.folder / "twice" / f"{turn}"
        pause = bench.random.choice([0.0, 0.001, 0.01, 0.1])
        first = _moment(bench, verb, signal.SIGINT)

        def both(process: int, first: Moment = first, pause: float = pause) -> None:
            first(process)
            time.sleep(pause)
            if first.during:
                os.kill(process, signal.SIGINT)  # not waited for yet, so the number is its own

        done, wrong = verb.go(out, both), []
        if CALLS.times("the end") == 0:
            wrong = wrong_end(signal.SIGINT, done.code, done.err, first.sent)
        wrong += verb.wrong_with(out, verb.go(out))
        twice.note(not wrong, f"seed {bench.seed}, {first}, {pause} s between: {wrong}")
    for turn in range(part_of(3, scale)):
        out = bench.folder / "waiting" / f"{turn}"
        second: list[Done] = []
        number = SIGNALS[turn % len(SIGNALS)]

        def ask(process: int, out=out, second=second, number=number) -> None:
            begun = time.monotonic()
            while CALLS.times("the loop of training") == 0 and time.monotonic() - begun < 60:
                time.sleep(0.001)
            os.kill(process, signal.SIGSTOP)
            marks = Marks({})
            second.append(forked(marked(verb.arguments(out), marks), cwd=bench.folder))
            os.kill(process, number)
            os.kill(process, signal.SIGCONT)

        done = verb.go(out, ask)
        wrong = wrong_end(number, done.code, done.err, time.monotonic()) + left_in(out)
        if not second[0].told_in_one_line() or "another process" not in second[0].err:
            wrong.append(f"the second: {second[0].code} {second[0].err[-300:]}")
        wrong += verb.wrong_with(out, verb.go(out))
        waiting.note(not wrong, f"seed {bench.seed}, turn {turn}: {wrong}")
    for turn in range(part_of(3, scale)):
        out = bench.folder / "nohup" / f"{turn}"
        moment = _moment(bench, verb, signal.SIGHUP)
        before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as a child takes over
        wrong = verb.wrong_with(out, verb.go(out, moment))
        signal.signal(signal.SIGHUP, before)
        ignored.note(not wrong, f"seed {bench.seed}, {moment}: {wrong}")
    return [twice, waiting, ignored]


def attack_busy(bench: Bench, _: float) -> list[Row]:
    """Signal commands whose main thread is in a library, as XLA is for minutes when it compiles."""
    import crisalad_jax.training.trainer
    from crisalad_jax.retrieval.jax_describer import JaxDescriber

    row = Row(
        "signals while a library works in the main thread",
        "it ends within 10 s; if training has work to save, at the second signal",
    )
    step, busy_from = crisalad_jax.training.trainer.train_step, [0]

    def busy(*given: Any, **options: Any) -> Any:
        busy_from[0] -= 1
        if busy_from[0] < 0:
            CALLS.say("busy")
            hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
        return step(*given, **options)

    places = {
        "extract .npy": (JaxDescriber, "attend", busy),
        "train": (crisalad_jax.training.trainer, "train_step", busy),
    }
    for name, steps, signals in (
        ("extract .npy", 0, [signal.SIGINT]),
        ("train", 0, [signal.SIGTERM]),
        ("train", 3, [signal.SIGINT, signal.SIGINT]),
        ("train", 3, [signal.SIGTERM, signal.SIGHUP]),
    ):
        verb, out = Verb(bench, name), bench.folder / "busy" / f"{row.tries}"
        last = Moment(CALLS, signals[0], after=0.5, work="busy")

        def send(process: int, last: Moment = last, more: Sequence[int] = signals[1:]) -> None:
            last(process)
            for number in more:
                time.sleep(4)
                last.sent = time.monotonic()
                os.kill(process, number)

        busy_from[0] = steps
        done = verb.go(out, send, settings=[places[name]])
        wrong = wrong_end(signals[-1], done.code, done.err, last.sent) + left_in(out)
        wrong += verb.wrong_with(out, verb.go(out))
        row.note(not wrong, f"{name}, {signals}: {wrong}")
    return [row]


QUICK = [name for name in VERBS if name not in ("compare", "demo")]
ATTACKS: Mapping[str, Attack] = {
    # Two quick verbs, which need none of the products.
    "some": lambda bench, _: attack_forks(
        "extract .npy, convert", ["extract .npy", "convert"], 3, bench
    ),
    "forks": lambda bench, scale: attack_forks(
        "all verbs but the long ones", QUICK, part_of(64, scale), bench
    ),
    "programs": attack_programs,
    "training": attack_training,
    "busy": attack_busy,
    "closed output": attack_closed_output,
    "long": lambda bench, scale: attack_forks(
        "compare, demo", ["compare", "demo"], part_of(8, scale), bench
    ),
}


if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__))
