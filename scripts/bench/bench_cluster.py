"""Compare describing images on a local Ray cluster of one-core nodes with one process.

    python scripts/bench/bench_cluster.py [--out docs/large]
        [--images 5000] [--nodes 2] [--rounds 3] [--weights starter]

Each node is a separate raylet pinned to one core; the single process uses as many cores as there
are nodes. They take turns. Times cover the whole command `crisalad extract`, including start-up;
the cluster is already running. The two files should be bit-identical.
"""

import os
import pathlib
import statistics
import sys
import tempfile

import numpy as np
from tables import Study, Table, count, flags, leave, read
from timing import measured, run_program, times

from crisalad_jax.utils.progress import progress_bar

ROOT = pathlib.Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.conftest import write_picture  # noqa: E402
from tests.ray_nodes import ray_nodes  # noqa: E402

ONE, CLUSTER = "one process", "nodes of Ray"


def main() -> None:
    parser = flags(__doc__ or "", "docs/large")
    parser.add_argument("--images", type=count, default=5000)
    parser.add_argument("--nodes", type=count, default=2)
    parser.add_argument("--rounds", type=count, default=3)
    parser.add_argument("--weights", default="starter")
    arguments = read(parser, "bench_cluster")
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.nodes])
    with tempfile.TemporaryDirectory() as temporary, ray_nodes(arguments.nodes) as nodes:
        folder = pathlib.Path(temporary)
        write_picture(folder / "one" / "0.jpg", 0)
        with progress_bar("pictures", arguments.images, "images", quiet=False) as bar:
            for number in range(arguments.images):
                write_picture(folder / "images" / f"{number:06d}.jpg", number, noise=10)
                bar.advance(1)

        def extract(name: str, *given: str, images: str = "images") -> float:
            for file in folder.glob(f"{name}.npy*"):
                file.unlink()
            command = [sys.executable, "-m", "crisalad_jax", "extract", "--quiet", "--images"]
            command += [str(folder / images), "--weights", arguments.weights]
            command += ["--out", str(folder / f"{name}.npy"), *given]
            return run_program(command, nodes.environment)[0]

        seconds: dict[str, list[float]] = {ONE: [], CLUSTER: []}
        extract(ONE, images="one")  # fills the cache of compiled programs
        for _ in range(arguments.rounds):
            seconds[ONE].append(extract(ONE))
            seconds[CLUSTER].append(extract(CLUSTER, "--cluster", nodes.address))
        one, cluster = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in seconds)
        same = np.array_equal(one, cluster)
    found = [alone / spread for alone, spread in zip(*seconds.values(), strict=True)]
    speed = statistics.median(found), min(found), max(found)
    caption = (
        f"`crisalad extract` of {arguments.images:,} images with `{arguments.weights}`: "
        f"{arguments.nodes} one-core Ray nodes compared with one process on {arguments.nodes} "
        f"cores, start-up included; {measured(arguments.rounds)}."
    )
    rows = [(ONE, "1.00", "-"), (CLUSTER, times(speed), "identical" if same else "different")]
    table = Table(("run in", "speedup", "bits"), rows, caption, 1)
    leave("bench_cluster", Study(table, {"seconds": seconds, "same_bits": same}), arguments)


if __name__ == "__main__":
    main()
