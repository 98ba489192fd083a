"""Compare search with FAISS: exact speed, memory by database size, recall of approximate indexes.

    python scripts/bench/bench_search.py [bench_search] [search_memory] [search_approximate]
        [--out docs/search]
        [--rows 100000] [--lengths 8448 512] [--queries 1000] [--rounds 3]
        [--memory-rows 100000 1000000] [--memory-length 8448] [--dtype float32] [--folder FOLDER]
        [--approximate-rows 100000] [--approximate-length 512]

bench_search: exact search of the 20 nearest neighbours, database and queries in memory, compared
with a flat FAISS index by L2 and by inner product; all on all cores. Descriptors are random unit
vectors, because the cost of an exact search hardly depends on them.

search_memory: exact search in a memory-mapped file of random unit vectors, in a separate process
for each size; its peak memory as Linux reports it, including the interpreter, JAX and its compiler.
A million descriptors of 8,448 dimensions are a file of 33.8 GB in float32, 16.9 GB in bfloat16:
they are written to FOLDER, by default the system's folder for temporary files.

search_approximate: HNSW and IVF-RaBitQ compared with exact search of the same descriptors. These
are views of places along streets, because approximate search relies on clustered neighbours.
"""

import argparse
import contextlib
import json
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any, get_args

import ml_dtypes
import numpy as np
from tables import Study, Table, bars, count, flags, leave, read_some
from timing import Timed, machine, measured, race, ratio, times

# After timing, which says how many devices there are.
import faiss  # isort: skip

from crisalad_jax.retrieval.faiss_index import Index, Kind, build, recall_against_exact
from crisalad_jax.retrieval.search import search
from crisalad_jax.utils.progress import progress_bar

K = 20
QUERIES_IN_MEMORY = 100
VIEWS = 25
"""Number of views of a place, on average."""
SPREAD = 0.4, 1.2
"""Length of a view's own component relative to its place's: minimum and maximum."""
NEXT, STREET = 0.8, 100
"""Inner product of neighbouring places in a street, and the number of places in a street."""
FALL = 0.4
"""Components decay with this power of their index: 0.41 fits 800 photographs of SPED described by
the packaged model, from a line through the logarithms of 255 deviations."""
L2, IP, OURS = "FAISS flat, L2", "FAISS flat, inner product", "crisalad-jax"
DTYPES = {"float32": np.float32, "bfloat16": ml_dtypes.bfloat16}
EFFORTS: dict[str, tuple[int | None, ...]] = {"hnsw": (32, None), "ivf-rabitq": (16, None)}
"""Efforts to try, None for the default; see `Index.search`."""
_PROGRAM = """
import json, pathlib, re, sys
from crisalad_jax.retrieval.descriptor_files import open_npy
from crisalad_jax.utils.compiler import set_up
from crisalad_jax.retrieval.search import search

set_up()
database, queries = map(open_npy, sys.argv[1:3])
search(database, queries, int(sys.argv[3]), quiet=False)
# The value of getrusage starts from the memory of the process that started this one.
status = pathlib.Path("/proc/self/status").read_text(encoding="utf-8")
memory = 1024 * int(re.search(r"VmHWM:\\s*(\\d+) kB", status)[1])
print(json.dumps({"memory": memory}))
"""


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def random_unit(generator: np.random.Generator, rows: int, length: int) -> np.ndarray:
    return unit(generator.standard_normal((rows, length), np.float32))


def faiss_search(index: Any, metric: int, queries: np.ndarray) -> Callable[[], Any]:
    """Make a search by `metric` on the same vectors, because two copies would fill the memory."""

    def call() -> Any:
        index.metric_type = metric
        return index.search(queries, K)

    return call


def compare(length: int, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    generator = np.random.default_rng(0)
    database = random_unit(generator, arguments.rows, length)
    queries = random_unit(generator, arguments.queries, length)
    index = faiss.IndexFlat(length, faiss.METRIC_L2)
    index.add(database)  # pyright: ignore
    contenders = {
        L2: faiss_search(index, faiss.METRIC_L2, queries),
        IP: faiss_search(index, faiss.METRIC_INNER_PRODUCT, queries),
        OURS: lambda: search(database, queries, K),
    }
    found = {name: call() for name, call in contenders.items()}
    exact = found[OURS].indices
    alike = {name: float((found[name][1] == exact).mean()) for name in (L2, IP)} | {OURS: 1.0}
    timed = race(contenders, rounds=arguments.rounds, calls=1)
    return [
        {
            "length": length,
            "contender": name,
            "ms": timed[name].rounds,
            "faster": ratio(timed[L2], timed[name]),
            "alike": alike[name],
        }
        for name in contenders
    ]


def speed(arguments: argparse.Namespace) -> Study:
    values = [value for length in arguments.lengths for value in compare(length, arguments)]
    rows = [
        (
            f"{value['length']:,}",
            value["contender"],
            times(value["faster"]),
            f"{100 * value['alike']:.2f} %",
        )
        for value in values
    ]
    caption = (
        f"Exact search of {K} neighbours of {arguments.queries:,} queries among "
        f"{arguments.rows:,} descriptors in memory; {measured(arguments.rounds)}. Speedup over "
        "FAISS's flat L2 index, and the share of neighbours that have the same rank in ours."
    )
    header = ("length", "program", "speedup", "same rank")
    figure = bars(
        values, lambda value: f"{value['length']:,} numbers", "faster", "times as fast as flat L2"
    )
    return Study(Table(header, rows, caption, 2), values, figure)


def write_descriptors(path: pathlib.Path, rows: int, length: int, dtype: str) -> None:
    """Write random descriptors as a .npy file, in parts."""
    generator = np.random.default_rng(0)
    size = max(1, 2**24 // length)
    with (
        path.open("wb") as file,
        progress_bar(f"writing {path.name}", rows, "rows", quiet=False) as bar,
    ):
        kind = np.dtype(DTYPES[dtype])
        form = {"descr": kind.str, "fortran_order": False, "shape": (rows, length)}
        np.lib.format.write_array_header_1_0(file, form)
        for start in range(0, rows, size):
            part = random_unit(generator, min(size, rows - start), length)
            file.write(part.astype(kind).tobytes())
            bar.advance(len(part))


def grown(rows: int, arguments: argparse.Namespace, folder: pathlib.Path) -> dict[str, Any]:
    """Measure a search in a database of `rows` rows, and remove the database afterwards."""
    length = arguments.memory_length
    database, queries = folder / f"{rows}.npy", folder / "queries.npy"
    try:
        write_descriptors(database, rows, length, arguments.dtype)
        write_descriptors(queries, QUERIES_IN_MEMORY, length, "float32")
        command = [sys.executable, "-c", _PROGRAM, str(database), str(queries), str(K)]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
        return {"rows": rows, "bytes": database.stat().st_size} | json.loads(done.stdout)
    finally:
        database.unlink(missing_ok=True)


def memory(arguments: argparse.Namespace) -> Study:
    with tempfile.TemporaryDirectory(prefix="search-", dir=arguments.folder) as temporary:
        values = [grown(n, arguments, pathlib.Path(temporary)) for n in arguments.memory_rows]
    rows = [
        (
            f"{value['rows']:,}",
            f"{value['bytes'] / 1e9:.2f}",
            f"{value['memory'] / 1e9:.2f}",
        )
        for value in values
    ]
    caption = (
        f"Exact search of {K} neighbours of {QUERIES_IN_MEMORY} queries in a memory-mapped file of "
        f"descriptors of {arguments.memory_length:,} dimensions in {arguments.dtype}: size of the "
        f"file and peak memory of the process, in GB ({machine()})."
    )
    header = ("descriptors", "file", "memory")
    return Study(Table(header, rows, caption, 0), values)


def components(generator: np.random.Generator, rows: int, length: int) -> np.ndarray:
    """Draw random unit vectors whose dimensions decay like principal components."""
    sizes = (np.arange(1, length + 1) ** -FALL).astype(np.float32)
    return unit(generator.standard_normal((rows, length), np.float32) * sizes)


def streets(generator: np.random.Generator, rows: int, length: int) -> np.ndarray:
    """Draw the places for `rows` views, each similar to the previous one in its street."""
    places = components(generator, max(1, rows // VIEWS), length)
    for place in range(1, len(places)):
        if place % STREET:
            places[place] = NEXT * places[place - 1] + (1 - NEXT**2) ** 0.5 * places[place]
    return unit(places)


def views(generator: np.random.Generator, places: np.ndarray, rows: int) -> np.ndarray:
    """Draw views of places: some places have hundreds, most a dozen; some views are outliers."""
    drawn = (generator.random(rows) ** 2 * len(places)).astype(int)
    spread = generator.uniform(*SPREAD, (rows, 1)).astype(np.float32)
    return unit(places[drawn] + spread * components(generator, rows, places.shape[1]))


def among(found: np.ndarray, exact: np.ndarray) -> float:
    """Return the share of the exact neighbours that are anywhere among those found."""
    pairs = zip(exact, found, strict=True)
    return sum(int(np.isin(one, some).sum()) for one, some in pairs) / exact.size


def bytes_of(index: Index) -> int:
    return faiss.serialize_index(index.faiss_index).nbytes  # pyright: ignore


def approximate(arguments: argparse.Namespace) -> Study:
    generator = np.random.default_rng(0)
    count, length = arguments.approximate_rows, arguments.approximate_length
    places = streets(generator, count, length)
    database = views(generator, places, count)
    queries = views(generator, places, arguments.queries)
    contenders: dict[str, Callable[..., Any]] = {"exact": lambda k=K: search(database, queries, k)}
    indexes, built = {}, {}
    for kind in get_args(Kind):
        started = time.perf_counter()
        indexes[kind] = build(kind, database, quiet=False)
        built[kind] = time.perf_counter() - started
        for effort in EFFORTS[kind]:
            name = f"{kind}, {'default' if effort is None else f'effort {effort}'}"
            contenders[name] = lambda k=K, index=indexes[kind], effort=effort: index.search(
                queries, k, effort
            )
    timed = race(contenders, rounds=arguments.rounds, calls=1)
    exact = contenders["exact"]().indices
    values = []
    for name, call in contenders.items():
        kind = name.partition(",")[0]
        index = indexes.get(kind)
        values.append(
            {
                "contender": name,
                "ms": timed[name].rounds,
                "faster": ratio(timed["exact"], timed[name]),
                "recall": recall_against_exact(call().indices, exact),
                "among": among(call(5 * K).indices, exact),
                "build_seconds": built.get(kind, 0.0),
                "build": 1e3 * built.get(kind, 0.0) / Timed(timed["exact"].rounds).median,
                "bytes": database.nbytes if index is None else bytes_of(index),
            }
        )
    rows = [
        (
            value["contender"],
            f"{value['recall']:.4f}",
            f"{value['among']:.4f}",
            times(value["faster"]),
            f"{value['build']:.1f}",
            f"{value['bytes'] / count:,.0f}",
        )
        for value in values
    ]
    caption = (
        f"Search of {K} neighbours of {arguments.queries:,} queries among {count:,} descriptors of "
        f"{length} dimensions, {VIEWS} views per place; {measured(arguments.rounds)}. Recall is "
        "the share of the exact neighbours that were found, and the share that is among the best "
        f"{5 * K}, for exact ranking; building time is relative to the exact search of all queries."
    )
    header = (
        "index",
        "recall",
        f"among {5 * K}",
        "speedup",
        "building",
        "bytes per descriptor",
    )
    return Study(Table(header, rows, caption, 1), values)


STUDIES = {"bench_search": speed, "search_memory": memory, "search_approximate": approximate}


def main() -> None:
    parser = flags(__doc__ or "", "docs/search")
    parser.add_argument("--rows", type=count, default=100_000)
    parser.add_argument("--lengths", type=count, nargs="+", default=[8448, 512])
    parser.add_argument("--queries", type=count, default=1000)
    parser.add_argument("--rounds", type=count, default=3)
    parser.add_argument("--memory-rows", type=count, nargs="+", default=[100_000, 1_000_000])
    parser.add_argument("--memory-length", type=count, default=8448)
    parser.add_argument("--dtype", choices=DTYPES, default="float32")
    parser.add_argument(
        "--folder", type=pathlib.Path, help="folder with space for the largest file"
    )
    parser.add_argument("--approximate-rows", type=count, default=100_000)
    parser.add_argument("--approximate-length", type=count, default=512)
    arguments = read_some(parser, STUDIES)
    if "search_memory" in arguments.studies:
        folder = arguments.folder or pathlib.Path(tempfile.gettempdir())
        size = np.dtype(DTYPES[arguments.dtype]).itemsize * arguments.memory_length
        needed = max(arguments.memory_rows) * size
        with contextlib.suppress(OSError):  # reported when it is written to
            if (free := shutil.disk_usage(folder).free) < needed:
                parser.error(
                    f"{folder}: found {free / 1e9:.1f} GB free, expected {needed / 1e9:.1f} GB"
                )
    for name in arguments.studies:
        leave(name, STUDIES[name](arguments), arguments)


if __name__ == "__main__":
    main()
