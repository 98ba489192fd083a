"""The transport plan of a model drawn over photographs: its clusters, and its dustbin."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from crisalad_jax.config.checks import takes
from crisalad_jax.data.images import read_pixels
from crisalad_jax.data.prepare import as_rgb
from crisalad_jax.data.resize import Pixels
from crisalad_jax.experiments.report.gallery import thumbnail
from crisalad_jax.experiments.report.style import INK, Picture, new_figure, scale_below
from crisalad_jax.nn.model import Model, check_params, transport_masses
from crisalad_jax.retrieval.describe import prepare_image

CLUSTER_COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7")
"""Okabe and Ito's colours, which the colour-blind can tell apart, on a grey photograph."""
HEAT = "inferno"
_OPACITY = 0.65
_PIXELS = 480
Image = str | os.PathLike[str] | Pixels
"""An image file, or an array that `prepare_image` takes."""


@takes(model=Model)
def show_transport(image: Image, model: Model) -> Picture:
    """Draw an image, the share of each patch in the dustbin, and the cluster that took most of it.

    The seven strongest clusters have colours; patches that went to others stay grey. A colour is
    stronger the more mass all clusters took from the patch. The dustbin takes patches that belong
    to no cluster; for a transport without it, there is no middle panel.

    Args:
        image: an image file, or an array that `prepare_image` takes.
        model: a model from `load`.

    Returns:
        A figure for notebooks; `figure.savefig(path)` writes it as PNG, SVG or PDF.

    Raises:
        InputError: the aggregator has no transport, the parameters do not fit the configuration,
            or the image cannot be read or described.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad
        >>> config = PRESETS["tiny"]
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> figure = show_transport(pictures / "0.png", model)
        >>> [axes.get_title(loc="left").split(",")[0] for axes in figure.axes[:3]]
        ['80 x 60 pixels', 'dustbin: 67 %', 'top clusters']
    """
    check_params(*model)
    picture = transport_of(read_rgb(image, model), model)
    return draw_transport({"": picture}, [picture], photographs=True)


def read_rgb(image: Image, model: Model) -> Pixels:
    """Read an image if it is a file; convert it to 8-bit RGB as the model's configuration says."""
    pixels = read_pixels(image) if isinstance(image, str | os.PathLike) else image
    return as_rgb(pixels, model.config.preprocessing.bit_depth)


class Transported(NamedTuple):
    """An RGB photograph, the transport plan of its patches, and the number of clusters."""

    image: UInt8[np.ndarray, "h w 3"]
    masses: Float[np.ndarray, "row column destination"]
    """Mass from each patch to each cluster, and last to the dustbin, if there is one."""
    clusters: int

    @property
    def taken(self) -> Float[np.ndarray, "row column cluster"]:
        """Mass from each patch to each cluster."""
        return self.masses[..., : self.clusters]

    @property
    def dustbin(self) -> Float[np.ndarray, "row column"] | None:
        """Share of each patch's mass that went to the dustbin, 0 to 1; None without a dustbin."""
        if self.masses.shape[-1] == self.clusters:
            return None
        return self.masses[..., self.clusters] / self.masses.sum(axis=-1)

    @property
    def top(self) -> Int[np.ndarray, "row column"]:
        """Index of the cluster that took the most mass from each patch."""
        return self.taken.argmax(axis=-1)


def transport_of(image: Pixels, model: Model) -> Transported:
    """Compute the transport plan of an RGB image, resized as the configuration says."""
    params, config = model
    prepared = prepare_image(image, config)
    grid = config.backbone.grid((prepared.shape[0], prepared.shape[1]))
    (mass,) = np.asarray(transport_masses(params, prepared[None], config), np.float32)
    return Transported(image, mass.reshape(*grid, -1), config.token_shape.tokens)


def strongest_clusters(pictures: Sequence[Transported]) -> dict[int, float]:
    """Find up to seven clusters that take the most mass from the patches that they win.

    A cluster wins a patch if it takes more mass from it than any other cluster. The result maps the
    index of each cluster to its mass from these patches, as a share of the mass of all clusters,
    largest first. (The mass from all patches is the same for each cluster, so it cannot rank them.)
    """
    mass = np.zeros(pictures[0].clusters)
    for picture in pictures:
        np.add.at(mass, picture.top, picture.taken.max(axis=-1))
    total = sum(picture.taken.sum() for picture in pictures)
    order = np.argsort(-mass, kind="stable")[: len(CLUSTER_COLOURS)]
    return {int(cluster): float(mass[cluster] / total) for cluster in order if mass[cluster] > 0}


def draw_transport(
    pictures: Mapping[str, Transported], among: Sequence[Transported], *, photographs: bool
) -> Picture:
    """Draw pictures in rows: each patch's share in the dustbin, and its top cluster.

    Args:
        pictures: the pictures to draw, by the name of their row.
        among: the pictures from which the scale and the coloured clusters are chosen.
        photographs: whether each row begins with the photograph itself, in a larger figure.
    """
    clusters = strongest_clusters(among)
    shares = [picture.dustbin for picture in among if picture.dustbin is not None]
    columns = 1 + bool(shares) + photographs
    panel, dpi = (3.4, 100) if photographs else (2.0, 200)
    heights = [panel * min(each.image.shape[0] / each.image.shape[1], 2) for each in among]
    height = len(pictures) * (max(heights) + 0.2) + 1.2
    figure = new_figure(height, width=columns * panel, dpi=dpi)
    panels = figure.subplots(len(pictures), columns, squeeze=False)
    for (name, picture), (*first, last) in zip(pictures.items(), panels, strict=True):
        height, width = picture.image.shape[:2]
        image = thumbnail(picture.image, _PIXELS)
        if photographs:
            rows, across = picture.masses.shape[:2]
            draw_panel(first[0], image, f"{width} x {height} pixels, {rows} x {across} patches")
        if picture.dustbin is not None:
            share = picture.masses[..., picture.clusters].sum() / picture.masses.sum()
            draw_panel(first[-1], image, f"dustbin: {100 * share:.0f} %", picture.dustbin)
            first[-1].images[-1].set_clim(np.min(shares), np.max(shares))
        draw_panel(last, image, "top clusters", _cluster_colours(picture, list(clusters)))
        (first or [last])[0].set_ylabel(name, fontsize=9, color=INK)
    if shares:
        ends = float(np.min(shares)), float(np.max(shares))
        scale_below(figure, panels, HEAT, ends, "share of the patch in the dustbin")
    look: Any = {"loc": "outside lower center", "ncols": 4, "fontsize": 8, "title_fontsize": 8}
    look |= {"frameon": False, "handlelength": 1, "columnspacing": 1}
    figure.legend(
        handles=[
            Patch(color=colour, label=f"{number}: {100 * part:.0f} %")
            for colour, (number, part) in zip(CLUSTER_COLOURS, clusters.items(), strict=False)
        ],
        title="cluster: share of what clusters took",
        **look,
    )
    return figure


def draw_panel(axes: Axes, image: Pixels, title: str, over: np.ndarray | None = None) -> None:
    """Draw a photograph; with `over`, in grey below a value or an RGBA colour of each patch."""
    axes.set(xticks=[], yticks=[], anchor="N")
    axes.spines[:].set_visible(False)
    axes.set_title(title, loc="left", fontsize=9, color=INK)
    if over is None:
        axes.imshow(image)
        return
    axes.imshow(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), "gray", vmin=0, vmax=255)
    alpha = _OPACITY if over.ndim == 2 else None
    extent = (-0.5, image.shape[1] - 0.5, image.shape[0] - 0.5, -0.5)
    axes.imshow(over, HEAT, alpha=alpha, interpolation="nearest", extent=extent)


def _cluster_colours(
    picture: Transported, chosen: Sequence[int]
) -> Float[np.ndarray, "row column 4"]:
    """Colour each patch by its top cluster, as RGBA; clusters not `chosen` are transparent.

    The opacity is the mass that clusters took from the patch, relative to the picture's largest.
    """
    taken = picture.taken.sum(axis=-1)
    shown = np.zeros((*taken.shape, 4))
    for cluster, colour in zip(chosen, CLUSTER_COLOURS, strict=False):
        patches = (picture.top == cluster) & (taken > 0)
        shown[patches, :3] = colors.to_rgb(colour)
        shown[patches, 3] = 0.25 + _OPACITY * taken[patches] / taken.max()
    return shown
