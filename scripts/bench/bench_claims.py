"""Measure the images per second of published models relative to MegaLoc, on one device.

    python scripts/bench/bench_claims.py [--out docs/claims] [--batch 16] [--rounds 5]

It times the models of `docs/claims/claims.toml` with random weights, because the time does not
depend on the weights. Images have the size that the model is published for; products are in
bfloat16. Every round times all models once, MegaLoc first; the reported ratio is the median of the
ratios of each round. The timed function is `describe`, from pixels on the device to descriptors,
with independent images and no second stage.
"""

import argparse
import dataclasses
import json
import pathlib
import statistics
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp

from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import describe, init_crisalad
from tests.checkpoints.test_published import inferred

REFERENCE = "megaloc"
CLAIMS = pathlib.Path(__file__).parents[2] / "docs" / "claims" / "claims.toml"
SHOWN = "docs/claims"


def published() -> dict[str, ModelConfig]:
    """Collect the model configurations: each architecture once, under its first name."""
    rows = tomllib.loads(CLAIMS.read_text(encoding="utf-8"))["row"]
    names = dict.fromkeys([REFERENCE, *(row["models"][0] for row in rows if "models" in row)])
    return {name: inferred(name)[1] for name in names}


def program(config: ModelConfig, batch: int):
    """Make a call that describes a batch and waits for the result."""
    config = dataclasses.replace(config, compute_dtype="bfloat16")
    params = jax.jit(lambda: init_crisalad(jax.random.key(0), config))()
    images = jnp.zeros((batch, *config.image_size, 3), jnp.uint8)
    alone = jnp.eye(batch, dtype=bool)
    run = jax.jit(lambda params, images: describe(params, images, config, mask=alone))
    compiled = run.lower(params, images).compile()
    return lambda: jax.block_until_ready(compiled(params, images))


def seconds(call, calls: int) -> float:
    """Return the median seconds of `calls` calls."""
    call()
    times = []
    for _ in range(calls):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path(SHOWN))
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--calls", type=int, default=10)
    arguments = parser.parse_args()
    configs = published()
    with ThreadPoolExecutor(8) as pool:
        made = pool.map(
            lambda config: program(config, arguments.batch), dict.fromkeys(configs.values())
        )
    programs = dict(zip(dict.fromkeys(configs.values()), made, strict=True))
    print(f"compiled {len(programs)} programs", flush=True)
    rounds = []
    for _ in range(arguments.rounds):
        timed = {config: seconds(call, arguments.calls) for config, call in programs.items()}
        rounds.append({name: timed[config] for name, config in configs.items()})
    shares = {name: [each[REFERENCE] / each[name] for each in rounds] for name in configs}
    device = jax.devices()[0]
    found = {
        "device": device.device_kind,
        "jax": jax.__version__,
        "batch": arguments.batch,
        "images_per_second": {
            name: arguments.batch / statistics.median(each[name] for each in rounds)
            for name in configs
        },
        "times_megaloc": {name: statistics.median(values) for name, values in shares.items()},
        "range": {name: [min(values), max(values)] for name, values in shares.items()},
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "speed.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
