"""Describe photographs with an ONNX model from `crisalad export`, without JAX or this package.

python examples/export/describe.py EXPORT IMAGE... (needs numpy, onnxruntime and Pillow)
"""

import json
import pathlib
import sys

import numpy as np
import onnxruntime
from PIL import Image, ImageOps

folder, *paths = map(pathlib.Path, sys.argv[1:])
wanted = json.loads((folder / "manifest.json").read_text())["images"]
if "bilinear, antialiased, on bytes" not in wanted["resize"]:
    sys.exit(
        f"{folder}: found images resized {wanted['resize']}, which this example does not support"
    )
_, height, width, _ = wanted["shape"]
session = onnxruntime.InferenceSession(folder / "describe.onnx")
for path in paths:
    image = ImageOps.exif_transpose(Image.open(path)).convert("RGB")
    pixels = np.asarray(image.resize((width, height), Image.Resampling.BILINEAR))
    (descriptors,) = session.run(["descriptors"], {"images": pixels[None]})
    np.save(path.with_suffix(".npy").name, descriptors[0])
