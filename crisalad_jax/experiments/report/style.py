"""The style of all pictures: colours, axes, and how they are written.

They are drawn with matplotlib's object interface: no display, and no state outside the call.
"""

import contextlib
import os
import warnings
from collections.abc import Iterator

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text as Label

from crisalad_jax.utils.files import atomic_path
from crisalad_jax.utils.output import printable

INK = "#222222"
GREY = "#757575"
PALE = "#e4e4e4"
RIGHT = "#2a8f3c"
WRONG = "#c62828"
# Okabe and Ito's colours, which the colour-blind can tell apart; without yellow, too light for
# lines.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
DPI = 120
NARROW, NARROW_DPI = 4.0, 200
"""Width in inches, and dots an inch: letters of 9 points are then readable on a telephone."""


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


def save(figure: Figure, path: str | os.PathLike[str], dpi: int = DPI) -> None:
    """Write a figure as a PNG, whole or not at all, with `dpi` dots an inch."""
    with atomic_path(path) as temporary, _any_names(figure):
        figure.savefig(temporary, format="png", dpi=dpi, facecolor="white")
