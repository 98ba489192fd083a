"""Quantise matrix products and convolutions to int8, as onnxruntime calibrates them."""

import logging
import pathlib
import shutil
from collections.abc import Sequence

import numpy as np
from onnxruntime import quantization

_OPERATORS = ["MatMul", "Conv"]


class _Images(quantization.CalibrationDataReader):
    """Images one by one, to measure the ranges of activations."""

    def __init__(self, images: np.ndarray) -> None:
        self._images = ({"images": image[None]} for image in images)

    def get_next(self) -> dict[str, np.ndarray] | None:  # type: ignore[override]
        return next(self._images, None)


def quantise(
    program: pathlib.Path, images: np.ndarray, nodes: Sequence[str], *, per_channel: bool
) -> None:
    """Quantise some matrix products and convolutions of a program to int8, in place.

    Args:
        program: the file in float32, for any number of images; its weights are next to it, with
            .data appended.
        images: prepared images (image, height, width, 3) like those that will be described.
        nodes: names of the nodes to quantise, which `write_onnx` returns.
        per_channel: whether each column of weights has its own scale, which is more accurate.
    """
    # The program finds its weights by file name, so the names stay the same.
    whole = program.parent / "float32"
    whole.mkdir()
    for each in (program, program.with_name(f"{program.name}.data")):
        each.rename(whole / each.name)
    # Hide the advice to optimise the program first, which was done when it was made.
    logging.disable(logging.WARNING)
    try:
        quantization.quantize_static(
            whole / program.name,
            program,
            _Images(images),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=_OPERATORS,
            nodes_to_quantize=list(nodes),
            per_channel=per_channel,
            weight_type=quantization.QuantType.QInt8,
            activation_type=quantization.QuantType.QInt8,
            use_external_data_format=True,
            extra_options={
                "MatMulConstBOnly": True,
                # Sums of products are wider than int8, and OpenVINO cannot reshape them in int8.
                "OpTypesToExcludeOutputQuantization": _OPERATORS,
            },
        )
    finally:
        logging.disable(logging.NOTSET)
    shutil.rmtree(whole)
