"""Render a world to train on: streets, rooms and more, in the layouts of real data sets."""

import dataclasses
import os
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal, get_args

import numpy as np

from crisalad_jax.config.checks import PositiveInt, Seed, check_types, limited, require
from crisalad_jax.synthetic.layouts import (
    Files,
    Shot,
    derive_seed,
    gsv_city,
    jpeg,
    utm_images,
    write_set,
)
from crisalad_jax.synthetic.mesh import Reach, Rng
from crisalad_jax.synthetic.picture import build_place, render
from crisalad_jax.synthetic.view import (
    SCENERIES,
    SEASONS,
    TIMES,
    WEATHERS,
    Repaint,
    Scenery,
    View,
    check_size,
)

Variation = Literal["stand", "season", "time", "weather", "traffic", "exposure"]
"""What varies between images of a place, besides paint; "exposure" includes the sensor noise.

The sun's position, clouds and white balance depend on `View.seed`, which always varies.
"""
VARIATIONS: tuple[Variation, ...] = get_args(Variation)
_FIELDS: dict[Variation, tuple[str, ...]] = {
    "stand": ("lateral", "forward", "heading", "height", "pitch", "field"),
    "traffic": ("occluders", "crowd"),
    "exposure": ("exposure", "noise"),
}
"""Fields of `View` that a variation changes, if not just the field of the same name."""
_SCENES_PER_CITY = 12
_SPACING = 100.0
"""Metres between places in the files; stations of a scene are closer."""


@dataclasses.dataclass(frozen=True)
class WorldConfig:
    """Size and seed of a world."""

    scenes: PositiveInt = 2400
    """Number of training scenes, divided among the kinds of `sceneries`."""
    stations: PositiveInt = 4
    """Number of places per scene, one behind another; they look similar."""
    images_per_place: PositiveInt = 4
    test_scenes: PositiveInt = 100
    """Number of further scenes for testing, with a database image and a query of each place."""
    image_size: tuple[int, int] = (120, 160)
    """Height and width in pixels."""
    sceneries: tuple[Scenery, ...] = SCENERIES
    repaint: Repaint = 0.3
    """Maximum of `View.repaint`, which is drawn for each image."""
    varied: tuple[Variation, ...] = VARIATIONS
    """What varies between the training images of a place. Other fields have the defaults of `View`;
    without "stand", all images of a place share one camera pose. Test images vary in everything."""
    hard: Annotated[float, limited(0, 1)] = 0.3
    """Share of hard images, taken from farther to the side, turned, some through a crowd."""
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check the types and ranges."""
        check_types(self)
        require(bool(self.sceneries), "WorldConfig.sceneries: found none, expected at least one")
        check_size("WorldConfig.image_size", self.image_size)

    @property
    def images(self) -> int:
        """Total number of images."""
        return (self.scenes * self.images_per_place + self.test_scenes * 2) * self.stations


def write_world(root: str | os.PathLike[str], config: WorldConfig, *, quiet: bool = False) -> bool:
    """Render a world into `root`, completely or not at all.

    `root/train` has the layout of GSV-Cities; a city is up to 12 scenes of one kind. `root/test`
    has that of VPR-datasets-downloader. Coordinates are placeholders: places are 100 m apart.

    Args:
        root: a folder that does not exist, or is empty, or holds this world.
        config: size and seed of the world.
        quiet: whether to hide the progress bar.

    Returns:
        Whether the world was written; False if it existed already.

    Raises:
        InputError: `root` is a file, holds something else, or cannot be written to.
    """
    return write_set(root, config, _files(config), quiet=quiet)


def _files(config: WorldConfig) -> Files:
    for city, first in enumerate(range(0, config.scenes, _SCENES_PER_CITY)):
        scenes = range(first, min(first + _SCENES_PER_CITY, config.scenes))
        scenery = config.sceneries[city % len(config.sceneries)]
        yield from gsv_city(f"{scenery}{city:04d}", 10.0, _shots(config, 0, scenes, scenery))
    config = dataclasses.replace(config, varied=VARIATIONS, images_per_place=2)
    for scene in range(config.test_scenes):
        scenery = config.sceneries[scene % len(config.sceneries)]
        yield from utm_images(_shots(config, 1, [scene], scenery), scenery)


def _shots(
    config: WorldConfig, split: int, scenes: Sequence[int], scenery: Scenery
) -> Iterator[Shot]:
    """Take the pictures of some scenes."""
    for scene in scenes:
        seed = derive_seed(config.seed, 2 + split, scene)
        for station in range(config.stations):
            # Training places are counted from 1.
            place = scene * config.stations + station + (1 - split)
            rng = np.random.default_rng((config.seed, split, scene, station))
            for view in views(config, seed, scenery, station, rng):
                picture = jpeg(render(seed, view, config.image_size, scenery))
                yield Shot(place, view, picture, rng, north=place * _SPACING)


def views(config: WorldConfig, seed: int, scenery: Scenery, station: int, rng: Rng) -> list[View]:
    """Draw the views of a station's images: the scene's camera, and what varies between images."""
    reach = build_place(seed, scenery).reach
    camera = np.random.default_rng((seed, 6))
    plain = View(
        forward=station * reach.step,
        height=camera.uniform(*reach.height),
        field=camera.uniform(55.0, 95.0),
        pitch=camera.uniform(-4.0, 9.0),
    )
    still = set(VARIATIONS) - set(config.varied)
    fixed = {name: getattr(plain, name) for each in still for name in _FIELDS.get(each, (each,))}
    drawn = [_draw_view(plain, reach, config.repaint, rng) for _ in range(config.images_per_place)]
    apart = np.random.default_rng((seed, station, 7))
    hard = apart.random(len(drawn)) < config.hard
    drawn = [
        _harden(view, reach, apart) if at else view for view, at in zip(drawn, hard, strict=True)
    ]
    return [dataclasses.replace(view, **fixed) for view in drawn]


def _harden(view: View, reach: Reach, rng: Rng) -> View:
    """Move the camera far to the side and turn it, and add a crowd to a third of busy views."""
    return dataclasses.replace(
        view,
        lateral=rng.uniform(-2.2, 2.2) * reach.lateral,
        heading=rng.uniform(-22, 22),
        pitch=view.pitch + rng.uniform(-4, 4),
        field=view.field * rng.uniform(0.85, 1.15),
        crowd=int(rng.integers(5, 40)) if rng.random() < 1 / 3 else 0,
    )


def _draw_view(plain: View, reach: Reach, repaint: float, rng: Rng) -> View:
    """Draw a view near the plain one."""
    time = TIMES[rng.choice(3, p=(0.6, 0.25, 0.15))]
    return View(
        lateral=rng.uniform(-1, 1) * reach.lateral,
        forward=plain.forward + rng.uniform(-1, 1) * reach.forward,
        heading=rng.uniform(-5, 5),
        height=plain.height * rng.uniform(0.93, 1.07),
        pitch=plain.pitch + rng.uniform(-1.5, 1.5),
        field=plain.field * rng.uniform(0.95, 1.05),
        repaint=rng.uniform(0, repaint),
        season=SEASONS[rng.integers(4)],
        time=time,
        weather=WEATHERS[rng.choice(4, p=(0.45, 0.3, 0.13, 0.12))],
        occluders=int(rng.integers(2**31)) if rng.random() < 0.6 else None,
        exposure=rng.uniform(-0.5, 0.6),
        noise=rng.uniform(1, 5) + 2 * (time == "night"),
        seed=int(rng.integers(2**31)),
    )
