"""SALAD's transport plan drawn over a photograph: its clusters, and its dustbin."""

import os
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import matplotlib
import numpy as np
from jaxtyping import Float, Int, UInt8

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_path

CLUSTER_COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7")
"""Okabe and Ito's colours, which the colour-blind can tell apart, on a grey photograph."""
HEAT = "inferno"
_OPACITY = 0.65


class Transported(NamedTuple):
    """A photograph and the transport plan of its patches."""

    image: UInt8[np.ndarray, "h w 3"]
    masses: Float[np.ndarray, "row column destination"]
    """Mass from each patch to each cluster; a dustbin comes last."""
    clusters: int

    @property
    def dustbin(self) -> Float[np.ndarray, "row column"] | None:
        """Share of each patch's mass in the dustbin; None without a dustbin."""
        if self.masses.shape[-1] == self.clusters:
            return None
        return self.masses[..., self.clusters] / self.masses.sum(axis=-1)

    @property
    def dustbin_share(self) -> float | None:
        """Share of all mass in the dustbin; None without a dustbin."""
        if self.masses.shape[-1] == self.clusters:
            return None
        return float(self.masses[..., self.clusters].sum() / self.masses.sum())

    @property
    def top(self) -> Int[np.ndarray, "row column"]:
        """Cluster that took most of each patch."""
        return self.masses[..., : self.clusters].argmax(axis=-1)


def strongest_clusters(
    pictures: Sequence[Transported], most: int = len(CLUSTER_COLOURS)
) -> dict[int, float]:
    """Find the clusters that take most mass from the patches that they win.

    A cluster wins a patch if it takes more of it than any other does. Each cluster comes with that
    mass as a share of all mass that clusters took, largest first. (Over all patches of an image
    every cluster takes the same mass, so that total would not rank them.)
    """
    mass = np.zeros(pictures[0].clusters)
    total = 0.0
    for picture in pictures:
        taken = picture.masses[..., : picture.clusters]
        np.add.at(mass, picture.top, taken.max(axis=-1))
        total += taken.sum()
    order = np.argsort(-mass, kind="stable")[:most]
    return {int(cluster): float(mass[cluster] / total) for cluster in order if mass[cluster] > 0}


def heat_range(pictures: Sequence[Transported]) -> tuple[float, float]:
    """Find the smallest and largest share of a patch in the dustbin, as one scale for all.

    Raises:
        InputError: there is no dustbin.
    """
    shares = [picture.dustbin for picture in pictures]
    if not shares or any(share is None for share in shares):
        raise InputError("transport: found no dustbin, expected one to draw")
    values = np.concatenate([share.ravel() for share in shares if share is not None])
    return float(values.min()), float(values.max())


def draw_dustbin(
    picture: Transported, limits: tuple[float, float], width: int = 320
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Draw each patch's share in the dustbin over the grey photograph.

    Patches are dark at the lower end of the scale and bright at the upper; `limits` are its ends.

    Raises:
        InputError: there is no dustbin.
    """
    shares = picture.dustbin
    if shares is None:
        raise InputError("transport: found no dustbin, expected one to draw")
    low, high = limits
    scaled = (shares - low) / max(high - low, 1e-6)
    heat = 255 * matplotlib.colormaps[HEAT](scaled)[..., :3]
    return _over(picture.image, heat, np.full(shares.shape, _OPACITY), width)


def draw_clusters(
    picture: Transported, chosen: Sequence[int], width: int = 320
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Draw each patch in the colour of its top cluster over the grey photograph.

    The colour's strength is the mass that clusters took of the patch, over the largest in the
    picture. Patches whose top cluster is not `chosen` stay grey.
    """
    taken = picture.masses[..., : picture.clusters].sum(axis=-1)
    strength = np.where(np.isin(picture.top, chosen), taken / taken.max(), 0)
    colours = np.zeros((*taken.shape, 3))
    for cluster, colour in zip(chosen, CLUSTER_COLOURS, strict=False):
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        colours[picture.top == cluster] = rgb
    return _over(picture.image, colours, (0.25 + _OPACITY * strength) * (strength > 0), width)


def _over(
    image: UInt8[np.ndarray, "h w 3"],
    colours: Float[np.ndarray, "row column 3"],
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
    mixed = (1 - alpha) * grey[..., None] + alpha * colours[row][:, column]
    return np.clip(np.round(mixed), 0, 255).astype(np.uint8)


def write_picture(path: str | os.PathLike[str], picture: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write RGB pixels as a PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        done, data = cv2.imencode(".png", picture[..., ::-1])
        if not done:
            raise InputError(f"{path}: cannot be written as a PNG")
        temporary.write_bytes(data.tobytes())
