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
"""A loaded program: a function that takes arrays, the inputs in order, and returns the output."""


class NotExportableError(InputError):
    """An error for a model that an engine cannot compute as JAX does; retrying does not help."""


class ProgramFormat(NamedTuple):
    """The files of an exported program, and the engine that they are for."""

    engine: EngineName
    suffixes: tuple[str, str]
    """Suffixes of the program file and of the weight file."""
    call: str
    """Python expression that runs a program, with {file!r} in place of its file name."""


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
"""Program formats (keys of `FORMATS`) that each engine reads, its own format first."""
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
    """Import and return OpenVINO without its tools, whose import is slow and sends telemetry."""
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
    """Load a program into an engine that runs it on the CPU.

    Args:
        engine: "onnxruntime" or "openvino".
        path: a .onnx file, or for OpenVINO also a .xml file.
        precision: type of the matrix products; onnxruntime supports only "float32".

    Returns:
        A function that takes the program's inputs in order (numpy arrays) and returns its output.

    Raises:
        InputError: the engine cannot load the file, or does not support the precision.
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
    """Convert an ONNX file to OpenVINO's two files: `out` (.xml), and weights next to it (.bin)."""
    openvino = import_openvino()
    model = openvino.Core().read_model(program)
    # By default the weights are stored in half precision.
    openvino.save_model(model, out, compress_to_fp16=False)
