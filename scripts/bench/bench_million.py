"""A map of a million synthetic descriptors: made, indexed and asked, beside plain FAISS.

    python scripts/bench/bench_million.py [--out docs/large] [--page docs/large.md]
        [--rows 1000000] [--length 512] [--dtype float16] [--searches ivf-pq] [--queries 100]
        [--rounds 3] [--folder FOLDER] [--build]

Descriptors are 25 views each of many places, appended to a map of files 4,096 at a time. Ours is
what `crisalad index --search` and `crisalad query` do: build an index from the files, take
candidates from it, and rank them by the descriptors in the files. Plain FAISS has all of them in
memory in float32, in its flat index, and the same index as ours, asked by its own calls. With
--build it builds that itself, of the same kind and sizes, which is timed too. Latency is that of
one query, and of all at once; they take turns. Recall is the share of the exact 10 nearest. Memory
is the most that the program had when our part was done, before FAISS's began.
"""

import argparse
import contextlib
import pathlib
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from bench_search import VIEWS, random_unit, views
from tables import Study, Table, count, flags, leave, read
from timing import measured, race, ratio, times

# After timing, which says how many devices there are.
import faiss  # isort: skip

from crisalad_jax.config.io import to_plain
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.faiss_index import recall_against_exact
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.metadata import MapMetadata
from crisalad_jax.utils.progress import progress_bar

K = 10
TOGETHER = 4096
SEARCHES = ("hnsw", "ivf-pq")
HEADER = (
    "search",
    "building",
    "index",
    "memory",
    "recall",
    "FAISS's recall",
    "one query",
    "all queries",
)


def parts(rows: int, length: int) -> Iterator[np.ndarray]:
    """The descriptors, some thousand at a time; the same at every call."""
    generator = np.random.default_rng(0)
    centres = random_unit(generator, max(1, rows // VIEWS), length)
    for start in range(0, rows, TOGETHER):
        yield views(generator, centres, min(TOGETHER, rows - start))


def questions(rows: int, length: int, number: int) -> np.ndarray:
    """Other views of the places."""
    centres = random_unit(np.random.default_rng(0), max(1, rows // VIEWS), length)
    return views(np.random.default_rng(1), centres, number)


def make(folder: pathlib.Path, arguments: argparse.Namespace) -> float:
    """Append all descriptors to a map; the seconds that this took."""
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


def memory() -> int:
    """The most memory that this program had, in bytes."""
    status = pathlib.Path("/proc/self/status").read_text(encoding="utf-8")
    found = re.search(r"VmHWM:\s*(\d+) kB", status)
    return 1024 * int(found[1]) if found else 0


def plain(kind: str, ours: Any, database: np.ndarray) -> Any:
    """FAISS's own index of the same kind and sizes as ours."""
    length = database.shape[1]
    if kind == "hnsw":
        index: Any = faiss.IndexHNSWFlat(length, 32, faiss.METRIC_INNER_PRODUCT)
        index.hnsw.efConstruction = ours.hnsw.efConstruction
        index.hnsw.efSearch = 128
    else:
        index = faiss.IndexIVFPQ(
            faiss.IndexFlatIP(length),
            length,
            ours.nlist,
            ours.pq.M,
            8,
            faiss.METRIC_INNER_PRODUCT,
        )
        index.cp.spherical = True
        index.nprobe = -(-ours.nlist // 16)
        drawn = np.random.default_rng(0).choice(len(database), 78 * ours.nlist)
        index.train(database[np.sort(drawn)])
    index.add(database)
    return index


def study(arguments: argparse.Namespace, folder: pathlib.Path) -> Study:
    rows, length = arguments.rows, arguments.length
    seconds = make(folder, arguments)
    queries = questions(rows, length, arguments.queries)
    values: list[dict[str, Any]] = []
    calls: dict[str, dict[str, Callable[[np.ndarray], Any]]] = {}
    places = Map.open(folder)
    calls["exact"] = {"ours": lambda asked: places.search(asked, K, exact=True).indices}
    exact = calls["exact"]["ours"](queries)
    values.append({"search": "exact", "bytes": 0, "memory": memory(), "recall": 1.0})
    indexes = {}
    for kind in arguments.searches:
        started = time.perf_counter()
        with open_for_appending(folder, places.metadata) as target:
            target.build_search(kind, quiet=False)
        built = time.perf_counter() - started
        opened = Map.open(folder)
        (file,) = (folder / "approximate").glob("*.index")
        indexes[kind] = faiss.read_index(str(file))
        calls[kind] = {"ours": lambda asked, opened=opened: opened.search(asked, K).indices}
        values.append(
            {
                "search": kind,
                "build_seconds": built,
                "bytes": file.stat().st_size,
                "memory": memory(),
                "recall": recall_against_exact(calls[kind]["ours"](queries), exact),
            }
        )
    database = np.concatenate(list(parts(rows, length))).astype(np.float32)
    flat: Any = faiss.IndexFlatIP(length)
    flat.add(database)
    calls["exact"]["FAISS"] = lambda asked: flat.search(asked, K)[1]
    for kind in arguments.searches:
        index = indexes.pop(kind)
        if arguments.build:
            started = time.perf_counter()
            index = plain(kind, index, database)
            value = next(value for value in values if value["search"] == kind)
            value["build"] = (time.perf_counter() - started) / value["build_seconds"]
        elif kind == "hnsw":
            index.hnsw.efSearch = 128
        else:
            index.nprobe = -(-index.nlist // 16)
        calls[kind]["FAISS"] = lambda asked, index=index: index.search(asked, K)[1]
    for value in values:
        pair = calls[value["search"]]
        value["plain_recall"] = recall_against_exact(pair["FAISS"](queries), exact)
        for name, asked in (("one", queries[:1]), ("all", queries)):
            contenders = {who: lambda call=call: call(asked) for who, call in pair.items()}  # noqa: B023
            timed = race(contenders, rounds=arguments.rounds, calls=1)
            value[name] = ratio(timed["FAISS"], timed["ours"])
            value[f"{name}_ms"] = {who: timed[who].rounds for who in pair}
    size = sum(path.stat().st_size for path in (folder / "segments").iterdir())
    table = [
        (
            value["search"],
            f"{value['build']:.2f}" if "build" in value else "none",
            f"{value['bytes'] / 1e9:.2f}" if value["bytes"] else "-",
            f"{value['memory'] / 1e9:.2f}",
            f"{value['recall']:.4f}",
            f"{value['plain_recall']:.4f}",
            times(value["one"]),
            times(value["all"]),
        )
        for value in values
    ]
    header = HEADER
    if not arguments.build:
        header, table = (HEADER[0], *HEADER[2:]), [(row[0], *row[2:]) for row in table]
    caption = (
        f"A map of {rows:,} descriptors of {length} numbers in {arguments.dtype} "
        f"({size / 1e9:.2f} GB of files, {VIEWS} views of a place), asked for {K} neighbours of "
        f"one query and of {arguments.queries}; {measured(arguments.rounds)}. Building and "
        "queries are times as fast as plain FAISS, which has all descriptors in memory in float32. "
        "Index, and the most memory of ours, in GB."
    )
    found = {"rows": rows, "append_seconds": seconds, "segments": size, "searches": values}
    return Study(Table(header, table, caption, 1), found)


def main() -> None:
    parser = flags(__doc__ or "", "docs/large")
    parser.add_argument("--rows", type=count, default=1_000_000)
    parser.add_argument("--length", type=count, default=512)
    parser.add_argument("--dtype", choices=("float32", "float16"), default="float16")
    parser.add_argument("--searches", nargs="*", choices=SEARCHES, default=["ivf-pq"])
    parser.add_argument("--queries", type=count, default=100)
    parser.add_argument("--rounds", type=count, default=3)
    parser.add_argument("--build", action="store_true", help="build FAISS's own index too")
    parser.add_argument("--folder", type=pathlib.Path, help="with room for the map")
    arguments = read(parser, "bench_million")
    folder = arguments.folder or pathlib.Path(tempfile.gettempdir())
    needed = 8 * arguments.length * arguments.rows
    with contextlib.suppress(OSError):  # said when it is written to
        if (free := shutil.disk_usage(folder).free) < needed:
            parser.error(
                f"{folder}: found {free / 1e9:.1f} GB free, expected {needed / 1e9:.1f} GB"
            )
    with tempfile.TemporaryDirectory(prefix="million-", dir=folder) as temporary:
        leave("bench_million", study(arguments, pathlib.Path(temporary) / "map"), arguments)


if __name__ == "__main__":
    main()
