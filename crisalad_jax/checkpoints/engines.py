"""Engines that run exported programs: onnxruntime and OpenVINO. Nothing here needs jax."""

import importlib
import pathlib
import sys
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.output import warn

EngineName = Literal["onnxruntime", "openvino"]
Precision = Literal["float32", "bfloat16"]
Program = Callable[..., np.ndarray]
"""A loaded program: a function from its inputs, in order, to its output."""


class NotExportableError(InputError):
    """A model that an engine cannot compute as JAX does; trying again would fail the same way."""


class ProgramFormat(NamedTuple):
    """The files of an exported program, and the engine that they are for."""

    engine: EngineName
    suffixes: tuple[str, str]
    """Suffixes of a program and of its weights."""
    call: str
    """How to run a program, with {file} for its file."""


FORMATS: Mapping[str, ProgramFormat] = {
    "onnx": ProgramFormat(
        "onnxruntime",
        (".onnx", ".onnx.data"),
        "onnxruntime.InferenceSession({file!r}).run(None, {{'images': images}})",
    ),
    "openvino": ProgramFormat(
        "openvino", (".xml", ".bin"), "openvino.Core().compile_model({file!r}, 'CPU')(images)"
    ),
}
READS: Mapping[str, tuple[str, ...]] = {"onnxruntime": ("onnx",), "openvino": ("openvino", "onnx")}
"""Formats that each engine reads, its own first."""
_TOOLS = "openvino.tools.ovc"
_CAPABILITIES = "OPTIMIZATION_CAPABILITIES"


def _onnxruntime(path: pathlib.Path, precision: Precision) -> Program:
    import onnxruntime

    if precision != "float32":
        raise InputError(f"compute dtype: found {precision} with onnxruntime, expected float32")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # By default it uses all of the machine's cores, even if this process may use fewer.
    options.intra_op_num_threads = usable_cores()
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [each.name for each in session.get_inputs()]
    return lambda *inputs: np.asarray(session.run(None, dict(zip(names, inputs, strict=True)))[0])


def import_openvino() -> Any:
    """Import OpenVINO without its tools, whose import takes time and sends telemetry."""
    is_first = "openvino" not in sys.modules
    if is_first:
        sys.modules[_TOOLS] = None  # type: ignore[assignment]
    try:
        return importlib.import_module("openvino")
    finally:
        if is_first:
            del sys.modules[_TOOLS]


def _openvino(path: pathlib.Path, precision: Precision) -> Program:
    openvino = import_openvino()
    # By default it computes in lower precision if the processor supports that.
    hint = {"float32": "f32", "bfloat16": "bf16"}[precision]
    core = openvino.Core()
    if precision == "bfloat16" and "BF16" not in core.get_property("CPU", _CAPABILITIES):
        warn("openvino: found a processor without bfloat16 instructions; it computes in float32")
    compiled = core.compile_model(path, "CPU", {"INFERENCE_PRECISION_HINT": hint})
    return lambda *inputs: np.array(compiled(list(inputs))[0])


def load_program(
    engine: EngineName, path: pathlib.Path, precision: Precision = "float32"
) -> Program:
    """Load a program into an engine, on the CPU.

    Args:
        engine: name of the engine.
        path: a .onnx file, or OpenVINO's .xml; OpenVINO reads both.
        precision: type of the matrix products; onnxruntime has only float32.

    Returns:
        A function of the program's inputs.

    Raises:
        InputError: the engine cannot read the file.
        ModuleNotFoundError: the engine is not installed.
    """
    load = {"onnxruntime": _onnxruntime, "openvino": _openvino}[engine]
    try:
        return load(path, precision)
    except (ModuleNotFoundError, InputError):
        raise
    except Exception as error:  # each engine raises its own errors, and others too
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: {engine} cannot load it: {reason}") from error


def convert_to_openvino(program: pathlib.Path, out: pathlib.Path) -> None:
    """Convert an ONNX program to OpenVINO's two files, `out` and its weights (.bin)."""
    openvino = import_openvino()
    model = openvino.Core().read_model(program)
    # By default the weights are stored in half precision.
    openvino.save_model(model, out, compress_to_fp16=False)
