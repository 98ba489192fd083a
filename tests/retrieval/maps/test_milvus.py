"""Milvus as a server: filters, its indices, restarts and kills.

Filters have the syntax of Python too, whose `eval` is the reference. Of servers from 2.6 on there
is a fake client, which records what it is asked for.
"""

import datetime
import itertools
import pathlib
import subprocess
import sys
import threading
import time
import types
from typing import Any

import numpy as np
import pymilvus
import pytest

from crisalad_jax.retrieval.maps import milvus_store
from crisalad_jax.retrieval.maps.appending import open_for_appending
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.milvus_filter import among, columns_of, condition_of, left_in
from crisalad_jax.retrieval.maps.milvus_store import MilvusStore, choose_kind
from crisalad_jax.retrieval.maps.removed import NONE, Removed
from crisalad_jax.retrieval.maps.where import Where
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests import killed_appends
from tests.killed_appends import LENGTH, metadata, names, rows
from tests.retrieval.maps.milvus_server import ADDRESS

SERVER = f"milvus:{ADDRESS}"
ROOT = pathlib.Path(__file__).parents[3]


# Filters


def chosen(condition: str, count: int) -> list[int]:
    code = compile(condition, "filter", "eval")
    return [n for n in range(count) if eval(code, {"id": n})]


@pytest.mark.parametrize("seed", range(20))
def test_a_filter_is_of_the_numbers_that_are_left(seed):
    generator = np.random.default_rng(seed)
    count = int(generator.integers(1, 400))
    # In runs of about ten, and of one.
    is_gone = np.repeat(generator.random(count) < 0.5, 10)[:count] ^ (generator.random(count) < 0.1)
    gone, left = np.flatnonzero(is_gone), np.flatnonzero(~is_gone)
    assert chosen(left_in(count, Removed(gone)), count + 5) == left.tolist()
    if len(left):
        assert chosen(among(left), count) == left.tolist()


def test_an_addition_is_one_range_whatever_its_size():
    assert among(np.arange(1000, 2_000_000)) == "(id >= 1000 and id <= 1999999)"
    assert left_in(10**7, Removed(np.arange(5, 10**6))).count("id") == 3


def test_a_filter_has_few_ranges_each_below_few_brackets():
    """Milvus 2.3.5 parses a row of 60 alternatives for minutes, and refuses brackets 100 deep."""
    numbers = np.flatnonzero(np.arange(300) % 5 > 0)
    text = among(numbers)
    assert (text.count("id >="), text.count("id in")) == (16, 1)
    depths = itertools.accumulate((c == "(") - (c == ")") for c in text)
    assert max(depths) <= 6
    assert chosen(text, 300) == numbers.tolist()


NAMES = [
    "monday/1.png",
    "monday/deep/2.png",
    "monday#t=3.000",
    "mondays/4.png",
    "monday/1700000000.500000.png",
    'mon"day\\%_~/6.png',
    "mon\udce9/7.png",
    "montag/ä/8.png",
]
AT = [None, (0.0, 0.0), (1.5, -2.25), (1e-9, 3.0), (179.0, 1.0), (-179.0, 1.0), (5.0, 1.0), None]


def images(added: str | None, axes: tuple[str, str] = ("x", "y")) -> list[dict[str, Any]]:
    record = {"names": NAMES, "added": added, "axes": axes, "positions": AT}
    columns = columns_of(record)
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def found(where: str, **options: Any) -> list[int]:
    texts = condition_of(Where.parse(where))
    fields = images(**{"added": None} | options)
    return [n for n, row in enumerate(fields) if all(eval(text, dict(row)) for text in texts)]


@pytest.mark.parametrize(
    ("where", "numbers"),
    [
        ("folder=monday", [0, 1, 2, 4]),
        ("folder=monday/", [0, 1, 2, 4]),
        ("folder=mon*", list(range(8))),
        ("folder=monday*", [0, 1, 2, 3, 4]),
        ("folder=montag/ä", [7]),
        ('folder=mon"day\\%_~', [5]),
        ("folder=monday/deep*", [1]),
        ("folder=mon\udce9", [6]),
        ("folder=tuesday", []),
        ("time>=2023-11-14", [4]),  # 1,700,000,000 is 22:13:20 of that day
        ("time<2023-11-14", []),
        ("time<2030-01-01", [4]),
        ("box=0,-3,2,4", [1, 2, 3]),
        ("box=1.5,-2.25,1.5,-2.25", [2]),  # its ends count
        ("box=1,-3,2,4, folder=monday", [2]),
    ],
)
def test_conditions_take_what_they_say(where, numbers):
    assert found(where) == numbers


def test_conditions_are_of_the_time_of_the_addition():
    day = datetime.date(2026, 5, 1)
    assert found(f"added={day}", added="2026-05-01T23:59:59+00:00") == list(range(8))
    assert found(f"added={day}", added="2026-05-02T00:00:00+00:00") == []
    assert found(f"added<={day}") == []


def test_a_box_is_of_east_and_north_in_degrees_too():
    """Positions in degrees are latitude and longitude; a box may lie over the antimeridian."""
    at = [each and each[::-1] for each in AT]
    record = {"names": NAMES, "added": None, "axes": ("lat", "lon"), "positions": at}
    columns = columns_of(record)
    fields = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    assert fields == images(None)
    text = " and ".join(condition_of(Where.parse("box=170,0,-170,2")))
    assert [n for n, row in enumerate(fields) if eval(text, dict(row))] == [4, 5]


# Indices


@pytest.mark.parametrize(
    ("count", "version", "kind"),
    [
        (50_000, (2, 6, 1), "exact"),
        (50_001, (2, 3, 5), "hnsw"),
        (2**23, (2, 6, 1), "hnsw"),  # 16 GiB of 512 float32
        (2**23 + 1, (2, 6, 1), "ivf-rabitq"),
        (2**23 + 1, (2, 5, 9), "diskann"),
        (10**8, (0,), "hnsw"),  # milvus-lite has neither
    ],
)
def test_the_index_is_chosen_by_size_and_version(count, version, kind):
    assert choose_kind(count, 512, version) == kind


@pytest.mark.parametrize("store", ["milvus:rows.db", pytest.param(SERVER, marks=pytest.mark.slow)])
def test_an_index_serves_what_is_added_later(store, tmp_path, request):
    """Its answers are exact here: 128 candidates are more than there are descriptors."""
    if store == SERVER:
        request.getfixturevalue("milvus_server")
    made = metadata(store, f"crisalad_index{int(time.time())}")
    with open_for_appending(tmp_path, made) as target:
        target.append(names(0, 60), [7] * 60, rows(0, 60), root="/images")
        assert target.build_search("hnsw") == 1
        target.append(names(60, 40), [7] * 40, rows(60, 40), root="/images")
        target.change("remove", removed=range(10, 15))
    everything = np.delete(rows(0, 100), range(10, 15), axis=0)
    queries = rows(1000, 3)
    expected = np.argsort(-queries @ everything.T, axis=1)[:, :7]
    with Map.open(tmp_path) as places:
        assert places.search_kind == "hnsw"
        for exact in (False, True):
            answers = places.search(queries, 7, exact=exact)
            np.testing.assert_array_equal(answers.indices, expected)
            # Sums of 48 products of float32 below one, in whatever order.
            similarities = np.take_along_axis(queries @ everything.T, expected, axis=1)
            np.testing.assert_allclose(answers.similarities, similarities, atol=2e-6, rtol=0)
        assert len(places.search(queries, 95).indices[0]) == 95
    with open_for_appending(tmp_path, made) as target:
        with pytest.raises(InputError, match=r"found 'ivf-rabitq', expected one of"):
            target._segments.store.build("ivf-rabitq", 100)
        assert target.build_search("exact") is None
    with Map.open(tmp_path) as places:
        assert places.search_kind == "exact"
        np.testing.assert_array_equal(places.search(queries, 7).indices, expected)


class Fake:
    """A client that records what it is asked for, as pymilvus' would ask a server."""

    version = "v2.6.1"

    def __init__(self, failures: tuple[pymilvus.MilvusException, ...] = ()) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.failures = list(failures)

    def get_server_version(self, **_: Any) -> str:
        return self.version

    def _get_connection(self) -> Any:
        return types.SimpleNamespace(alloc_timestamp=lambda timeout: 17)

    prepare_index_params = staticmethod(pymilvus.MilvusClient.prepare_index_params)
    create_schema = staticmethod(pymilvus.MilvusClient.create_schema)

    def close(self) -> None:
        pass

    def __getattr__(self, method: str) -> Any:
        def call(_collection: str, **options: Any) -> Any:
            self.asked.append((method, options))
            if self.failures:
                raise self.failures.pop(0)
            if method == "describe_index":
                return {"state": "Finished", "indexed_rows": 9, "pending_index_rows": 0}
            return [[{"id": 1, "distance": 0.5}]] if method == "search" else []

        return call

    def last(self, method: str) -> dict[str, Any]:
        return next(options for name, options in reversed(self.asked) if name == method)


def faked(monkeypatch, client: Fake) -> MilvusStore:
    monkeypatch.setattr(pymilvus, "MilvusClient", lambda *_, **__: client)
    return MilvusStore(ADDRESS, "rows", 512, new=True)


def test_a_server_of_2_6_has_codes_of_bits(monkeypatch):
    client = Fake()
    store = faked(monkeypatch, client)
    with pytest.warns(Note, match="--search auto takes ivf-rabitq: 100000000 descriptors of 512"):
        store.build("auto", 10**8)
    (index,) = client.last("create_index")["index_params"]
    assert index.get_index_configs() == {
        "index_type": "IVF_RABITQ",
        "metric_type": "IP",
        **{"nlist": 1024, "refine": True, "refine_type": "SQ8"},
    }
    store.ask(np.ones((1, 512), np.float32), 3, 5, NONE)
    asked = client.last("search")
    assert asked["search_params"]["params"] == {"nprobe": 64, "refine_k": 4}
    assert (asked["limit"], asked["guarantee_timestamp"]) == (3, 17)
    order = [name for name, _ in client.asked]
    steps = ["flush", "release_collection", "drop_index", "create_index", "load_collection"]
    assert [name for name in order[order.index("flush") :] if name in steps] == steps


# Waiting


GONE = pymilvus.MilvusException(2, "Fail connecting to server")
REFUSED = pymilvus.MilvusException(1100, "cannot parse expression")


def test_a_server_that_comes_back_is_waited_for(monkeypatch):
    client = Fake()
    store = faked(monkeypatch, client)
    client.failures = [GONE, GONE]
    with pytest.warns(Note, match=r"Milvus says Fail connecting .*; waiting for up to 120 s"):
        store.add(0, np.ones((1, 512), np.float32), {"names": ["a.png"]})
    assert [name for name, _ in client.asked].count("upsert") == 3
    assert all(options["timeout"] > 0 for _, options in client.asked)


@pytest.mark.filterwarnings("ignore::crisalad_jax.utils.output.Note")
@pytest.mark.parametrize(
    ("failure", "words"),
    [
        (GONE, r"says: Fail connecting to server \(while adding descriptors from 7 on\)$"),
        (REFUSED, r"says: cannot parse expression \(while adding descriptors from 7 on\)$"),
    ],
)
def test_one_that_does_not_is_one_line(monkeypatch, failure, words):
    store = faked(monkeypatch, client := Fake())
    monkeypatch.setattr(milvus_store, "_ANSWER", 0.1)
    client.failures = [failure] * 99
    with pytest.raises(InputError, match=words):
        store.add(7, np.ones((1, 512), np.float32), {"names": ["a.png"]})


# Kills of a real server, and of its writers


def killed(how: str, folder: pathlib.Path, kills: int, longest: float) -> str:
    program = [sys.executable, "-m", "tests.killed_appends", how, folder, SERVER, kills, longest]
    done = subprocess.run(list(map(str, program)), cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_writer_that_is_killed_loses_nothing(milvus_server, tmp_path):
    assert killed("random", tmp_path, kills=8, longest=8.0) == "8\n"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crisalad_jax.utils.output.Note")
def test_a_server_that_is_killed_loses_nothing(milvus_server, tmp_path):
    """It is killed in the middle of appends, which wait for it; all that counted is found once."""
    total, kills = 400, 3
    work = lambda: killed_appends.append_until(tmp_path, total, SERVER)  # noqa: E731
    writer = threading.Thread(target=work)
    writer.start()
    for number in range(kills):
        before = number * total // (kills + 1)
        while counted(tmp_path) <= before:
            time.sleep(0.05)
        milvus_server.kill()
        milvus_server.start()
    writer.join(600)
    assert killed_appends.check(tmp_path) == total
    with Map.open(tmp_path) as places:
        found = places.search(rows(0, total), 2)
        np.testing.assert_array_equal(found.indices[:, 0], np.arange(total))
        assert (found.indices[:, 1] != np.arange(total)).all()  # none twice
        (answer,) = places._segments.store._fetch(
            "counting", "query", "id >= 0", output_fields=["count(*)"]
        )
    assert answer["count(*)"] == total
    assert LENGTH == 48


def counted(folder: pathlib.Path) -> int:
    records = sorted((folder / "segments").glob("[0-9]*.json"))
    return int(records[-1].stem) if records else 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crisalad_jax.utils.output.Note")
def test_a_server_that_stands_still_is_one_line(milvus_server, tmp_path, monkeypatch):
    made = metadata(SERVER, "crisalad_still")
    with open_for_appending(tmp_path, made) as target:
        target.append(names(0, 5), [7] * 5, rows(0, 5), root="/images")
        target.search(rows(0, 1), 1)
        monkeypatch.setattr(milvus_store, "_ANSWER", 3.0)
        milvus_server.kill(19)  # SIGSTOP
        try:
            with pytest.raises(InputError, match=r"19530: Milvus says: .*\(while searching\)$"):
                target.search(rows(0, 1), 1)
        finally:  # one that stood still for long ends by itself
            milvus_server.kill()
            milvus_server.start()
            milvus_server.wait()
