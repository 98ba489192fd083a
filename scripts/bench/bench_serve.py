"""Measure `crisalad serve` under concurrent clients: latency, throughput and lost requests.

    python scripts/bench/bench_serve.py MAP IMAGES [--out docs/serve]
        [--clients 1 8 32] [--seconds 20]

The service is a separate process. Each client has one connection and posts one image after
another, as fast as it gets answers. Latency is what the client waits, including its own work. Every
answer is compared with that of `crisalad query`: the same names, and similarities within 5e-6,
because batches of other sizes round differently.
"""

import contextlib
import http.client
import itertools
import json
import pathlib
import subprocess
import sys
import threading
import time
import urllib.parse
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from tables import Study, Table, count, flags, leave, read
from timing import machine

from crisalad_jax.data.reading import Reading
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.retrieval.maps.query import answer_fields, query

K = 5
ROUNDING = 5e-6


class Load(NamedTuple):
    """The results of some concurrent clients."""

    clients: int
    seconds: float
    latencies: list[float]
    """Latencies of the answers, in ms."""
    lost: int
    """Requests without an answer."""
    others: int
    """Answers that differ from those of `crisalad query`."""

    @property
    def rate(self) -> float:
        """Return answers per second."""
        return len(self.latencies) / self.seconds


def expected_answers(folder: pathlib.Path, images: pathlib.Path) -> dict[pathlib.Path, Any]:
    """Return the answers of `crisalad query` for each image."""
    with Map.open(folder) as places:
        answers = query(places, images, k=K, reading=Reading(quiet=True))
    return {
        path: [answer_fields(answer, answers.axes) for answer in row]
        for path, row in answers.rows()
    }


@contextlib.contextmanager
def served(folder: pathlib.Path) -> Iterator[str]:
    """Run the service, and yield its address once it answers."""
    command = [sys.executable, "-m", "crisalad_jax", "serve", "--map", str(folder), "--port", "0"]
    with subprocess.Popen([*command, "--quiet"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            raise SystemExit("bench_serve: the service did not start")
        try:
            yield line.split(": ")[0]
        finally:
            process.terminate()


def is_same(found: Any, expected: Any) -> bool:
    return [each["name"] for each in found] == [each["name"] for each in expected] and np.allclose(
        [each["similarity"] for each in found],
        [each["similarity"] for each in expected],
        rtol=0,
        atol=ROUNDING,
    )


def load(address: str, clients: int, seconds: float, expected: dict[pathlib.Path, Any]) -> Load:
    """Run clients until the time is over; requests under way are still answered."""
    place = urllib.parse.urlsplit(address)
    bodies = [(path.read_bytes(), answer) for path, answer in expected.items()]
    latencies: list[float] = []
    wrong: list[str] = []
    start = threading.Barrier(clients + 1)
    end = threading.Event()

    def client(number: int) -> None:
        connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=60)
        first = number * len(bodies) // clients
        start.wait()
        for data, answer in itertools.islice(itertools.cycle(bodies), first, None):
            if end.is_set():
                break
            began = time.perf_counter()
            try:
                connection.request("POST", f"/locate?k={K}", data)
                reply = connection.getresponse()
                found = json.loads(reply.read())
                if reply.status != 200:
                    raise http.client.HTTPException(found["error"])
                latencies.append(1e3 * (time.perf_counter() - began))
                if not is_same(found["neighbours"], answer):
                    wrong.append("other")
            except (OSError, http.client.HTTPException):
                wrong.append("lost")
                connection.close()
        connection.close()

    threads = [threading.Thread(target=client, args=(number,)) for number in range(clients)]
    for thread in threads:
        thread.start()
    start.wait()
    began = time.perf_counter()
    time.sleep(seconds)
    end.set()
    for thread in threads:
        thread.join()
    took = time.perf_counter() - began
    return Load(clients, took, latencies, wrong.count("lost"), wrong.count("other"))


def table(loads: list[Load], folder: pathlib.Path) -> Table:
    with Map.open(folder) as places:
        config, images = places.config, len(places)
        what = f"a map of {images} images, {config.descriptor_dim} dimensions each"
        size = f"images at {config.images_in_words}"
    caption = (
        f"Concurrent clients, each sending one request after another for {loads[0].seconds:.0f} s; "
        f"{what}; {size}. Clients and service share the machine: {machine()}. Unlike query: other "
        f"names, or a similarity that differs by more than {ROUNDING:g}."
    )
    header = ("clients", "answers", "lost", "unlike query", "answers / s")
    rows = []
    for each in loads:
        quantiles = np.percentile(each.latencies, (50, 95, 99))
        numbers = (each.clients, len(each.latencies), each.lost, each.others, f"{each.rate:.0f}")
        rows.append((*map(str, numbers), *(f"{value:.0f} ms" for value in quantiles)))
    return Table((*header, "median", "95 %", "99 %"), rows, caption, labels=0)


def main() -> None:
    parser = flags("Measure crisalad serve under load, and count lost requests.", "docs/serve")
    parser.add_argument("map", type=pathlib.Path)
    parser.add_argument("images", type=pathlib.Path)
    parser.add_argument("--clients", type=count, nargs="+", default=[1, 8, 32])
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = read(parser, "bench_serve")
    expected = expected_answers(arguments.map, arguments.images)
    with served(arguments.map) as address:
        load(address, 1, 1.0, expected)  # warms connections and caches
        loads = [load(address, one, arguments.seconds, expected) for one in arguments.clients]
    values = [
        {"clients": each.clients, "seconds": each.seconds, "answers": len(each.latencies)}
        | {"lost": each.lost, "others": each.others, "rate": each.rate}
        | {f"p{q}": float(np.percentile(each.latencies, q)) for q in (50, 95, 99)}
        for each in loads
    ]
    leave("bench_serve", Study(table(loads, arguments.map), values), arguments)


if __name__ == "__main__":
    main()
