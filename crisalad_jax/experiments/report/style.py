"""The common style of all figures, and how they are written and embedded in pages.

Figures use matplotlib's object interface, so they need no display and no state outside the call.
"""

import base64
import contextlib
import io
import os
import pathlib
import warnings
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import cv2
import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
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
"""Colour of images without an outcome, such as the database on a map."""
# Okabe and Ito's colours, which the colour-blind can tell apart; without yellow, too light for
# lines.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
WIDE = {"width": 7.0, "dpi": 120}
"""Width in inches and dots per inch of a figure that is not part of a page."""
FORMATS = (".png", ".svg", ".pdf")
"""Suffixes of the files in which a figure is written: pixels for pages, vectors for papers."""
_WEBP_QUALITY = 78
_UNDATED = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
# Names in an SVG are not random; a PDF has TrueType fonts, as publishers require.
_FIXED: Any = {"svg.hashsalt": "crisalad", "pdf.fonttype": 42}


class Picture(Figure):
    """A figure that notebooks display directly, without pyplot and its state."""

    def _repr_jpeg_(self) -> bytes:
        """Return the figure for IPython's display; photographs as PNG would bloat a notebook."""
        return _encode(self, "jpg", pil_kwargs={"quality": 88})

    def savefig(self, fname: Any, **options: Any) -> None:
        """Write the figure as PNG, SVG or PDF; the same figure gives the same bytes."""
        kind = options.get("format") or pathlib.Path(str(fname)).suffix[1:].lower()
        options = {"facecolor": "white", "metadata": _UNDATED.get(kind)} | options
        with matplotlib.rc_context(_FIXED), _any_names(self):
            super().savefig(fname, **options)


def new_figure(height: float, title: str = "", *, width: float = 4.0, dpi: int = 200) -> Picture:
    """Make an empty figure of this size in inches, with a title that shrinks to fit.

    At the default size, 9-point text is readable in a page on a phone.
    """
    # Inches around everything, so that no name touches the edge.
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1)
    figure = Picture(figsize=(width, height), dpi=dpi, layout=layout)
    if title:
        label = figure.suptitle(title, fontsize=12, color=INK, x=0.02, ha="left")
        with _any_names(figure):
            extent = label.get_window_extent()
        # Its right margin is at least its left one.
        room = figure.bbox.width - 2 * extent.x0
        label.set_fontsize(float(label.get_fontsize()) * min(1, room / extent.width))
    return figure


def label_axes(
    axes: Axes, x: str, y: str, *, grid: Literal["x", "y", "both"] = "y", title: str = ""
) -> None:
    """Style axes: their names `x` and `y`, left and bottom spines, and pale lines along `grid`."""
    axes.set_xlabel(x, fontsize=10, color=INK)
    axes.set_ylabel(y, fontsize=10, color=INK)
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    axes.tick_params(colors=GREY, labelcolor=INK, labelsize=9)
    axes.grid(axis=grid, color=PALE, linewidth=0.8)
    axes.set_axisbelow(True)


def legend_below(figure: Figure) -> None:
    """Draw a legend below the axes, in two columns if its names are short enough."""
    names = [name for axes in figure.axes for name in axes.get_legend_handles_labels()[1]]
    room = figure.get_figwidth() / 2 - 0.6  # inches; a letter of 9 points is 0.08 wide
    columns = 2 if max(map(len, names)) * 0.08 <= room else 1
    where = {"loc": "outside lower left", "ncols": columns}
    figure.legend(frameon=False, fontsize=9, labelcolor=INK, **where)


def scale_below(
    figure: Figure, plots: np.ndarray, scale: str, ends: tuple[float, float], label: str
) -> Any:
    """Draw and return a colour bar below the plots, of colormap `scale` between the `ends`."""
    below: Any = {"location": "bottom", "shrink": 0.5, "aspect": 25, "pad": 0.02}
    colours = ScalarMappable(Normalize(*ends), scale)
    bar: Any = figure.colorbar(colours, ax=plots.ravel().tolist(), **below)
    bar.set_label(label, fontsize=8, color=INK)
    bar.ax.tick_params(labelsize=8, colors=GREY, labelcolor=INK)
    bar.outline.set_visible(False)
    return bar


@contextlib.contextmanager
def _any_names(figure: Figure) -> Iterator[None]:
    """Allow any file name in the texts of a figure while it is drawn.

    Control characters and bytes that are not UTF-8 are drawn as escapes. Letters that the font
    lacks are drawn as boxes, without a warning.
    """
    for label in figure.findobj(Label):
        label.set_text(printable(label.get_text()))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph .* missing", UserWarning)
        yield


def _encode(figure: Picture, kind: str, **options: Any) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format=kind, **options)
    return data.getvalue()


def save(figure: Picture, path: str | os.PathLike[str]) -> None:
    """Write a figure atomically, in the format of the file's suffix, by default PNG."""
    data = _encode(figure, pathlib.Path(path).suffix[1:].lower() or "png")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def save_chart(figure: Picture, path: pathlib.Path) -> None:
    """Write a figure as a PNG, and as vector graphics in an SVG and a PDF of the same name."""
    for suffix in FORMATS:
        save(figure, path.with_suffix(suffix))


class Drawing(NamedTuple):
    """A picture in a page: its data URI, size in pixels, and alternative text."""

    uri: str
    width: int
    height: int
    alt: str
    kind: str = ""
    """Style of its frame: query, right, wrong or expected; "" for none."""
    lines: tuple[str, ...] = ()
    """Lines of text below the picture."""


def chart(figure: Picture, path: pathlib.Path, alt: str) -> Drawing:
    """Write a figure with `save_chart`, and return its PNG for a page."""
    save_chart(figure, path)
    return _embed(figure, "png", path.read_bytes(), alt)


def illustration(figure: Picture, alt: str) -> Drawing:
    """Convert a figure with photographs to a WebP image for a page."""
    data = _encode(figure, "webp", pil_kwargs={"quality": _WEBP_QUALITY})
    return _embed(figure, "webp", data, alt)


def _embed(figure: Figure, kind: str, data: bytes, alt: str) -> Drawing:
    return Drawing(_uri(kind, data), int(figure.bbox.width), int(figure.bbox.height), alt)


def photograph(
    image: UInt8[np.ndarray, "h w 3"], alt: str, kind: str = "", lines: tuple[str, ...] = ()
) -> Drawing:
    """Convert RGB pixels to a WebP image of a few kilobytes for a page."""
    _, data = cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])
    height, width = image.shape[:2]
    return Drawing(_uri("webp", data.tobytes()), width, height, alt, kind, lines)


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
