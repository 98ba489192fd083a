"""The transport plan of a model drawn over a photograph: its clusters, and its dustbin."""

import os
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import matplotlib
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.patches import Patch

from crisalad_jax.config.checks import takes
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.prepare import as_rgb
from crisalad_jax.data.resize import Pixels
from crisalad_jax.experiments.report.gallery import thumbnail
from crisalad_jax.experiments.report.style import GREY, INK, Picture
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, check_params, transport_masses
from crisalad_jax.retrieval.describe import prepare_image

CLUSTER_COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7")
"""Okabe and Ito's colours, which the colour-blind can tell apart, on a grey photograph."""
_HEAT = "inferno"
_OPACITY = 0.65
_PANEL = 3.4
"""Width of a panel in inches."""
_PIXELS = 480


@takes(model=Model)
def show_transport(image: str | os.PathLike[str] | Pixels, model: Model) -> Picture:
    """Draw a picture, each patch's share in the dustbin, and the cluster that took most of it.

    The strongest seven clusters have colours; patches that others took stay grey. A colour's
    strength is the mass that clusters took of the patch. A transport without a dustbin has no
    middle panel.

    Args:
        image: a file, or 8-bit RGB or grey, as `prepare_image` takes it.
        model: the model, as `load` returns it.

    Returns:
        A figure that a notebook shows; `figure.savefig(path)` writes it.

    Raises:
        InputError: the model's aggregator has no transport, parameters of another configuration,
            an image that cannot be read, or one that the model cannot describe.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> figure = show_transport(pictures / "0.png", model)
        >>> [axes.get_title(loc="left").split(",")[0] for axes in figure.axes[:3]]
        ['80 x 60 pixels', 'dustbin: 67 % of the mass', 'top clusters']
    """
    params, config = model
    check_params(params, config)
    pixels = read_pixels(image) if isinstance(image, str | os.PathLike) else image
    picture = transport_of(as_rgb(pixels, config.preprocessing.bit_depth), params, config)
    clusters = strongest_clusters([picture])
    height, width = picture.image.shape[:2]
    rows, columns = picture.masses.shape[:2]
    panels = 2 if picture.dustbin is None else 3
    size = (panels * _PANEL, _PANEL * min(height / width, 2) + 0.9)
    figure = Picture(figsize=size, layout="constrained")
    first, *middle, last = figure.subplots(1, panels)
    _panel(first, thumbnail(picture.image, _PIXELS), f"{width} x {height} pixels")
    for axes in middle:
        limits = heat_range([picture])
        title = f"dustbin: {100 * (picture.dustbin_share or 0):.0f} % of the mass"
        _panel(axes, draw_dustbin(picture, limits, _PIXELS), title)
        scale = ScalarMappable(colors.Normalize(*limits), _HEAT)
        below = axes.inset_axes((0.1, -0.1, 0.8, 0.04))
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


class Transported(NamedTuple):
    """A photograph and the transport plan of its patches."""

    image: UInt8[np.ndarray, "h w 3"]
    masses: Float[np.ndarray, "row column destination"]
    """Mass from each patch to each cluster; a dustbin comes last."""
    clusters: int

    @property
    def taken(self) -> Float[np.ndarray, "row column cluster"]:
        """Mass from each patch to each cluster."""
        return self.masses[..., : self.clusters]

    @property
    def dustbin(self) -> Float[np.ndarray, "row column"] | None:
        """Share of each patch's mass in the dustbin; None without a dustbin."""
        if self.masses.shape[-1] == self.clusters:
            return None
        return self.masses[..., self.clusters] / self.masses.sum(axis=-1)

    @property
    def dustbin_share(self) -> float | None:
        """Share of all mass in the dustbin; None without a dustbin."""
        if self.dustbin is None:
            return None
        return float(self.masses[..., self.clusters].sum() / self.masses.sum())

    @property
    def top(self) -> Int[np.ndarray, "row column"]:
        """Cluster that took most of each patch."""
        return self.taken.argmax(axis=-1)


def transport_of(image: Pixels, params: Crisalad, config: ModelConfig) -> Transported:
    """Compute the transport of a photograph, resized as the configuration says."""
    prepared = prepare_image(image, config)
    grid = config.backbone.grid((prepared.shape[0], prepared.shape[1]))
    (mass,) = np.asarray(transport_masses(params, prepared[None], config), np.float32)
    return Transported(image, mass.reshape(*grid, -1), config.token_shape.tokens)


def strongest_clusters(
    pictures: Sequence[Transported], most: int = len(CLUSTER_COLOURS)
) -> dict[int, float]:
    """Find the clusters that take most mass from the patches that they win.

    A cluster wins a patch if it takes more of it than any other does. Each cluster comes with that
    mass as a share of all mass that clusters took, largest first. (Over all patches of an image
    every cluster takes the same mass, so that total would not rank them.)
    """
    mass = np.zeros(pictures[0].clusters)
    for picture in pictures:
        np.add.at(mass, picture.top, picture.taken.max(axis=-1))
    total = sum(picture.taken.sum() for picture in pictures)
    order = np.argsort(-mass, kind="stable")[:most]
    return {int(cluster): float(mass[cluster] / total) for cluster in order if mass[cluster] > 0}


def heat_range(pictures: Sequence[Transported]) -> tuple[float, float]:
    """Find the smallest and largest share of a patch in the dustbin, as one scale for all."""
    shares = [picture.dustbin for picture in pictures if picture.dustbin is not None]
    values = np.concatenate(shares, axis=None)
    return float(values.min()), float(values.max())


def heat_gradient() -> str:
    """Return the colours of the dustbin's scale as CSS."""
    stops = matplotlib.colormaps[_HEAT](np.linspace(0, 1, 9))
    return ", ".join(map(colors.to_hex, stops))


def draw_dustbin(
    picture: Transported, limits: tuple[float, float], width: int = 320
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Draw each patch's share in the dustbin over the grey photograph.

    Patches are dark at the lower end of the scale and bright at the upper; `limits` are its ends.
    """
    assert picture.dustbin is not None
    low, high = limits
    heat = 255 * matplotlib.colormaps[_HEAT]((picture.dustbin - low) / max(high - low, 1e-6))
    return _over(picture.image, heat[..., :3], np.full(heat.shape[:2], _OPACITY), width)


def draw_clusters(
    picture: Transported, chosen: Sequence[int], width: int = 320
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Draw each patch in the colour of its top cluster over the grey photograph.

    The colour's strength is the mass that clusters took of the patch, over the largest in the
    picture. Patches whose top cluster is not `chosen` stay grey.
    """
    taken = picture.taken.sum(axis=-1)
    strength = np.where(np.isin(picture.top, chosen), taken / taken.max(), 0)
    over = np.zeros((*taken.shape, 3))
    for cluster, colour in zip(chosen, CLUSTER_COLOURS, strict=False):
        over[picture.top == cluster] = 255 * np.array(colors.to_rgb(colour))
    return _over(picture.image, over, (0.25 + _OPACITY * strength) * (strength > 0), width)


def _over(
    image: UInt8[np.ndarray, "h w 3"],
    over: Float[np.ndarray, "row column 3"],
    opacity: Float[np.ndarray, "row column"],
    width: int,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Blend patches over a grey photograph of this width; they tile any aspect ratio."""
    height = max(1, round(width * min(image.shape[0] / image.shape[1], 2)))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(float)
    rows, columns = opacity.shape
    row = np.arange(height) * rows // height
    column = np.arange(width) * columns // width
    alpha = opacity[row][:, column, None]
    mixed = (1 - alpha) * grey[..., None] + alpha * over[row][:, column]
    return np.clip(np.round(mixed), 0, 255).astype(np.uint8)
