"""The style of all pictures: colours, axes, and how they are written.

They are drawn with matplotlib's object interface: no display, and no state outside the call.
"""

import contextlib
import io
import os
import pathlib
import warnings
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb, to_rgba_array
from matplotlib.figure import Figure
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
DPI = 120
NARROW, NARROW_DPI = 4.0, 200
"""Width in inches, and dots an inch: letters of 9 points are then readable on a telephone."""


class Picture(Figure):
    """A figure that notebooks show by itself, without pyplot and its state."""

    def _repr_jpeg_(self) -> bytes:
        """Return the figure for IPython's display; photographs as a PNG fill a notebook."""
        data = io.BytesIO()
        with _any_names(self):
            self.savefig(data, format="jpg", facecolor="white", pil_kwargs={"quality": 88})
        return data.getvalue()


def fit_width(label: Label, figure: Figure) -> None:
    """Shrink a line of text so that its right margin is at least its left one."""
    with _any_names(figure):
        extent = label.get_window_extent()
    room = figure.bbox.width - 2 * extent.x0
    label.set_fontsize(float(label.get_fontsize()) * min(1, room / extent.width))


@contextlib.contextmanager
def _any_names(figure: Figure) -> Iterator[None]:
    """Let texts hold the name of any file while they are drawn.

    Control characters and bytes that are no UTF-8 are drawn as escapes. Letters that the font lacks
    are drawn as boxes, without the warning that would print them.
    """
    for label in figure.findobj(Label):
        text = label.get_text()
        if text != printable(text):
            label.set_text(printable(text))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph .* missing", UserWarning)
        yield


def plain_axes(axes: Axes) -> None:
    """Style axes: left and bottom spines, numbers, and pale horizontal grid lines."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    axes.tick_params(colors=GREY, labelcolor=INK, labelsize=9)
    axes.grid(axis="y", color=PALE, linewidth=0.8)
    axes.set_axisbelow(True)


def save(
    figure: Figure, path: str | os.PathLike[str], dpi: int = DPI, *, dark: bool = False
) -> None:
    """Write a figure as a PNG, whole or not at all, with `dpi` dots an inch.

    Args:
        figure: what is drawn.
        path: the picture to write.
        dpi: its dots an inch.
        dark: whether to write it a second time, for pages on a dark ground; see `dark_path`.
    """
    _write(figure, path, dpi, "white")
    if dark:
        _darken(figure)
        _write(figure, dark_path(path), dpi, _DARK["#ffffff"])


def dark_path(path: str | os.PathLike[str]) -> pathlib.Path:
    """Return the file of a picture's dark variant, beside it."""
    path = pathlib.Path(path)
    return path.with_name(f"{path.stem}_dark{path.suffix}")


def _write(figure: Figure, path: str | os.PathLike[str], dpi: int, ground: str) -> None:
    with atomic_path(path) as temporary, _any_names(figure):
        figure.savefig(temporary, format="png", dpi=dpi, facecolor=ground)


_DARK = {
    "#ffffff": "#15181c",
    INK: "#e8eaed",
    GREY: "#a3acb8",
    PALE: "#363c44",
    RIGHT: "#6fcf80",
    WRONG: "#ff8a80",
    UNMATCHED: "#d7a6e3",
    PLAIN: "#6b7480",
    "#0072b2": "#4aa8e8",
    "#d55e00": "#ff9147",
    "#009e73": "#2fcf9f",
    "#cc79a7": "#e59cc3",
    "#e69f00": "#f2b632",
    "#56b4e9": "#a5dcff",
}
"""Colours on the ground of page.css in dark mode, by those on white."""


def _darken(figure: Figure) -> None:
    """Replace the colours of a figure that was drawn, by `_DARK`; pictures in it stay."""
    known = {tuple(np.round(to_rgb(light), 3)): to_rgb(dark) for light, dark in _DARK.items()}
    for artist in figure.findobj():
        if getattr(artist, "get_array", lambda: None)() is not None:
            continue
        for name in ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor"):
            getter = getattr(artist, f"get_{name}", None)
            setter = getattr(artist, f"set_{name}", None)
            if getter is None or setter is None:
                continue
            colours = to_rgba_array(getter())
            changed = colours.copy()
            for row in changed:
                row[:3] = known.get(tuple(np.round(row[:3], 3)), row[:3])
            if not np.array_equal(changed, colours):
                setter(changed if len(changed) > 1 else tuple(changed[0]))
