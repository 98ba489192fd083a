"""Curves: recall against K, precision against recall, and a training run against its steps."""

import os
import re
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from crisalad_jax.evaluation.metrics import PrecisionRecall
from crisalad_jax.experiments.report.style import (
    COLOURS,
    label_axes,
    legend_above,
    new_figure,
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


def recall_curves(
    path: str | os.PathLike[str],
    curves: Mapping[str, Mapping[int, float]],
    title: str = "",
    *,
    wide: bool = False,
) -> None:
    """Write a PNG of Recall@K in percent against K, one named line per curve.

    Args:
        path: the picture to write.
        curves: name -> K -> fraction of the queries, 0 to 1.
        title: stands above the picture.
        wide: whether it is for a page of its own, and not for one that telephones show too.

    Raises:
        InputError: no curves, a curve without values, or a recall outside 0 to 1.
    """
    if not curves:
        raise InputError("curves: found none, expected at least one")
    for name, curve in curves.items():
        check_fractions(name, curve)
    figure = new_figure(4.5 if wide else 3.4, title, wide=wide)
    axes = figure.add_subplot()
    label_axes(axes, "K, database images retrieved", "Recall@K")
    _draw_recalls(axes, curves)
    axes.set_xticks(sorted({k for curve in curves.values() for k in curve}))
    legend_above(figure)
    save(figure, path)


def precision_curves(path: str | os.PathLike[str], curves: Mapping[str, PrecisionRecall]) -> None:
    """Write a PNG of precision against recall in percent, one named line per curve."""
    figure = new_figure(3.4)
    axes = figure.add_subplot()
    label_axes(axes, "recall", "precision")
    for number, (name, curve) in enumerate(curves.items()):
        _draw_line(axes, number, name, curve.recall, 100 * curve.precision)
    axes.set(xlim=(0, 1), ylim=(0, 100))
    axes.xaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f} %")
    axes.yaxis.set_major_formatter("{x:.0f} %")
    legend_above(figure)
    save(figure, path)


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
        InputError: no record with a known value, or a recall outside 0 to 1.
    """
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
    heights = [1.5] * len(losses) + [2.4] * bool(recalls)
    figure = new_figure(sum(heights) + 0.45 * len(heights) + 0.6, title, wide=True)
    panels = figure.subplots(len(heights), sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (key, label, noisy) in zip(panels, losses, strict=False):
        label_axes(axes, "", "", title=label)
        _draw_series(axes, series[key], noisy)
    if recalls:
        label_axes(panels[-1], "", "", title="validation Recall@K")
        _draw_recalls(panels[-1], recalls)
        panels[-1].legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1, 0.5))
    panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    panels[-1].set_xlabel("step", fontsize=10)
    save(figure, path)


def _draw_recalls(axes: Axes, curves: Mapping[str, Mapping[int, float]]) -> None:
    """Draw fractions in percent; each line's name ends with its last value."""
    for number, (name, curve) in enumerate(curves.items()):
        at, values = zip(*sorted(curve.items()), strict=True)
        percent = 100 * np.array(values)
        _draw_line(axes, number, f"{name}  {percent[-1]:.1f}", at, percent, marker="o")
    least = 100 * min(value for curve in curves.values() for value in curve.values())
    # The scale starts at 0 unless the lines are high, where that would hide their differences.
    axes.set_ylim(0 if least < 50 else None, None)
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True, steps=(1, 2, 5, 10)))
    axes.yaxis.set_major_formatter("{x:.0f} %")


def _draw_line(axes: Axes, number: int, name: str, x, y, marker: str = "") -> None:
    axes.plot(
        x,
        y,
        color=COLOURS[number % len(COLOURS)],
        linestyle=_DASHES[number // len(COLOURS) % len(_DASHES)],
        linewidth=1.8,
        marker=marker,
        markersize=4.5,
        label=name,
        clip_on=False,  # markers at 100 % are not cut in half
    )


def _draw_series(axes: Axes, series: Mapping[int, float], noisy: bool) -> None:
    steps, values = list(series), np.array(list(series.values()), float)
    axes.yaxis.set_major_formatter("{x:g}")
    window = len(values) // 20
    if noisy and window >= 3:
        axes.plot(steps, values, color=COLOURS[0], linewidth=0.7, alpha=0.3)
        ones = np.ones(window)
        counts = np.convolve(np.ones_like(values), ones, mode="same")
        values = np.convolve(values, ones, mode="same") / counts
    marker = "o" if len(values) == 1 else ""
    axes.plot(steps, values, color=COLOURS[0], linewidth=1.8, marker=marker, markersize=4.5)
