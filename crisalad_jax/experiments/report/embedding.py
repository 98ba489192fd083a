"""Pictures embedded in a page: drawings as PNG, the many photographs as WebP."""

import base64
import pathlib
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from crisalad_jax.experiments.report.style import dark_path

_WEBP_QUALITY = 78


class Drawing(NamedTuple):
    """A PNG file beside the page, and its copy in the page as a data URI."""

    file: str
    uri: str
    width: int
    height: int
    alt: str
    dark: str | None = None
    """The data URI of its variant for a dark ground; None where there is none."""


def drawing(path: pathlib.Path, alt: str) -> Drawing:
    """Read a PNG for a page; its sides are in its first chunk (W3C PNG specification, 11.2.2)."""
    data = path.read_bytes()
    width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    dark = dark_path(path)
    other = _uri("png", dark.read_bytes()) if dark.exists() else None
    return Drawing(path.name, _uri("png", data), width, height, alt, other)


def webp(image: UInt8[np.ndarray, "h w 3"]) -> str:
    """Encode RGB pixels as a data URI of a few kilobytes."""
    _, data = cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])
    return _uri("webp", data.tobytes())


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
