"""Plant faults in the package, one at a time, and check which of them the nearest tests catch.

    python scripts/plant_faults.py crisalad_jax/training/losses crisalad_jax/sinkhorn.py
        [--faults 5] [--seed 0] [--workers 2] [--out faults.json]

A fault is one change that a careless author could make: a comparison or a sign reversed, a number
or a boolean changed, a condition, a check, a keyword or a slice left out. A few are drawn for every
file, and each is planted in a copy of the project, where the module's quick tests run until one
fails. Faults that no test catches are printed: each is a missing assertion, or an equivalent
change.
"""

import argparse
import ast
import concurrent.futures
import contextlib
import copy
import dataclasses
import itertools
import json
import multiprocessing
import multiprocessing.connection
import os
import pathlib
import queue
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence

ROOT = pathlib.Path(__file__).parent.parent
LIBRARIES = ["jax", "jax.numpy", "numpy", "scipy.optimize", "torch", "cv2", "pytest", "optax"]
"""Libraries that tests import and no fault changes, loaded once before the workers fork."""

OTHER = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
NAMES = {"min": "max", "max": "min", "sum": "mean", "sorted": "list", "any": "all", "all": "any"}


@dataclasses.dataclass(frozen=True)
class Fault:
    """One change to a file."""

    line: int
    start: int
    """Offset into the file in bytes; `end` is exclusive."""
    end: int
    before: str
    after: str


@dataclasses.dataclass
class Outcome:
    """The result of running tests with a fault."""

    file: str
    line: int
    before: str
    after: str
    seen_by: str | None
    """The first test that failed; "timeout"; or None."""
    seconds: float


def faults_of(source: str) -> list[Fault]:
    """List every fault that can be planted in a file, in order of position.

    Messages, annotations, docstrings and f-strings are left alone.
    """
    lines = source.encode().splitlines(keepends=True)
    starts = [0, *itertools.accumulate(map(len, lines))]
    faults: list[Fault] = []

    def add(node: ast.stmt | ast.expr, after: str) -> None:
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset  # type: ignore[operator]
        before = ast.get_source_segment(source, node) or ""
        faults.append(Fault(node.lineno, start, end, before, after))

    for node in _code(ast.parse(source)):
        for changed in _changes(node):
            text = ast.unparse(changed)
            add(node, text if isinstance(node, ast.stmt) else f"({text})")
    return sorted(faults, key=lambda fault: (fault.start, fault.end, fault.after))


def _code(node: ast.AST) -> Iterator[ast.stmt | ast.expr]:
    """Walk the nodes that are executed."""
    if isinstance(node, ast.JoinedStr | ast.Raise):
        return
    if isinstance(node, ast.stmt | ast.expr):
        yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        parts = value if isinstance(value, list) else [value]
        if (
            isinstance(node, ast.Call)
            and name == "args"
            and _name(node.func) in ("require", "warn")
        ):
            parts = parts[:1]
        for part in parts:
            if isinstance(part, ast.AST):
                yield from _code(part)


def _name(node: ast.AST) -> str:
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def _changes(node: ast.stmt | ast.expr) -> Iterator[ast.AST]:
    """Make the faults of one node."""

    def changed(**fields: object) -> ast.AST:
        other = copy.copy(node)
        for name, value in fields.items():
            setattr(other, name, value)
        return other

    match node:
        case ast.Compare(ops=[operator]) if type(operator) in OTHER:
            yield changed(ops=[OTHER[type(operator)]()])
        case ast.BinOp(op=operator) | ast.BoolOp(op=operator) if type(operator) in OTHER:
            yield changed(op=OTHER[type(operator)]())
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            yield node.operand
        case ast.IfExp():
            yield changed(body=node.orelse, orelse=node.body)
        case ast.Constant(value=bool(value)):
            yield changed(value=not value)
        case ast.Constant(value=int(value)):
            yield changed(value=value + 1)
        case ast.Constant(value=float(value)):
            yield changed(value=2 * value or 1.0)
        case ast.Subscript(slice=ast.Slice(lower=lower, upper=upper)) if lower or upper:
            yield changed(slice=ast.Slice())
        case ast.If(body=[ast.Raise()], orelse=[]):
            yield ast.Pass()
        case ast.Expr(value=ast.Call(func=function)) if "require" in _name(function):
            yield ast.Pass()
        case ast.Call(func=function):
            if (name := _name(function)) in NAMES:
                other = copy.copy(function)
                setattr(other, "attr" if isinstance(other, ast.Attribute) else "id", NAMES[name])
                keywords = [] if name == "sorted" else node.keywords
                yield changed(func=other, keywords=keywords)
            for number, keyword in enumerate(node.keywords):
                if keyword.arg is not None:
                    yield changed(keywords=node.keywords[:number] + node.keywords[number + 1 :])
        case _:
            pass


def draw(faults: Sequence[Fault], count: int, seed: str) -> list[Fault]:
    """Draw some of a file's faults, at most one per line."""
    shuffled = random.Random(seed).sample(faults, len(faults))
    of_lines = {fault.line: fault for fault in shuffled}
    return sorted(list(of_lines.values())[:count], key=lambda fault: fault.line)


def nearest_tests(file: pathlib.Path) -> list[str]:
    """List the test files of a module, starting with those that import it.

    For a module in a subfolder of a top-level package, these are the tests of the subfolder;
    otherwise those tests of the package that import it; otherwise any that import it; otherwise all
    tests of the package.
    """
    module = ".".join(file.with_suffix("").parts).removesuffix(".__init__")
    package, _, name = module.rpartition(".")
    imports = (f"from {module} import", f"import {module}", f"from {package} import {name}")

    def near(test: pathlib.Path) -> bool:
        text = test.read_text()
        return test.stem == f"test_{file.stem}" or any(words in text for words in imports)

    tests = ROOT / "tests"
    room, folder = tests / "/".join(file.parts[1:2]), tests.joinpath(*file.parts[1:-1])
    of_room = sorted(room.rglob("test_*.py"))
    of_folder = sorted(folder.rglob("test_*.py")) if folder != room else []
    ways = (of_folder, [*filter(near, of_room)], [*filter(near, tests.rglob("test_*.py"))], of_room)
    chosen = sorted(next(filter(None, ways)), key=lambda test: not near(test))
    return [str(test.relative_to(ROOT)) for test in chosen]


def _run(
    copy_of_root: str, tests: Sequence[str], answer: multiprocessing.connection.Connection
) -> None:
    """Run tests in this process until one fails, and send its name."""
    import pytest

    class FirstFailure:
        name: str | None = None

        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                self.name = self.name or report.nodeid

        def pytest_collectreport(self, report: pytest.CollectReport) -> None:
            if report.failed:
                self.name = self.name or report.nodeid

    os.chdir(copy_of_root)
    sys.path.insert(0, copy_of_root)
    os.environ["PYTHONPATH"] = copy_of_root
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    first = FirstFailure()
    options = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider"]
    code = pytest.main([*options, *tests], plugins=[first])
    answer.send(first.name or (None if code in (0, 5) else f"pytest ended with {int(code)}"))


class Copies:
    """Copies of the project, one per worker."""

    def __init__(self, folder: pathlib.Path, count: int) -> None:
        """Copy the files that git tracks, in their current state."""
        names = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True).split("\0")
        self._free: queue.Queue[pathlib.Path] = queue.Queue()
        for number in range(count):
            root = folder / str(number) / ROOT.name
            for name in filter(None, names):
                if (ROOT / name).is_file():
                    (root / name).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(ROOT / name, root / name)
            if (ROOT.parent / "shared").is_dir():  # photographs that some tests read
                (root.parent / "shared").symlink_to(ROOT.parent / "shared")
            self._free.put(root)
        # Unchanged programs are not compiled again.
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder / "programs")
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(LIBRARIES)

    def run(
        self, file: pathlib.Path, fault: Fault | None, tests: Sequence[str], limit: float
    ) -> tuple[str | None, float]:
        """Plant a fault, run tests, and remove it again.

        Returns:
            The first test that failed, "timeout" or None; and the seconds that it took.
        """
        root = self._free.get()
        path, started = root / file, time.monotonic()
        original = path.read_bytes()
        try:
            if fault is not None:
                text = original[: fault.start] + fault.after.encode() + original[fault.end :]
                _write(path, text)
            ours, theirs = self._context.Pipe(duplex=False)
            process = self._context.Process(target=_run, args=(str(root), tests, theirs))
            process.start()
            theirs.close()
            seen: str | None = "timeout"
            if ours.poll(limit):
                try:
                    seen = ours.recv()
                except EOFError:
                    seen = "the tests' process ended"
            process.kill()
            process.join()
        finally:
            _write(path, original)
            self._free.put(root)
        return seen, time.monotonic() - started


def _write(path: pathlib.Path, text: bytes) -> None:
    """Write a module, and remove compiled files that could be used in its place."""
    path.write_bytes(text)
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
        with contextlib.suppress(FileNotFoundError):
            compiled.unlink()


def main() -> None:
    """Plant, run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("paths", nargs="+", type=pathlib.Path, help="modules or folders of modules")
    parser.add_argument("--faults", type=int, default=5, help="maximum number per file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("faults.json"))
    arguments = parser.parse_args()

    files = [
        file.resolve().relative_to(ROOT)
        for path in arguments.paths
        for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
    ]
    outcomes: list[Outcome] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        concurrent.futures.ThreadPoolExecutor(arguments.workers) as pool,
    ):
        copies = Copies(pathlib.Path(folder), arguments.workers)
        tests = {file: tuple(nearest_tests(file)) for file in files}
        of_tests = {tests[file]: file for file in files}
        whole = pool.map(lambda one: copies.run(of_tests[one], None, one, 1200), of_tests)
        without = dict(zip(of_tests, whole, strict=True))
        for chosen, (failed, _) in without.items():
            if failed is not None:
                sys.exit(f"{of_tests[chosen]}: {failed} fails without a fault")
        work = [
            (file, fault)
            for file in files
            for fault in draw(
                faults_of((ROOT / file).read_text()), arguments.faults, f"{arguments.seed} {file}"
            )
        ]

        def outcome(item: tuple[pathlib.Path, Fault]) -> Outcome:
            file, fault = item
            seen, seconds = copies.run(file, fault, tests[file], 60 + 3 * without[tests[file]][1])
            return Outcome(str(file), fault.line, fault.before, fault.after, seen, seconds)

        for number, found in enumerate(pool.map(outcome, work), 1):
            outcomes.append(found)
            arguments.out.write_text(
                json.dumps([dataclasses.asdict(one) for one in outcomes], indent=1) + "\n"
            )
            if found.seen_by is None:
                place = f"{found.file}:{found.line}"
                print(f"{place}: {found.before}  ->  {found.after}", flush=True)
            print(f"{number}/{len(work)}", end="\r", file=sys.stderr, flush=True)
    seen = sum(found.seen_by is not None for found in outcomes)
    print(f"{seen} of {len(outcomes)} faults caught")


if __name__ == "__main__":
    main()
