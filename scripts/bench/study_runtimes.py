"""Measure recall of one model with each runtime, in float32 and lower precision.

    python scripts/bench/study_runtimes.py --weights FILE --data SET... --int8 PHOTOGRAPHS

Images are described independently.
"""

import dataclasses
import pathlib
import sys
import tempfile
from collections.abc import Iterator

import numpy as np
from tables import Study, Table, flags, leave, read

from crisalad_jax.checkpoints.engines import EngineName
from crisalad_jax.checkpoints.export import ExportConfig, write_export
from crisalad_jax.checkpoints.runtime import Runtime, open_runtime
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.export import read_calibration
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.benchmarks import Benchmark, open_benchmark
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.extract import extract

KS = (1, 5, 10)
ENGINES: tuple[tuple[EngineName, ExportConfig], ...] = (
    ("onnxruntime", ExportConfig(format="onnx")),
    ("openvino", ExportConfig(format="openvino")),
)


def models(
    weights: pathlib.Path, photographs: pathlib.Path, folder: pathlib.Path
) -> Iterator[tuple[str, Model | Runtime]]:
    """Yield the model in each runtime with its name in the table; JAX in float32 comes first."""
    model = load_weights(weights)
    yield "JAX, float32", model
    bfloat16 = dataclasses.replace(model.config, compute_dtype="bfloat16")
    yield "JAX, bfloat16", model._replace(config=bfloat16)
    some = read_calibration(photographs, model.config)
    for engine, how in ENGINES:
        format = how.format
        write_export(folder / format, model, how)
        write_export(folder / f"{format}-int8", model, how, calibration=some)
        yield f"{engine}, float32", open_runtime(folder / format, engine)
        yield f"{engine}, int8", open_runtime(folder / f"{format}-int8", engine)
    yield "openvino, bfloat16", open_runtime(folder / "openvino", "openvino", to_plain(bfloat16))


def first_answers(model: Model | Runtime, data: Benchmark) -> np.ndarray:
    """Return the indices of the images most similar to each query, best first."""
    there, asked = (
        np.asarray(extract(model, paths, reading=Reading(quiet=True)).descriptors)
        for paths in (data.database, data.queries)
    )
    return np.argsort(-(asked @ there.T), axis=1, kind="stable")[:, : max(KS)]


def recalls(answers: np.ndarray, data: Benchmark) -> list[float]:
    """Return the share of queries with a positive that have one among their first answers."""
    right = [(a, set(p)) for a, p in zip(answers, data.ground_truth(), strict=True) if len(p)]
    return [100 * float(np.mean([not p.isdisjoint(a[:k]) for a, p in right])) for k in KS]


def main() -> None:
    parser = flags((__doc__ or "").splitlines()[0], "docs/export")
    parser.add_argument("--weights", type=pathlib.Path, required=True)
    parser.add_argument("--data", type=pathlib.Path, nargs="+", required=True)
    parser.add_argument("--int8", type=pathlib.Path, required=True)
    given = read(parser, "runtimes")
    sets = [open_benchmark(path) for path in given.data]
    header = ["runtime"]
    for data in sets:
        header += [f"{data.name}: R@1 / 5 / 10", "same"]
    rows = []
    exact: list[np.ndarray] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, model in models(given.weights, given.int8, pathlib.Path(folder)):
            answers = [first_answers(model, data) for data in sets]
            exact = exact or answers
            cells = [name]
            for found, first, data in zip(answers, exact, sets, strict=True):
                cells.append(" / ".join(f"{each:.1f}" for each in recalls(found, data)))
                cells.append(f"{int((found[:, 0] == first[:, 0]).sum())} of {len(found)}")
            rows.append(tuple(cells))
            print(*cells, sep="  ", file=sys.stderr, flush=True)
    caption = "Same: the queries whose first answer is the same as with JAX in float32."
    leave("runtimes", Study(Table(tuple(header), rows, caption), rows), given)


if __name__ == "__main__":
    main()
