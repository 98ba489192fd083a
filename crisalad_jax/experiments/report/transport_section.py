"""The section of a page on the transport of some photographs."""

import pathlib
from typing import NamedTuple

import matplotlib
import matplotlib.colors
import numpy as np

from crisalad_jax.data.images import read_image
from crisalad_jax.data.resize import Pixels
from crisalad_jax.experiments.report.embedding import Drawing, drawing
from crisalad_jax.experiments.report.query_selection import Shown
from crisalad_jax.experiments.report.sections import Subject
from crisalad_jax.experiments.report.transport import (
    CLUSTER_COLOURS,
    HEAT,
    Transported,
    draw_clusters,
    draw_dustbin,
    heat_range,
    strongest_clusters,
    write_picture,
)
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, transport_masses
from crisalad_jax.retrieval.describe import prepare_image


class Kept(NamedTuple):
    """Drawings of a photograph's transport."""

    title: str
    file: str
    share: float | None
    """Share of all mass in the dustbin; None without one."""
    drawings: list[Drawing]


class ClusterKey(NamedTuple):
    """A line of the legend."""

    colour: str
    number: int
    share: float
    """Share of the mass that clusters took."""


class Transport(NamedTuple):
    """The transport of queries, each followed by its first retrieval."""

    pictures: list[Kept]
    heat: tuple[float, float] | None
    """Ends of the dustbin's scale; None without a dustbin."""
    gradient: str
    """Colours of the scale, as CSS."""
    clusters: list[ClusterKey]


def transport_section(
    subject: Subject, shown: Shown, params: Crisalad, config: ModelConfig, each: int = 2
) -> Transport | None:
    """Draw dustbin and clusters over `each` wrong and right queries and their retrievals.

    The result is None for a model without a transport.
    """
    if not config.aggregator.transports:
        return None
    chosen = shown.wrong[:each] + shown.right[:each] or shown.unmatched[:each]
    first = subject.neighbours.indices[:, 0]
    photographs = []
    for query in chosen:
        word = "right" if subject.verdicts.right[query] else "wrong"
        photographs += [
            ("Query", subject.benchmark.queries[query]),
            (f"Retrieved for it, {word}", subject.benchmark.database[first[query]]),
        ]
    pictures = transport_of([path for _, path in photographs], params, config)
    clusters = strongest_clusters(pictures)
    limits = None if pictures[0].dustbin is None else heat_range(pictures)
    panels = []
    for number, ((title, path), picture) in enumerate(zip(photographs, pictures, strict=True)):
        name = subject.name(path)
        parts = []
        if limits is not None:
            target = subject.out / f"transport_{number}_dustbin.png"
            write_picture(target, draw_dustbin(picture, limits))
            parts.append(drawing(target, f"The dustbin's share of each patch of {name}"))
        target = subject.out / f"transport_{number}_clusters.png"
        write_picture(target, draw_clusters(picture, list(clusters)))
        parts.append(drawing(target, f"The top cluster of each patch of {name}"))
        panels.append(Kept(title, name, picture.dustbin_share, parts))
    keys = zip(CLUSTER_COLOURS, clusters.items(), strict=False)
    return Transport(
        panels, limits, _gradient(), [ClusterKey(colour, *entry) for colour, entry in keys]
    )


def transport_of(
    paths: list[pathlib.Path], params: Crisalad, config: ModelConfig
) -> list[Transported]:
    """Read photographs and compute their transport, one by one: their sizes may differ."""
    bit_depth = config.preprocessing.bit_depth
    return [
        transport_of_image(read_image(path, bit_depth=bit_depth), params, config) for path in paths
    ]


def transport_of_image(image: Pixels, params: Crisalad, config: ModelConfig) -> Transported:
    """Compute the transport of a photograph, resized as the configuration says."""
    prepared = prepare_image(image, config)
    grid = config.backbone.grid((prepared.shape[0], prepared.shape[1]))
    (mass,) = np.asarray(transport_masses(params, prepared[None], config), np.float32)
    return Transported(image, mass.reshape(*grid, -1), config.token_shape.tokens)


def _gradient() -> str:
    stops = matplotlib.colormaps[HEAT](np.linspace(0, 1, 9))
    return ", ".join(matplotlib.colors.to_hex(stop) for stop in stops)
