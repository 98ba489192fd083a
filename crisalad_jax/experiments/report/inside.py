"""Figures of what happens inside a model: attention, gradients, and descriptors in a plane."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from crisalad_jax.config.checks import require, takes
from crisalad_jax.data.resize import Pixels
from crisalad_jax.experiments.report.gallery import thumbnail
from crisalad_jax.experiments.report.style import (
    COLOURS,
    INK,
    WIDE,
    Picture,
    label_axes,
    new_figure,
    scale_below,
)
from crisalad_jax.experiments.report.transport import HEAT, Image, draw_panel, read_rgb
from crisalad_jax.nn.model import Model, attention_maps, check_params, cross_image_attention
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.retrieval.pca import project_to_plane

_PIXELS = 480
_SMALL = 96
_DIVERGING = "PuOr_r"
_MARKS = "os^DvP"
_MOST = len(COLOURS) * len(_MARKS)
"""Number of places that colours and marks can distinguish."""
_NUMBERED = 10
"""Number of images up to which a matrix shows its values."""


@takes(model=Model)
def show_attention(
    image: Image,
    model: Model,
    *,
    block: int = -1,
    head: int | None = None,
    patch: tuple[int, int] | None = None,
) -> Picture:
    """Draw which patches the class token, or a patch, attends to in a block of a ViT.

    Each panel has its own colour scale, whose ends are in its title. Attention to the class token
    and to register tokens is not drawn.

    Args:
        image: an image file, or an array that `prepare_image` takes.
        model: a model from `load`.
        block: index of the block, from 0; negative ones count from the last.
        head: index of the head, from 0. None draws the mean over the heads, then each head.
        patch: row and column of the patch that attends, from 0; a white square marks it. None for
            the class token.

    Returns:
        A figure for notebooks; `figure.savefig(path)` writes it as PNG, SVG or PDF.

    Raises:
        InputError: there is no such block, head or patch; the backbone has no attention maps; or
            the image cannot be read or described.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> figure = show_attention(pictures / "0.png", model, block=0)
        >>> [axes.get_title(loc="left").partition(":")[0] for axes in figure.axes[1:6]]
        ['all heads', 'head 0', 'head 1', 'head 2', 'head 3']
    """
    check_params(*model)
    pixels = read_rgb(image, model)
    prepared = prepare_image(pixels, model.config)
    rows, columns = model.config.backbone.grid((prepared.shape[0], prepared.shape[1]))
    maps = attention_maps(model.params, prepared[None], model.config, block=block)[0]
    heads, tokens, _ = maps.shape
    require(
        head is None or 0 <= head < heads, f"head: found {head}, expected 0 to {heads - 1}, or None"
    )
    inside = patch is None or (0 <= patch[0] < rows and 0 <= patch[1] < columns)
    require(inside, f"patch: found {patch}, expected a row below {rows}, a column below {columns}")
    first = tokens - rows * columns
    number = 0 if patch is None else first + patch[0] * columns + patch[1]
    shares = np.asarray(maps[:, number, first:tokens], np.float32).reshape(heads, rows, columns)
    panels = {f"head {each}": shares[each] for each in range(heads) if head in (None, each)}
    if head is None:
        panels = {"all heads": shares.mean(axis=0)} | panels

    height, width = pixels.shape[:2]
    across = min(4, math.ceil(math.sqrt(1 + len(panels))))
    down = math.ceil((1 + len(panels)) / across)
    size = down * (2.6 * min(height / width, 2) + 0.25) + 0.7
    figure = new_figure(size, width=2.6 * across, dpi=120)
    plots = figure.subplots(down, across, squeeze=False).ravel()
    small = thumbnail(pixels, _PIXELS)
    draw_panel(plots[0], small, f"{width} x {height} pixels, {rows} x {columns} patches")
    for axes, (name, over) in zip(plots[1:], panels.items(), strict=False):
        draw_panel(axes, small, f"{name}: {100 * over.min():.2g} to {100 * over.max():.2g} %", over)
    if patch is not None:
        side = small.shape[0] / rows, small.shape[1] / columns
        corner = patch[1] * side[1] - 0.5, patch[0] * side[0] - 0.5
        for axes in plots[: 1 + len(panels)]:
            square = Rectangle(corner, side[1], side[0], fill=False, edgecolor="white", linewidth=2)
            axes.add_patch(square)
    for axes in plots[1 + len(panels) :]:
        axes.set_visible(False)
    who = "the class token" if patch is None else f"patch {patch[0]}, {patch[1]}"
    number = block % model.config.backbone.depth
    bar = scale_below(figure, plots, HEAT, (0, 1), f"attention of {who} in block {number}")
    bar.set_ticks([0, 1], labels=["least of its panel", "most of its panel"])
    return figure


@takes(model=Model)
def show_image_attention(
    images: Sequence[Image], model: Model, *, mask: Bool[np.ndarray, "image image"] | None = None
) -> Picture:
    """Draw which images attend to which in each layer of the cross-image encoder.

    Each row is an image that attends, each column one that it attends to. The colour of a cell is
    the attention weight, averaged over tokens and heads; up to ten images also show it in percent.
    White is uniform attention, a weight of one over the number of images.

    Args:
        images: image files or arrays, which are described together.
        model: a model from `load`, with a cross-image encoder.
        mask: whether image i may attend to image j, as in `describe`; None allows all pairs.

    Returns:
        A figure for notebooks; `figure.savefig(path)` writes it as PNG, SVG or PDF.

    Raises:
        InputError: there are no images, or their sizes differ and the model does not resize; its
            encoder has no attention; `mask` does not fit; or an image cannot be read or described.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> files = [pictures / f"{number}.png" for number in range(3)]
        >>> figure = show_image_attention(files, model)
        >>> [axes.get_title(loc="left") for axes in figure.axes[:2]]
        ['layer 0', 'layer 1']
    """
    check_params(*model)
    pixels = [read_rgb(image, model) for image in images]
    prepared = [prepare_image(each, model.config) for each in pixels]
    sizes = sorted({f"{each.shape[0]} x {each.shape[1]}" for each in prepared})
    require(len(sizes) == 1, f"images: found sizes {', '.join(sizes) or 'of none'}, expected one")
    weights = cross_image_attention(model.params, np.stack(prepared), model.config, mask=mask)
    shares = np.asarray(weights, np.float32).mean(axis=(1, 2))
    layers, count = shares.shape[:2]
    side = min(0.55 * (count + 1), 6.0)
    figure = new_figure(side + 1.3, width=layers * (side + 0.5), dpi=120)
    plots = figure.subplots(1, layers, squeeze=False)[0]
    small = [thumbnail(each, _SMALL) for each in pixels]
    # Differences below a percent are pale.
    reach = max(100 * float(np.abs(shares - 1 / count).max()), 1.0)
    ends = 100 / count - reach, 100 / count + reach
    for layer, axes in enumerate(plots):
        _draw_matrix(axes, 100 * shares[layer], small, ends, f"layer {layer}")
    label = "share of the attention in %, of the row's image to the column's"
    scale_below(figure, plots, _DIVERGING, ends, label)
    return figure


def _draw_matrix(
    axes: Axes,
    shares: Float[np.ndarray, "image image"],
    images: Sequence[Pixels],
    ends: tuple[float, float],
    title: str,
) -> None:
    """Draw which image attends to which, with the images next to rows and above columns."""
    count = len(images)
    axes.imshow(shares, _DIVERGING, vmin=ends[0], vmax=ends[1])
    for number, image in enumerate(images):
        height, width = (0.44 * side / max(image.shape[:2]) for side in image.shape[:2])
        for x, y in ((-1.05, number), (number, -1.05)):
            where = (x - width, x + width, y + height, y - height)
            axes.imshow(image, extent=where)
    if count <= _NUMBERED:
        for row, column in np.ndindex(count, count):
            share = shares[row, column]
            words: Any = {"ha": "center", "va": "center", "fontsize": 8}
            is_dark = abs(2 * share - sum(ends)) > 0.55 * (ends[1] - ends[0])
            axes.text(column, row, f"{share:.1f}", color="white" if is_dark else INK, **words)
    axes.set(xlim=(-1.6, count - 0.5), ylim=(count - 0.5, -1.6), xticks=[], yticks=[], aspect=1)
    axes.spines[:].set_visible(False)
    axes.set_title(title, loc="left", fontsize=10, color=INK)


def show_gradient_norms(norms: Mapping[str, float]) -> Picture:
    """Draw the gradient norms of the backbone's blocks, and those of other parts of a model.

    The scale is logarithmic: a norm of 0, or one that is not finite, is not drawn.

    Args:
        norms: gradient norms by name of the part, from `gradient_norms`.

    Returns:
        A figure for notebooks; `figure.savefig(path)` writes it as PNG, SVG or PDF.

    Raises:
        InputError: `norms` is empty.

    Example:
        >>> norms = {"backbone.blocks.0.adapter": 0.1, "backbone.blocks.1.adapter": 0.2}
        >>> figure = show_gradient_norms(norms | {"aggregator": 1.5, "cross_image": 0.3})
        >>> [axes.get_xlabel() for axes in figure.axes]
        ['block', '']
    """
    require(bool(norms), "norms: found none, expected those of gradient_norms")
    lines: dict[str, dict[int, float]] = {}
    others = {}
    for part, norm in norms.items():
        match = re.fullmatch(r"backbone\.(\w+)\.(\d+)(?:\.(.+))?", part)
        if match is None:
            others[part.removeprefix("backbone.").replace("_", " ")] = norm
        else:
            lines.setdefault(match[3] or match[1], {})[int(match[2])] = norm
    figure = new_figure(3.2, **WIDE)
    ratios = [2.0] * bool(lines) + [1.0] * bool(others)
    plots = figure.subplots(1, len(ratios), squeeze=False, sharey=True, width_ratios=ratios)[0]
    for axes in plots:
        label_axes(axes, "", "")
        axes.set_yscale("log")
    plots[0].set_ylabel("norm of the gradient", fontsize=10, color=INK)
    for number, (name, line) in enumerate(lines.items()):
        colour, mark = COLOURS[number % len(COLOURS)], _MARKS[number % len(_MARKS)]
        style: Any = {"color": colour, "marker": mark, "markersize": 5, "label": name}
        plots[0].plot(list(line), list(line.values()), **style)
    if lines:
        plots[0].set_xlabel("block", fontsize=10, color=INK)
        plots[0].xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        plots[0].legend(frameon=False, fontsize=9, labelcolor=INK)
    if others:
        plots[-1].plot(range(len(others)), list(others.values()), "o", color=INK, markersize=5)
        turned: Any = {"rotation": 35, "ha": "right", "rotation_mode": "anchor", "fontsize": 9}
        plots[-1].set_xticks(range(len(others)), list(others), **turned)
        plots[-1].set_xlim(-0.6, len(others) - 0.4)
    return figure


def show_descriptors(descriptors: Float[np.ndarray, "n d"], places: Sequence[str | int]) -> Picture:
    """Draw descriptors in the plane of their first two principal components, by place.

    Each place has a colour and a mark, and thin lines join its descriptors to their mean.

    Args:
        descriptors: at least three descriptors, of at most 36 places.
        places: name or number of the place of each descriptor.

    Returns:
        A figure for notebooks; `figure.savefig(path)` writes it as PNG, SVG or PDF.

    Raises:
        InputError: descriptors are on a line or not finite; `places` do not fit, or are over 36.

    Example:
        >>> import numpy as np
        >>> descriptors = np.random.default_rng(0).normal(size=(6, 8)).astype(np.float32)
        >>> figure = show_descriptors(descriptors, 2 * ["bridge", "park", "mill"])
        >>> [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
        ['bridge', 'park', 'mill']
    """
    names = list(dict.fromkeys(places))
    require(
        len(places) == len(descriptors) and len(names) <= _MOST,
        f"places: found {len(places)}, of {len(names)} places, expected one for each of the "
        f"{len(descriptors)} descriptors, of at most {_MOST} places",
    )
    plane = project_to_plane(descriptors)
    figure = new_figure(4.6, **WIDE)
    axes = figure.add_subplot()
    first, second = (f"{100 * share:.0f} % of the variance" for share in plane.shares)
    label_axes(axes, f"first component, {first}", f"second, {second}", grid="both")
    numbers = np.array([names.index(place) for place in places])
    marks = []
    for number in range(len(names)):
        own = plane.positions[numbers == number]
        colour = COLOURS[number % len(COLOURS)]
        mark = _MARKS[(number + number // len(COLOURS)) % len(_MARKS)]
        for end in own:
            axes.plot(
                *zip(own.mean(axis=0), end, strict=True), color=colour, linewidth=0.7, alpha=0.5
            )
        marks.append(axes.scatter(*own.T, s=36, c=colour, marker=mark, linewidths=0, zorder=3))
    axes.set_aspect("equal", adjustable="datalim")
    look: Any = {"frameon": False, "fontsize": 8, "labelcolor": INK}
    look |= {"loc": "center left", "bbox_to_anchor": (1, 0.5), "ncols": math.ceil(len(names) / 18)}
    legend = axes.legend(marks, list(map(str, names)), **look)
    for text in legend.get_texts():
        text.set_parse_math(False)  # a dollar sign must not start a formula
    return figure
