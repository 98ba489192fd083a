"""Build, index and query a map of a million synthetic descriptors, compared with plain FAISS.

    python scripts/bench/bench_million.py [--out docs/large]
        [--rows 1000000] [--length 512] [--dtype float16] [--searches ivf-rabitq] [--queries 100]
        [--rounds 3] [--folder FOLDER]

Descriptors are views of places along streets (`bench_search.views`), appended to a map stored in
files, 4,096 at a time. Neighbours fade into those of the next places, places have from a dozen to
hundreds of views, and the dimensions of a descriptor decay like the principal components of
photographs.

Ours is what `crisalad index --search` and `crisalad query` do: build an index from the files, take
candidates from it, and rank them by the descriptors in the files. FAISS searches its flat index,
with all descriptors in memory in float32; and the same index as ours, without re-ranking its
answers. All take turns, with one query and with all. Recall is the share of the exact 10 nearest
neighbours. Memory is how much a process grows when it opens an index.
"""

import argparse
import concurrent.futures
import contextlib
import multiprocessing
import pathlib
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from bench_search import VIEWS, streets, views
from tables import Study, Table, count, flags, leave, read
from timing import measured, race, ratio, times

# After timing, which says how many devices there are.
import faiss  # isort: skip

from crisalad_jax.config.io import to_plain
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.faiss_index import load_index, recall_against_exact
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import MapMetadata
from crisalad_jax.utils.progress import progress_bar

K = 10
TOGETHER = 4096
SPAWN = multiprocessing.get_context("spawn")
SEARCHES = ("hnsw", "ivf-rabitq")
FILES, FLAT = "exact, of files", "exact, FAISS in memory"
HEADER = (
    "search",
    "building",
    "memory",
    "recall",
    "one query, speedup over exact in files",
    "one query, speedup over exact in memory",
    "all queries, speedup over exact in memory",
)


def parts(rows: int, length: int) -> Iterator[np.ndarray]:
    """Yield the descriptors, a few thousand at a time; every call yields the same."""
    generator = np.random.default_rng(0)
    places = streets(generator, rows, length)
    for start in range(0, rows, TOGETHER):
        yield views(generator, places, min(TOGETHER, rows - start))


def questions(rows: int, length: int, number: int) -> np.ndarray:
    """Draw other views of the places, as queries."""
    return views(np.random.default_rng(1), streets(np.random.default_rng(0), rows, length), number)


def make(folder: pathlib.Path, arguments: argparse.Namespace) -> float:
    """Append all descriptors to a map, and return the seconds this took."""
    metadata = MapMetadata(
        model="0" * 64,
        weights="none",
        config=to_plain(ModelConfig()),
        descriptor_length=arguments.length,
        dtype=arguments.dtype,
    )
    started = time.perf_counter()
    with (
        open_for_appending(folder, metadata) as target,
        progress_bar("appending", arguments.rows, "rows", quiet=False) as bar,
    ):
        for part in parts(arguments.rows, arguments.length):
            names = [f"{len(target) + i}.jpg" for i in range(len(part))]
            target.append(names, [1] * len(part), part, root="/images")
            bar.advance(len(part))
    return time.perf_counter() - started


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    pages = pathlib.Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]
    return 4096 * int(pages)


def memory_of(file: pathlib.Path) -> int:
    """Measure how much a process grows when it opens an index.

    It runs in a fresh process: the one that built the index has free memory left over.
    """
    before = resident()
    index = load_index(file, verify=False)
    assert index.size
    return resident() - before


def study(arguments: argparse.Namespace, folder: pathlib.Path) -> Study:
    rows, length = arguments.rows, arguments.length
    seconds = make(folder, arguments)
    queries = questions(rows, length, arguments.queries)
    places = Map.open(folder, verify=False)
    calls: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        FILES: lambda asked: places.search(asked, K, exact=True).indices
    }
    values: dict[str, dict[str, Any]] = {FILES: {}}
    for kind in arguments.searches:
        started = time.perf_counter()
        with open_for_appending(folder, places.metadata) as target:
            target.build_search(kind, quiet=False)
        built = time.perf_counter() - started
        (file,) = (folder / "approximate").glob("*.index")
        with concurrent.futures.ProcessPoolExecutor(1, SPAWN) as other:
            grown = other.submit(memory_of, file).result()
        index = load_index(file, verify=False)
        opened = Map.open(folder, verify=False)
        alone = f"{kind}, FAISS alone"
        calls[kind] = lambda asked, opened=opened: opened.search(asked, K).indices
        calls[alone] = lambda asked, index=index: index.search(asked, K).indices
        values[kind] = {"bytes": file.stat().st_size, "memory": grown, "build_seconds": built}
        values[alone] = {}
    flat: Any = faiss.IndexFlatIP(length)
    before = resident()
    for part in parts(rows, length):
        flat.add(part)
    calls[FLAT] = lambda asked: flat.search(asked, K)[1]
    values[FLAT] = {"memory": resident() - before}
    exact = calls[FILES](queries)
    for name, asked in (("one", queries[:1]), ("all", queries)):
        contenders = {who: lambda call=call: call(asked) for who, call in calls.items()}  # noqa: B023
        timed = race(contenders, rounds=arguments.rounds, calls=1)
        for who, value in values.items():
            value[name] = ratio(timed[FLAT], timed[who])
            value[f"{name}_of_files"] = ratio(timed[FILES], timed[who])
            value[f"{name}_ms"] = timed[who].rounds
    for who, value in values.items():
        value["recall"] = recall_against_exact(calls[who](queries), exact)
    size = sum(path.stat().st_size for path in (folder / "segments").iterdir())
    table = [
        (
            who,
            f"{value['build_seconds'] / 60:.1f} min" if "build_seconds" in value else "-",
            f"{value['memory'] / 1e6:,.0f} MB" if "memory" in value else "-",
            f"{value['recall']:.4f}",
            times(value["one_of_files"]),
            times(value["one"]),
            times(value["all"]),
        )
        for who, value in values.items()
    ]
    caption = (
        f"A map of {rows:,} descriptors of {length} dimensions in {arguments.dtype} "
        f"({size / 1e9:.2f} GB of files, {VIEWS} views per place), searched for the {K} nearest "
        f"neighbours of one query and of {arguments.queries}; {measured(arguments.rounds)}. "
        "Speedups are over our exact search in the files, and over FAISS's exact search in memory "
        "in float32."
    )
    found = {"rows": rows, "append_seconds": seconds, "segments": size, "searches": values}
    return Study(Table(HEADER, table, caption, 1), found)


def main() -> None:
    parser = flags(__doc__ or "", "docs/large")
    parser.add_argument("--rows", type=count, default=1_000_000)
    parser.add_argument("--length", type=count, default=512)
    parser.add_argument("--dtype", choices=("float32", "float16"), default="float16")
    parser.add_argument("--searches", nargs="*", choices=SEARCHES, default=["ivf-rabitq"])
    parser.add_argument("--queries", type=count, default=100)
    parser.add_argument("--rounds", type=count, default=3)
    parser.add_argument("--folder", type=pathlib.Path, help="folder with space for the map")
    arguments = read(parser, "bench_million")
    folder = arguments.folder or pathlib.Path(tempfile.gettempdir())
    needed = 8 * arguments.length * arguments.rows
    with contextlib.suppress(OSError):  # reported when it is written to
        if (free := shutil.disk_usage(folder).free) < needed:
            parser.error(
                f"{folder}: found {free / 1e9:.1f} GB free, expected {needed / 1e9:.1f} GB"
            )
    with tempfile.TemporaryDirectory(prefix="million-", dir=folder) as temporary:
        leave("bench_million", study(arguments, pathlib.Path(temporary) / "map"), arguments)


if __name__ == "__main__":
    main()
