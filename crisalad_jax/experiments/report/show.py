"""Figures for a notebook: what the transport kept of a picture, and what was found for queries."""

import os
from collections.abc import Sequence

from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.prepare import as_rgb
from crisalad_jax.data.resize import Pixels
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments.report.gallery import answers_figure, retrieval_figure, thumbnail
from crisalad_jax.experiments.report.style import GREY, INK, Picture
from crisalad_jax.experiments.report.transport import (
    CLUSTER_COLOURS,
    HEAT,
    draw_clusters,
    draw_dustbin,
    heat_range,
    strongest_clusters,
)
from crisalad_jax.experiments.report.transport_section import transport_of_image
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, check_params
from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.utils.errors import InputError

_PANEL = 3.4
"""Width of a panel in inches."""
_PIXELS = 480


def show_transport(
    image: str | os.PathLike[str] | Pixels, params: Crisalad, config: ModelConfig
) -> Figure:
    """Draw a picture, each patch's share in the dustbin, and the cluster that took most of it.

    The strongest seven clusters have colours; patches that others took stay grey. A colour's
    strength is the mass that clusters took of the patch. A transport without a dustbin has no
    middle panel.

    Args:
        image: a file, or 8-bit RGB or grey, as `prepare_image` takes it.
        params: the model's parameters.
        config: the model.

    Returns:
        A figure that a notebook shows; `figure.savefig(path)` writes it.

    Raises:
        InputError: the model's aggregator has no transport, parameters of another configuration,
            an image that cannot be read, or one that the model cannot describe.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> params = init_crisalad(jax.random.key(0), config)
        >>> figure = show_transport(pictures / "0.png", params, config)
        >>> [axes.get_title(loc="left").split(",")[0] for axes in figure.axes[:3]]
        ['80 x 60 pixels', 'dustbin: 67 % of the mass', 'top clusters']
    """
    if isinstance(image, Crisalad):
        raise InputError(
            "image: found parameters, expected a file or 8-bit RGB: the order is "
            "show_transport(image, params, config)"
        )
    check_params(params, config)
    pixels = read_pixels(image) if isinstance(image, str | os.PathLike) else image
    picture = transport_of_image(as_rgb(pixels, config.preprocessing.bit_depth), params, config)
    clusters = strongest_clusters([picture])
    share = picture.dustbin_share
    height, width = picture.image.shape[:2]
    rows, columns = picture.masses.shape[:2]
    panels = 2 if share is None else 3
    tall = _PANEL * min(height / width, 2)
    figure = Picture(figsize=(panels * _PANEL, tall + 0.9), layout="constrained")
    first, *middle, last = figure.subplots(1, panels)
    _panel(first, thumbnail(picture.image, _PIXELS), f"{width} x {height} pixels")
    if share is not None:
        limits = heat_range([picture])
        title = f"dustbin: {100 * share:.0f} % of the mass"
        _panel(middle[0], draw_dustbin(picture, limits, _PIXELS), title)
        scale = ScalarMappable(colors.Normalize(*limits), HEAT)
        below = middle[0].inset_axes((0.1, -0.1, 0.8, 0.04))
        bar = figure.colorbar(scale, cax=below, orientation="horizontal")
        bar.set_label("share of the patch in the dustbin", fontsize=8, color=INK)
        bar.ax.tick_params(labelsize=8, colors=GREY, labelcolor=INK)
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    title = f"top clusters, {rows} x {columns} patches"
    _panel(last, draw_clusters(picture, list(clusters), _PIXELS), title)
    last.legend(
        handles=[
            Patch(color=colour, label=f"{number}: {100 * part:.0f} %")
            for colour, (number, part) in zip(CLUSTER_COLOURS, clusters.items(), strict=False)
        ],
        title="cluster: share of what clusters took",
        title_fontsize=8,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.02),
        ncols=4,
        fontsize=8,
        frameon=False,
        handlelength=1,
        columnspacing=1,
    )
    return figure


def _panel(axes: Axes, pixels: Pixels, title: str) -> None:
    axes.imshow(pixels)
    axes.set_axis_off()
    axes.set_anchor("N")
    axes.set_title(title, loc="left", fontsize=9, color=INK)


def show_retrievals(
    found: Answers | GroupingResult,
    benchmark: Benchmark | None = None,
    *,
    queries: Sequence[int] | None = None,
    rows: int = 4,
    columns: int = 4,
    root: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw queries, one a row, beside what was found for them, best first.

    Results of an evaluation are framed green where right and red where wrong, with a mark for
    readers who cannot tell these. Answers of a map are framed grey: what is right is unknown.

    Args:
        found: answers of `query`, or one of the results of `evaluate`.
        benchmark: what was evaluated on, for a result.
        queries: numbers of the queries shown, in their order. None takes half of them right and
            half wrong where that is known, spread evenly.
        rows: number of queries shown, at most, where none are named.
        columns: number of retrievals shown for each, at most.
        root: folder of a map's images; None is where they were. One that is not there is a grey
            box, and a note says so.

    Returns:
        A figure that a notebook shows; `figure.savefig(path)` writes it.

    Raises:
        InputError: neither of these; a result without its benchmark, or answers with one; a query
            that there is not; rows or columns below 1; or an image that cannot be read.

    Example:
        >>> import numpy as np, pathlib
        >>> from crisalad_jax.retrieval.maps.map import MapImage
        >>> from crisalad_jax.retrieval.neighbours import Neighbours
        >>> near = Neighbours(np.array([[0, 1]]), np.array([[1.0, 0.5]]))
        >>> images = [MapImage(f"{n}.png", 1, None, str(pictures)) for n in range(4)]
        >>> figure = show_retrievals(Answers([pictures / "0.png"], near, images, None))
        >>> [axes.get_xlabel() for axes in figure.axes]
        ['query 0', '1   1.000', '2   0.500']
    """
    if not isinstance(found, Answers | GroupingResult):
        raise InputError(
            f"found: found {type(found).__name__}, expected answers of `query`, or one of the "
            "results of `evaluate`"
        )
    if not isinstance(benchmark, Benchmark | None):
        raise InputError(
            f"benchmark: found {type(benchmark).__name__}, expected one of `open_benchmark`"
        )
    is_result = isinstance(found, GroupingResult)
    if is_result != (benchmark is not None):
        which = "a result of evaluate" if is_result else "answers of a map"
        raise InputError(
            f"benchmark: found {'none' if is_result else 'one'} for {which}, expected it for "
            "results alone"
        )
    count = len(found.neighbours.indices)
    unknown = [number for number in queries or () if not 0 <= number < count]
    if unknown or (queries is not None and not len(queries)):
        which = f"query {unknown[0]}" if unknown else "none"
        raise InputError(f"queries: found {which}, expected numbers from 0 to {count - 1}")
    if benchmark is None:
        assert isinstance(found, Answers)
        return answers_figure(found, root=root, rows=rows, columns=columns, chosen=queries)
    assert isinstance(found, GroupingResult)
    return retrieval_figure(
        benchmark.queries,
        benchmark.database,
        *found.neighbours,
        benchmark.positives,
        rows=rows,
        columns=columns,
        chosen=queries,
    )
