"""Describe a folder of images with the output of `crisalad export`, without crisalad_jax.

    python scripts/run_exported.py EXPORT --images FOLDER --out descriptors.npy [--batch-size 16]

The export must have the format stablehlo. It needs jax, flatbuffers, numpy, Pillow, and safetensors
if the weights are in a separate file next to the program. Row i of the array belongs to the image
in line i of the file of names next to it (.names.txt). Everything else is read from
EXPORT/manifest.json: copy from here what your own program needs.
"""

import argparse
import hashlib
import json
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import jax.export
import numpy as np
import PIL.Image
import PIL.ImageOps

FILTERS = {
    "bilinear": PIL.Image.Resampling.BILINEAR,
    "bicubic": PIL.Image.Resampling.BICUBIC,
}
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")


def read_whole(folder: pathlib.Path, entry: dict[str, Any]) -> bytes:
    """Read a file of the export, and check it against its manifest entry."""
    data = (folder / entry["file"]).read_bytes()
    if hashlib.sha256(data).hexdigest() != entry["sha256"]:
        raise SystemExit(f"{folder / entry['file']}: found other bytes than manifest.json says")
    return data


def read_manifest(folder: pathlib.Path) -> dict[str, Any]:
    """Read the manifest; its checksum covers its bytes with zeros in place of the checksum."""
    path = folder / "manifest.json"
    data = path.read_bytes()
    manifest = json.loads(data)
    digest = manifest.pop("checksum")
    zeros = data.replace(digest.encode(), b"0" * 64, 1)
    if hashlib.sha256(zeros).hexdigest() != digest:
        raise SystemExit(f"{path}: found other bytes than were written")
    if manifest["program_format"] != "stablehlo":
        raise SystemExit(
            f"{path}: found a program of {manifest['program_format']}, expected stablehlo; call: "
            f"{manifest['call']}"
        )
    return manifest


def load(folder: pathlib.Path, manifest: dict[str, Any]) -> Callable[[np.ndarray], np.ndarray]:
    """Load the function from images (batch, height, width, 3) to descriptors."""
    program = jax.export.deserialize(bytearray(read_whole(folder, manifest["program"])))
    if manifest["weights"] is None:
        return lambda images: np.asarray(program.call(images))
    import safetensors.numpy

    weights = safetensors.numpy.load(read_whole(folder, manifest["weights"]))
    weights = jax.device_put(weights)
    return lambda images: np.asarray(program.call(weights, images))


def read_image(path: pathlib.Path, manifest: dict[str, Any]) -> np.ndarray:
    """Read upright RGB pixels, resized and, if floats, normalised as the manifest says."""
    how, wanted = manifest["model"]["preprocessing"], manifest["images"]
    if how["filter"] not in FILTERS or not how["antialias"] or how["bit_depth"] != "high-byte":
        raise SystemExit(f"found images resized {wanted['resize']}, which Pillow cannot do")
    with PIL.Image.open(path) as image:
        pixels = np.asarray(PIL.ImageOps.exif_transpose(image).convert("RGB"))
    if how["pixels"] == "floats":
        pixels = pixels.astype(np.float32)
    pixels = resize(pixels, tuple(manifest["model"]["image_size"]), FILTERS[how["filter"]])
    # A model that rounds sides to multiples of its patches resizes once more.
    pixels = resize(pixels, tuple(wanted["shape"][1:3]), FILTERS["bilinear"])
    if wanted["dtype"] == "uint8":
        return pixels
    return ((pixels / np.float32(255) - wanted["mean"]) / wanted["deviation"]).astype(np.float32)


def resize(pixels: np.ndarray, size: tuple[int, int], resample: Any) -> np.ndarray:
    """Resize pixels (height, width, 3): bytes together, floats channel by channel."""
    height, width = size
    if pixels.shape[:2] == size:
        return pixels
    if pixels.dtype == np.uint8:
        return np.asarray(PIL.Image.fromarray(pixels).resize((width, height), resample))
    channels = (PIL.Image.fromarray(channel) for channel in np.moveaxis(pixels, -1, 0))
    return np.stack([np.asarray(each.resize((width, height), resample)) for each in channels], -1)


def batches(
    paths: list[pathlib.Path], manifest: dict[str, Any], batch_size: int
) -> Iterator[tuple[np.ndarray, int]]:
    """Yield batches of images, and how many of each batch are not padding."""
    fixed = manifest["images"]["shape"][0]
    size = fixed if isinstance(fixed, int) else batch_size
    if size == fixed and manifest["grouping"] == "batch" and len(paths) % size:
        raise SystemExit(
            f"found {len(paths)} images, expected a multiple of {size}: this program takes that "
            "many at a time, and they attend to each other"
        )
    for start in range(0, len(paths), size):
        images = np.stack([read_image(p, manifest) for p in paths[start : start + size]])
        count = len(images)
        if size == fixed:
            images = np.resize(images, (size, *images.shape[1:]))
        yield images, count


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("export", type=pathlib.Path)
    parser.add_argument("--images", type=pathlib.Path, required=True)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--batch-size", type=int, default=16)
    given = parser.parse_args()

    manifest = read_manifest(given.export)
    files = {p.relative_to(given.images).as_posix(): p for p in given.images.rglob("[!.]*")}
    names = sorted(name for name in files if name.lower().endswith(SUFFIXES))
    if not names:
        raise SystemExit(f"{given.images}: found no image")
    paths = [files[name] for name in names]
    describe = load(given.export, manifest)
    parts = [describe(images)[:n] for images, n in batches(paths, manifest, given.batch_size)]
    np.save(given.out, np.concatenate(parts))
    listed = "".join(f"{name}\n" for name in names)
    given.out.with_suffix(".names.txt").write_text(listed, encoding="utf-8")
    print(f"{given.out}: {len(names)} descriptors of {parts[0].shape[1]} dimensions")


if __name__ == "__main__":
    main()
