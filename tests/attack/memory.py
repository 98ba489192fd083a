"""What grows: resident memory over steps of training and over queries, and the compile cache.

python -m tests.attack.memory --out rows.json [--scale 1] [--seed 0] [--only training ...]
"""

import dataclasses
import gc
import json
import pathlib
import resource
import shutil
import sys
from collections.abc import Callable, Mapping

import numpy as np

from crisalad_jax.data.reading import Reading
from tests.attack.kills import Bench, carry_out, part_of, recipe_of_chains
from tests.attack.world import VERBS, Row, files_in, forked, make_products

MOST = 20
"""Growth of resident memory in megabytes that passes as none."""
OF_A_SAVE = 0.2
"""Megabytes a saved state: tensorstore's Spec.to_json (0.1.86) keeps some kilobytes of each array,
which makes 0.1 MB of a state here."""


def resident() -> float:
    """Return the resident memory of this process in megabytes."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def _row_of_growth(attack: str, first: int, last: int, most: float = MOST) -> Row:
    words = f"resident memory after {first:,} and after {last:,} differs by less than {most:g} MB"
    return Row(attack, words)


def attack_training(bench: Bench, scale: float) -> list[Row]:
    """Take many steps in one process; then save and validate after each epoch."""
    recipe = recipe_of_chains(bench.folder)
    rows = []
    for kind, steps in (("steps", 3000), ("steps with saves and validations", 600)):
        often = kind != "steps"
        # Until some hundred saves, memory that compiling took is given back.
        first = part_of(steps // 2 if often else steps // 6, scale)
        last = part_of(steps, scale)
        most = OF_A_SAVE * (last - first) if often else MOST

        def work(last: int = last, often: bool = often, kind: str = kind) -> int:
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
            sizes: dict[int, float] = {}
            real = RunFiles.log

            def log(self: RunFiles, values: Mapping[str, int | float], **more: str) -> None:
                real(self, values, **more)
                step = int(values["step"])
                if step % max(last // 12, 1) == 0:
                    sizes[step] = resident()

            RunFiles.log = log
            fit(
                config,
                read_places(bench.world.city, min_images=2),
                bench.folder / f"run of {kind}",
                validation=open_benchmark(bench.world.town) if often else None,
                quiet=True,
            )
            print(json.dumps(sizes))
            return 0

        row = _row_of_growth(f"memory of training: {kind}", first, last, most)
        done = forked(work, cwd=bench.folder, limit=3600)
        _note(bench, row, done.code, done.out, done.err, first, most)
        rows.append(row)
    return rows


def _note(
    bench: Bench, row: Row, code: int, out: str, err: str, first: int, most: float = MOST
) -> None:
    """Judge sizes by number of steps or queries: the first late enough, and the last."""
    if code:
        row.note(False, f"exit code {code}: {err[-300:]}")
        return
    sizes = {int(number): size for number, size in json.loads(out).items()}
    early = min(number for number in sizes if number >= first)
    growth = sizes[max(sizes)] - sizes[early]
    told = ", ".join(f"{number}: {size:.1f} MB" for number, size in sorted(sizes.items()))
    row.promise += f" (here {growth:+.1f} MB)"
    row.note(growth < most, f"{growth:+.1f} MB ({told})")
    bench.say(f"{row.attack}: {told}")


def _make_products(bench: Bench) -> None:
    if not (bench.world.root / "products").exists():
        make_products(bench.world)


def attack_queries(bench: Bench, scale: float) -> list[Row]:
    """Search an open map, and describe and search images, many times."""
    _make_products(bench)
    rows = []
    for kind, count in (("searches", 10_000), ("queries by images", 2_000)):
        first, last = part_of(count // 10, scale), part_of(count, scale)

        def work(last: int = last, kind: str = kind) -> int:
            from crisalad_jax.retrieval.maps.map import Map
            from crisalad_jax.retrieval.maps.query import query

            sizes = {}
            image = next(path for path in bench.world.images.rglob("*.jpg"))
            with Map.open(bench.world.path("map")) as places:
                model = places.load_model()
                rows = np.concatenate(list(places.descriptors))
                for number in range(1, last + 1):
                    if kind == "searches":
                        places.search(rows[:1], 3)
                    else:
                        query(places, [image], model=model, k=3, reading=Reading(quiet=True))
                    if number % max(last // 10, 1) == 0:
                        gc.collect()
                        sizes[number] = resident()
            print(json.dumps(sizes))
            return 0

        row = _row_of_growth(f"memory of an open map: {kind}", first, last)
        done = forked(work, cwd=bench.folder, limit=3600)
        _note(bench, row, done.code, done.out, done.err, first)
        rows.append(row)
    return rows


def attack_cache(bench: Bench, _: float) -> list[Row]:
    """Run commands twice as programs of their own, with a compile cache that keeps all programs.

    By default it keeps those that took half a second to compile, which differs with the load.
    """
    _make_products(bench)
    row = Row("growth of the compile cache", "the second run of a command adds no file to it")
    cache = bench.folder / "cache"
    environment = {**bench.environment, "JAX_COMPILATION_CACHE_DIR": str(cache)}
    quick = dataclasses.replace(bench, environment=environment)
    for name in ("info", "query", "train"):
        listed = []
        for turn in range(2):
            out = bench.folder / "cached" / f"{name} {turn}"
            out.mkdir(parents=True)
            program = quick.program(VERBS[name](bench.world, out))
            _, err = program.communicate()
            assert program.returncode == 0, err
            listed.append(files_in(cache) if cache.exists() else set())
        new = listed[1] - listed[0]
        size = sum(path.stat().st_size for path in cache.rglob("*") if path.is_file())
        row.note(
            not new, f"{name}: {len(new)} of {len(listed[1])} files are new, {sorted(new)[:3]}"
        )
        bench.say(f"compile cache after {name}: {len(listed[1])} files, {size / 2**20:.1f} MB")
    shutil.rmtree(cache, ignore_errors=True)
    return [row]


ATTACKS: Mapping[str, Callable[[Bench, float], list[Row]]] = {
    "training": attack_training,
    "queries": attack_queries,
    "cache": attack_cache,
}

if __name__ == "__main__":
    sys.exit(carry_out(ATTACKS, (__doc__ or "").splitlines()[0]))
