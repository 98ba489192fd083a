"""Curves: recall against K, and a training run against its steps."""

import os
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from crisalad_jax.experiments.report.style import (
    COLOURS,
    DPI,
    INK,
    NARROW,
    NARROW_DPI,
    fit_width,
    plain_axes,
    save,
)
from crisalad_jax.experiments.report.tables import check_fractions
from crisalad_jax.utils.errors import InputError

_DASHES = ("-", "--", ":")

_RECALL = re.compile(r"R@(\d+)")
# Key, title of the panel, and whether to smooth it because batches make it noisy.
_LOSSES = (
    ("loss", "loss", True),
    ("easy_anchor_fraction", "share of anchors without a hard positive", True),
    ("accuracy", "share of images nearest to their class", True),
    ("learning_rate", "learning rate", False),
)


class PrecisionCurve(NamedTuple):
    """Precision and recall of accepting retrievals by similarity, strictest threshold first."""

    precision: Float[np.ndarray, " threshold"]
    recall: Float[np.ndarray, " threshold"]


def recall_curves(
    path: str | os.PathLike[str],
    curves: Mapping[str, Mapping[int, float]],
    title: str,
    *,
    narrow: bool = False,
) -> None:
    """Write a PNG of Recall@K in percent against K, one named line per curve.

    Args:
        path: the picture to write.
        curves: name -> K -> fraction of the queries, 0 to 1.
        title: stands above the picture.
        narrow: whether it is for pages that telephones show too. A second picture, for pages on a
            dark ground, is then written beside it.

    Raises:
        InputError: no curves, a curve without values, or a recall outside 0 to 1.
    """
    if not curves:
        raise InputError("curves: found none, expected at least one")
    for name, curve in curves.items():
        check_fractions(name, curve)
    figure = _curves_figure(3.4, title, NARROW) if narrow else _curves_figure(4.5, title)
    axes = figure.add_subplot()
    _draw_curves(axes, curves)
    axes.set_xticks(sorted({k for curve in curves.values() for k in curve}))
    axes.set_xlabel("K, database images retrieved", fontsize=10, color=INK)
    axes.set_ylabel("Recall@K", fontsize=10, color=INK)
    save(figure, path, NARROW_DPI if narrow else DPI, dark=narrow)


def precision_curves(path: str | os.PathLike[str], curves: Mapping[str, PrecisionCurve]) -> None:
    """Write narrow PNGs of precision against recall in percent, one line per curve.

    Raises:
        InputError: no curves, a curve of no points or of two lengths, or a value outside 0 to 1.
    """
    if not curves:
        raise InputError("curves: found none, expected at least one")
    for name, curve in curves.items():
        if len(curve.precision) != len(curve.recall):
            raise InputError(
                f"{name}: found {len(curve.precision)} precisions and {len(curve.recall)} recalls, "
                "expected as many"
            )
        for values in curve:
            check_fractions(name, dict(enumerate(values.tolist())))
    figure = _curves_figure(3.4, "", NARROW)
    axes = figure.add_subplot()
    plain_axes(axes)
    for number, (name, curve) in enumerate(curves.items()):
        axes.plot(
            100 * curve.recall,
            100 * curve.precision,
            color=COLOURS[number % len(COLOURS)],
            linestyle=_DASHES[number // len(COLOURS) % len(_DASHES)],
            linewidth=1.8,
            label=name,
            clip_on=False,
        )
    axes.set(xlim=(0, 100), ylim=(0, 100))
    axes.xaxis.set_major_formatter("{x:.0f} %")
    axes.yaxis.set_major_formatter("{x:.0f} %")
    axes.set_xlabel("recall", fontsize=10, color=INK)
    axes.set_ylabel("precision", fontsize=10, color=INK)
    figure.legend(loc="outside upper left", ncols=3, frameon=False, fontsize=9, labelcolor=INK)
    save(figure, path, NARROW_DPI, dark=True)


def training_curves(
    path: str | os.PathLike[str], records: Sequence[Mapping[str, int | float]], title: str = ""
) -> None:
    """Write a PNG of a run: its losses, learning rate and validation recalls against the step.

    A panel is drawn for each that the records hold. Long noisy series are pale under their running
    mean.

    Args:
        path: the picture to write.
        records: the lines of metrics.jsonl, each with "step" and any of "loss",
            "easy_anchor_fraction", "accuracy", "learning_rate", and "R@K" as a fraction of the
            queries, 0 to 1.
        title: stands above the picture.

    Raises:
        InputError: no records, one without a step, none with a known value, or a recall outside 0
            to 1.
    """
    for number, record in enumerate(records):
        if "step" not in record:
            raise InputError(f"records: number {number} has no step, only {', '.join(record)}")
    series = {
        key: {int(record["step"]): record[key] for record in records if key in record}
        for key in dict.fromkeys(key for record in records for key in record)
    }
    losses = [panel for panel in _LOSSES if panel[0] in series]
    ks = sorted(int(match[1]) for match in map(_RECALL.fullmatch, series) if match)
    recalls = {f"R@{k}": series[f"R@{k}"] for k in ks}
    for name, curve in recalls.items():
        check_fractions(name, curve)
    if not losses and not recalls:
        raise InputError(
            f"records: found {len(records)} without any of "
            f"{', '.join(key for key, *_ in _LOSSES)} or R@K, expected at least one"
        )

    # The names beside the recalls need room.
    heights = [1.5] * len(losses) + [2.4] * bool(recalls)
    figure = _curves_figure(sum(heights) + 0.45 * len(heights) + 0.6, title)
    panels = figure.subplots(
        len(heights), sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for axes, (key, label, noisy) in zip(panels, losses, strict=False):
        _draw_series(axes, series[key], noisy)
        axes.set_title(label, fontsize=10, color=INK, loc="left")
    if recalls:
        _draw_curves(panels[-1], recalls)
        panels[-1].set_title("validation Recall@K", fontsize=10, color=INK, loc="left")
    panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    panels[-1].set_xlabel("step", fontsize=10, color=INK)
    save(figure, path)


def _draw_curves(axes: Axes, curves: Mapping[str, Mapping[int, float]]) -> None:
    """Draw fractions in percent, each line named at its right end."""
    lines = {
        name: sorted((at, 100 * value) for at, value in curve.items())
        for name, curve in curves.items()
    }
    values = [value for line in lines.values() for _, value in line]
    # The scale starts at 0 unless the lines lie high, where that would hide their differences.
    low = 0.0 if min(values) < 50 else 10 * ((min(values) - 2) // 10)
    high = min(100.0, 10 * -((max(values) + 2) // -10))
    plain_axes(axes)
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True, steps=(1, 2, 5, 10)))
    axes.yaxis.set_major_formatter("{x:.0f} %")

    ends = _spread([line[-1][1] for line in lines.values()], 0.065 * (high - low), low, high)
    right = max(at for line in lines.values() for at, _ in line)
    for number, ((name, line), end) in enumerate(zip(lines.items(), ends, strict=True)):
        colour = COLOURS[number % len(COLOURS)]
        at, percent = zip(*line, strict=True)
        axes.plot(
            at,
            percent,
            color=colour,
            linestyle=_DASHES[number // len(COLOURS) % len(_DASHES)],
            linewidth=1.8,
            marker="o",
            markersize=4.5,
            # Markers at 100 % are not cut in half.
            clip_on=False,
        )
        axes.annotate(
            f"{name}  {percent[-1]:.1f}",
            (right, end),
            xytext=(9, 0),
            textcoords="offset points",
            color=colour,
            fontsize=9,
            va="center",
            annotation_clip=False,
        )


def _spread(places: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Move places apart to about `gap`, in their order, within `low` to `high`."""
    order = np.argsort(places, kind="stable")
    moved = np.array(places, float)[order]
    gap = min(gap, (high - low) / len(places))
    # Each round pushes close neighbours apart; a dozen names settle within a hundredth of the gap.
    for _ in range(300):
        push = np.maximum(gap - np.diff(moved), 0) / 2
        moved[:-1] -= push
        moved[1:] += push
        moved = moved.clip(low, high)
    spread = np.empty_like(moved)
    spread[order] = moved
    return spread.tolist()


def _draw_series(axes: Axes, series: Mapping[int, float], noisy: bool) -> None:
    steps, values = list(series), np.array(list(series.values()), float)
    plain_axes(axes)
    axes.yaxis.set_major_formatter("{x:g}")
    window = len(values) // 20
    if not noisy or window < 3:
        marker = "o" if len(values) == 1 else None
        axes.plot(steps, values, color=COLOURS[0], linewidth=1.8, marker=marker, markersize=4.5)
        return
    ones = np.ones(window)
    counts = np.convolve(np.ones_like(values), ones, mode="same")
    means = np.convolve(values, ones, mode="same") / counts
    axes.plot(steps, values, color=COLOURS[0], linewidth=0.7, alpha=0.3)
    axes.plot(steps, means, color=COLOURS[0], linewidth=1.8)


def _curves_figure(height: float, title: str, width: float = 7) -> Figure:
    # Inches around everything, so that no name touches the edge.
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1)
    figure = Figure(figsize=(width, height), layout=layout)
    if title:
        fit_width(figure.suptitle(title, fontsize=12, color=INK, x=0.02, ha="left"), figure)
    return figure
