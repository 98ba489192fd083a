"""Other inference engines that a user might pick, and the machine's best product rate.

ONNX Runtime and OpenVINO read the ONNX file that torch exports. Both get as many threads as there
are cores; their other settings are those that their documentation recommends for latency. They need
the `bench` extra. Without it, and on a GPU, torch is the only peer.
"""

import importlib
import importlib.util
import logging
import pathlib
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from libraries import LIBRARIES
from timing import race, wait
from usual import widened

# After timing, which says how many devices there are.
import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import torch  # isort: skip

from crisalad_jax.checkpoints.engines import import_openvino
from crisalad_jax.utils.host import usable_cores
from parity.reference.model import Crisalad

ORT, OPENVINO = "ONNX Runtime", "OpenVINO"
Run = Callable[[], np.ndarray]
PRODUCTS = ((2048, 2048, 2048), (2056, 768, 3072))
"""Sizes of the products that measure the machine's rate: square, and `b14`'s widest."""
logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it reports what torchvision would add


@contextmanager
def onnx_file(model: torch.nn.Module, inputs: torch.Tensor) -> Iterator[pathlib.Path]:
    """Export a float32 model to an ONNX file for inputs of this shape; weights are next to it."""
    with tempfile.TemporaryDirectory(prefix="bench-onnx-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's exporter, about itself
        path = pathlib.Path(folder) / "model.onnx"
        torch.onnx.export(model, (inputs,), path, input_names=["inputs"], verbose=False)
        yield path


def by_ort(path: pathlib.Path, inputs: np.ndarray) -> Run:
    onnxruntime = importlib.import_module("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = usable_cores()
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    return lambda: session.run(None, {"inputs": inputs})[0]


def by_openvino(path: pathlib.Path, inputs: np.ndarray, dtype: str) -> Run:
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_PRECISION_HINT": {"float32": "f32", "bfloat16": "bf16"}[dtype],
        "INFERENCE_NUM_THREADS": usable_cores(),
    }
    compiled = import_openvino().compile_model(path, "CPU", settings)
    request = compiled.create_infer_request()
    return lambda: request.infer([inputs], share_inputs=True)[0]


def has_openvino(dtype: str) -> bool:
    """Return whether OpenVINO computes in this type; otherwise it silently uses float32."""
    if not _installed("openvino"):
        return False
    core = import_openvino().Core()
    return dtype == "float32" or "BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")


def packages() -> list[str]:
    """List the installed packages of the engines, with those that make their files."""
    return [name for name in ("onnxruntime", "openvino") if _installed(name)]


def _installed(engine: str) -> bool:
    return all(importlib.util.find_spec(name) for name in ("onnx", "onnxscript", engine))


def readers(dtype: str) -> Mapping[str, Callable[[pathlib.Path, np.ndarray], Run]]:
    """Return functions that prepare an ONNX file for each engine in this type, by engine name.

    ONNX Runtime does not support bfloat16 products on a CPU.
    """
    found: dict[str, Callable[[pathlib.Path, np.ndarray], Run]] = {}
    if torch.cuda.is_available():
        return found
    if dtype == "float32" and _installed("onnxruntime"):
        found[ORT] = by_ort
    if has_openvino(dtype):
        found[OPENVINO] = lambda path, inputs: by_openvino(path, inputs, dtype)
    return found


class Peer(NamedTuple):
    """An engine that is ready to run."""

    run: Run
    seconds: float
    """Seconds to prepare it, without exporting the file."""


def peers(model: Crisalad, images: torch.Tensor, dtype: str) -> dict[str, Peer]:
    """Prepare the engines to describe images with the weights of a reference model, by name."""
    found = readers(dtype)
    if not found:
        return {}
    ready = {}
    with onnx_file(widened(model), images) as path:
        for name, read in found.items():
            started = time.perf_counter()
            run = read(path, images.numpy())
            ready[name] = Peer(run, time.perf_counter() - started)
    return ready


def product_rate(dtype: str) -> float:
    """Measure floating-point operations per second of the fastest matrix product of any engine."""
    best = 0.0
    for rows, width, columns in PRODUCTS:
        timed = race(_products(rows, width, columns, dtype), rounds=3, calls=3)
        least = 1e-3 * min(min(one.rounds) for one in timed.values())
        best = max(best, 2 * rows * width * columns / least)
    return best


def _products(rows: int, width: int, columns: int, dtype: str) -> dict[str, Callable[[], Any]]:
    on_gpu = torch.cuda.is_available()
    layer = torch.nn.Linear(width, columns, bias=False).requires_grad_(False)
    inputs = torch.randn(rows, width)
    ours = jnp.asarray(inputs.numpy(), dtype), jnp.asarray(layer.weight.numpy().T, dtype)
    where = {"dtype": getattr(torch, dtype), "device": "cuda" if on_gpu else "cpu"}
    theirs, weight = inputs.to(**where), layer.weight.to(**where)

    def by_torch() -> None:
        torch.nn.functional.linear(theirs, weight)
        wait()

    def by_jax(library: str) -> Run:
        product = jax.jit(
            lambda a, b: jnp.matmul(a, b, preferred_element_type=jnp.float32),
            compiler_options=LIBRARIES[library],
        )
        return lambda: jax.block_until_ready(product(*ours))

    found: dict[str, Callable[[], Any]] = {"torch": by_torch}
    found |= {f"jax, {library}": by_jax(library) for library in LIBRARIES}
    if readers(dtype):
        with onnx_file(layer, inputs) as path:
            found |= {name: read(path, inputs.numpy()) for name, read in readers(dtype).items()}
    return found
