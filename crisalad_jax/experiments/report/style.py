"""The one layout of all figures, and how they are written and embedded in pages.

They are drawn with matplotlib's object interface: no display, and no state outside the call.
"""

import base64
import contextlib
import io
import os
import pathlib
import warnings
from collections.abc import Iterator
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text as Label

from crisalad_jax.utils.files import atomic_path
from crisalad_jax.utils.output import printable

INK = "#222222"
GREY = "#757575"
PALE = "#e4e4e4"
RIGHT = "#2a8f3c"
WRONG = "#c62828"
UNMATCHED = "#7b1fa2"
PLAIN = "#c4c4c4"
"""Of images that are neither, as the database's on a map."""
# Okabe and Ito's colours, which the colour-blind can tell apart; without yellow, too light for
# lines.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_WIDE, _DPI = 7.0, 120
_NARROW, _NARROW_DPI = 4.0, 200
"""Width in inches, and dots an inch: letters of 9 points are then readable on a telephone."""
_WEBP_QUALITY = 78


class Picture(Figure):
    """A figure that notebooks show by itself, without pyplot and its state."""

    def _repr_jpeg_(self) -> bytes:
        """Return the figure for IPython's display; photographs as a PNG fill a notebook."""
        data = io.BytesIO()
        with _any_names(self):
            self.savefig(data, format="jpg", facecolor="white", pil_kwargs={"quality": 88})
        return data.getvalue()


def new_figure(height: float, title: str = "", *, wide: bool = False) -> Picture:
    """Make a figure of this height in inches: for a page that telephones show too, or `wide`."""
    # Inches around everything, so that no name touches the edge.
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1)
    width, dpi = (_WIDE, _DPI) if wide else (_NARROW, _NARROW_DPI)
    figure = Picture(figsize=(width, height), dpi=dpi, layout=layout)
    if title:
        fit_width(figure.suptitle(title, fontsize=12, color=INK, x=0.02, ha="left"), figure)
    return figure


def label_axes(
    axes: Axes, x: str, y: str, *, grid: Literal["x", "y", "both"] = "y", title: str = ""
) -> None:
    """Style axes: names, left and bottom spines, and pale grid lines across or along."""
    axes.set_xlabel(x, fontsize=10, color=INK)
    axes.set_ylabel(y, fontsize=10, color=INK)
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    axes.tick_params(colors=GREY, labelcolor=INK, labelsize=9)
    axes.grid(axis=grid, color=PALE, linewidth=0.8)
    axes.set_axisbelow(True)


def legend_above(figure: Figure) -> None:
    """Name what is drawn above the axes, in two columns if the names are short enough."""
    names = [name for axes in figure.axes for name in axes.get_legend_handles_labels()[1]]
    room = figure.get_figwidth() / 2 - 0.6  # inches; a letter of 9 points is 0.08 wide
    columns = 2 if max(map(len, names)) * 0.08 <= room else 1
    where = {"loc": "outside upper left", "ncols": columns}
    figure.legend(frameon=False, fontsize=9, labelcolor=INK, **where)


def fit_width(label: Label, figure: Figure) -> None:
    """Shrink a line of text so that its right margin is at least its left one."""
    with _any_names(figure):
        extent = label.get_window_extent()
    room = figure.bbox.width - 2 * extent.x0
    label.set_fontsize(float(label.get_fontsize()) * min(1, room / extent.width))


@contextlib.contextmanager
def _any_names(figure: Figure) -> Iterator[None]:
    """Let texts hold the name of any file while they are drawn.

    Control characters and bytes that are not UTF-8 are drawn as escapes. Letters that the font
    lacks are drawn as boxes, without the warning that would print them.
    """
    for label in figure.findobj(Label):
        text = label.get_text()
        if text != printable(text):
            label.set_text(printable(text))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph .* missing", UserWarning)
        yield


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as a PNG, whole or not at all."""
    with atomic_path(path) as temporary, _any_names(figure):
        figure.savefig(temporary, format="png", facecolor="white")


class Drawing(NamedTuple):
    """A picture in a page."""

    uri: str
    width: int
    height: int
    alt: str


def drawing(path: pathlib.Path, alt: str) -> Drawing:
    """Embed a PNG; its sides are in its first chunk (W3C PNG specification, 11.2.2)."""
    data = path.read_bytes()
    width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    return Drawing(_uri("png", data), width, height, alt)


def photograph(image: UInt8[np.ndarray, "h w 3"], alt: str) -> Drawing:
    """Embed RGB pixels as a WebP of a few kilobytes."""
    _, data = cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])
    height, width = image.shape[:2]
    return Drawing(_uri("webp", data.tobytes()), width, height, alt)


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
