"""Measure what checksums cost: loading weights, and extracting descriptors into files.

    python scripts/bench/bench_checksums.py [--preset b14] [--images 5000] [--rounds 7]

Each round runs both variants in turn; ratios are medians over rounds. Weights: `load` compared with
`load(verify=False)`, and with safetensors' own `load_file` followed by a conversion of each array
to JAX, which is what `load` did before files had checksums. Descriptors: `extract` into a .npy,
which stores its progress in files, hashes everything and can be resumed, compared with the same
call in memory followed by numpy's own writing.
"""

import argparse
import pathlib
import statistics
import tempfile
import time
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from safetensors.numpy import load_file

from crisalad_jax import PRESETS, extract, init_crisalad, load, save_weights
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Model


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--preset", default="b14")
    parser.add_argument("--images", type=int, default=5000)
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        weights = folder / "weights.safetensors"
        config = PRESETS[given.preset]
        save_weights(weights, Model(init_crisalad(jax.random.key(0), config), config))
        size = f"load {given.preset}, {weights.stat().st_size / 1e6:.0f} MB"
        others = {
            "load(verify=False)": lambda: load(weights, verify=False),
            "load_file": lambda: jax.tree.map(jnp.asarray, load_file(weights)),
        }
        for other, plain in others.items():
            ratio(f"{size}, compared with {other}", lambda: load(weights), plain, 3 * given.rounds)
        if given.images:
            extraction(folder, given.images, given.rounds)


def extraction(folder: pathlib.Path, count: int, rounds: int) -> None:
    """Time `extract` with `tiny`: with a larger model, checksums would cost relatively less."""
    images = folder / "images"
    images.mkdir()
    generator = np.random.default_rng(0)
    for number in range(count):
        coarse = generator.uniform(0, 255, (6, 8, 3)).astype(np.float32)
        picture = cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(images / f"{number:05d}.jpg"), np.clip(picture, 0, 255).astype(np.uint8))
    config = PRESETS["tiny"]
    params = init_crisalad(jax.random.key(0), config)

    def plain() -> None:
        done = extract(Model(params, config), images, reading=Reading(quiet=True))
        np.save(folder / "plain.npy", done.descriptors)
        (folder / "plain.txt").write_text("\n".join(done.names))

    ratio(
        f"extract {count} images",
        lambda: extract(
            Model(params, config), images, folder / "d.npy", reading=Reading(quiet=True)
        ),
        plain,
        rounds,
    )


def ratio(what: str, checked: Callable[[], object], plain: Callable[[], object], rounds: int):
    """Print the median, minimum and maximum ratio of two times, each pair run in turn."""
    for call in (checked, plain):
        call()  # compiles, and fills the disk cache
    pairs = []
    for number in range(rounds):
        calls = (checked, plain) if number % 2 else (plain, checked)
        times = {}
        for call in calls:
            start = time.perf_counter()
            call()
            times[call] = time.perf_counter() - start
        pairs.append((times[checked], times[plain]))
    ratios = sorted(a / b for a, b in pairs)
    median = statistics.median(ratios)
    print(
        f"{what}: {median:.3f} times as long with checksums ({ratios[0]:.3f} to {ratios[-1]:.3f}), "
        f"{statistics.median(b for _, b in pairs):.3f} s without"
    )


if __name__ == "__main__":
    main()
