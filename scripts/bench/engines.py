"""The engines beside torch that a user would pick instead, and the machine's rate by any of them.

ONNX Runtime and OpenVINO read the ONNX file that torch writes of a model. Both get as many threads
as there are cores; else they are set as their documents tell who waits for one batch. They need the
`bench` extra. Where it is not installed, and on a GPU, torch is the only peer.
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
"""Rows, width and columns of what tells the machine's rate: square, and `b14`'s widest product."""
logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it tells what torchvision would add


@contextmanager
def onnx_file(model: torch.nn.Module, inputs: torch.Tensor) -> Iterator[pathlib.Path]:
    """An ONNX file of a float32 model for inputs of this shape; weights are beside it."""
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
    """Whether OpenVINO computes in this type: where it cannot, it takes float32 without a word."""
    if not _installed("openvino"):
        return False
    core = import_openvino().Core()
    return dtype == "float32" or "BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")


def packages() -> list[str]:
    """The engines' packages that are here, with what makes their files."""
    return [name for name in ("onnxruntime", "openvino") if _installed(name)]


def _installed(engine: str) -> bool:
    return all(importlib.util.find_spec(name) for name in ("onnx", "onnxscript", engine))


def readers(dtype: str) -> Mapping[str, Callable[[pathlib.Path, np.ndarray], Run]]:
    """What makes each engine ready to run an ONNX file in this type, by the engine's name.

    ONNX Runtime multiplies no bfloat16 numbers on a CPU.
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
    """An engine that is ready."""

    run: Run
    seconds: float
    """How long that took, without the writing of the file."""


def peers(model: Crisalad, images: torch.Tensor, dtype: str) -> dict[str, Peer]:
    """The engines that describe the images with the weights of a reference model, by name."""
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
    """Floating-point operations a second of the fastest product of matrices that any reaches."""
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
