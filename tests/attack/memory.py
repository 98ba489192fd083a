"""What grows: resident memory over steps of training and over queries, and the compile cache.

python -m tests.attack.memory --out rows.json [--scale 1] [--seed 0] [--only training ...]
"""

import dataclasses
import functools
import gc
import json
import pathlib
import resource
import sys
from collections.abc import Callable, Mapping

import numpy as np

from crisalad_jax.data.reading import Reading
from tests.attack.kills import recipe_of_chains
from tests.attack.world import Attack, Bench, Row, arguments, carry_out, files_in, forked, part_of

MOST = 20
"""Growth of resident memory in megabytes that passes as none."""
OF_A_SAVE = 0.2
"""Megabytes a saved state: tensorstore's Spec.to_json (0.1.86) keeps some kilobytes of each array,
which makes 0.1 MB of a state here."""


def resident() -> float:
    """Return the resident memory of this process in megabytes."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def growth(
    bench: Bench,
    attack: str,
    work: Callable[[dict[int, float]], None],
    first: int,
    last: int,
    most: float = MOST,
) -> Row:
    """Judge what a function, in a fork, measures at numbers of steps or queries.

    Args:
        bench: says what was measured.
        attack: the row.
        work: does the steps, and puts the memory after some of them into a dictionary.
        first: number from which on memory is not to grow.
        last: number of the last one.
        most: megabytes that pass as no growth.
    """

    def measure() -> int:
        sizes: dict[int, float] = {}
        work(sizes)
        print(json.dumps(sizes))
        return 0

    promise = f"resident memory after {first:,} and after {last:,} differs by less than {most:g} MB"
    row = Row(attack, promise)
    done = forked(measure, cwd=bench.folder, limit=3600)
    if done.code:
        row.note(False, f"exit code {done.code}: {done.err[-300:]}")
        return row
    sizes = {int(number): size for number, size in json.loads(done.out).items()}
    early = min(number for number in sizes if number >= first)
    grown = sizes[max(sizes)] - sizes[early]
    told = ", ".join(f"{number}: {size:.1f} MB" for number, size in sorted(sizes.items()))
    row.promise += f" (here {grown:+.1f} MB)"
    row.note(grown < most, f"{grown:+.1f} MB ({told})")
    bench.say(f"{row.attack}: {told}")
    return row


def attack_training(bench: Bench, scale: float) -> list[Row]:
    """Take many steps in one process; then save and validate after each epoch."""
    recipe = recipe_of_chains(bench.folder)

    def train(sizes: dict[int, float], last: int, often: bool) -> None:
        import crisalad_jax.training.run_files
        from crisalad_jax.config.io import read_config
        from crisalad_jax.data.benchmarks import open_benchmark
        from crisalad_jax.data.places import read_places
        from crisalad_jax.training.config import TrainConfig
        from crisalad_jax.training.loop import fit
        from crisalad_jax.training.run_files import RunFiles

        if often:
            crisalad_jax.training.run_files.SAVE_SECONDS = -1.0
        config = dataclasses.replace(
            read_config(TrainConfig, recipe), epochs=-(-last // 2), save_top_k=1
        )
        real = RunFiles.log

        def log(self: RunFiles, values: Mapping[str, int | float], **more: str) -> None:
            real(self, values, **more)
            step = int(values["step"])
            if step % max(last // 12, 1) == 0:
                sizes[step] = resident()

        RunFiles.log = log
        fit(
            config,
            read_places(bench.world.path("city"), min_images=2),
            bench.folder / f"run of {last} steps, often: {often}",
            validation=open_benchmark(bench.world.path("town")) if often else None,
            quiet=True,
        )

    rows = []
    for kind, first, last, often in (
        ("steps", 500, 3000, False),
        # Until some hundred saves, memory that compiling took is given back.
        ("steps with saves and validations", 300, 600, True),
    ):
        first, last = part_of(first, scale), part_of(last, scale)
        most = OF_A_SAVE * (last - first) if often else MOST
        work = functools.partial(train, last=last, often=often)
        rows.append(growth(bench, f"memory of training: {kind}", work, first, last, most))
    return rows


def attack_queries(bench: Bench, scale: float) -> list[Row]:
    """Search an open map, and describe and search images, many times."""
    folder = bench.world.path("map")

    def ask(sizes: dict[int, float], last: int, with_images: bool) -> None:
        from crisalad_jax.retrieval.maps.map import Map
        from crisalad_jax.retrieval.maps.query import query

        image = next(path for path in bench.world.path("images").rglob("*.jpg"))
        with Map.open(folder) as places:
            model = places.load_model()
            rows = np.concatenate(list(places.descriptors))
            for number in range(1, last + 1):
                if with_images:
                    query(places, [image], model=model, k=3, reading=Reading(quiet=True))
                else:
                    places.search(rows[:1], 3)
                if number % max(last // 10, 1) == 0:
                    gc.collect()
                    sizes[number] = resident()

    rows = []
    for kind, count, images in (("searches", 10_000, False), ("queries by images", 2_000, True)):
        first, last = part_of(count // 10, scale), part_of(count, scale)
        attack = f"memory of an open map: {kind}"
        work = functools.partial(ask, last=last, with_images=images)
        rows.append(growth(bench, attack, work, first, last))
    return rows


def attack_cache(bench: Bench, _: float) -> list[Row]:
    """Run commands twice as programs of their own, with a compile cache that keeps all programs.

    By default it keeps those that took half a second to compile, which differs with the load.
    """
    row = Row("growth of the compile cache", "the second run of a command adds no file to it")
    cache = bench.folder / "cache"
    environment = {**bench.environment, "JAX_COMPILATION_CACHE_DIR": str(cache)}
    apart = dataclasses.replace(bench, environment=environment)
    for name in ("info", "query", "train"):
        listed = []
        for turn in range(2):
            out = bench.folder / "cached" / f"{name} {turn}"
            out.mkdir(parents=True)
            program = apart.program(arguments(name, bench.world, out))
            _, err = program.communicate()
            assert program.returncode == 0, err
            listed.append(files_in(cache))
        new = sorted(listed[1] - listed[0])
        row.note(not new, f"{name}: {len(new)} of {len(listed[1])} files are new, {new[:3]}")
    return [row]


ATTACKS: Mapping[str, Attack] = {
    "training": attack_training,
    "queries": attack_queries,
    "cache": attack_cache,
}

if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, __doc__))
