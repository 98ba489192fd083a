"""A world on disk to learn from: streets, corridors and country, in the layouts of real sets."""

import dataclasses
import os
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, get_args

import numpy as np

from crisalad_jax.config.checks import check_seed, check_types
from crisalad_jax.experiments.synthetic.city import (
    METRES_PER_DEGREE,
    MONTHS,
    UTM_ORIGIN,
    gsv_image,
    holds,
    panoid,
    write_gsv_table,
    write_jpeg,
)
from crisalad_jax.experiments.synthetic.picture import render
from crisalad_jax.experiments.synthetic.place import Place
from crisalad_jax.experiments.synthetic.scenes import build_place
from crisalad_jax.experiments.synthetic.view import (
    SCENERIES,
    SEASONS,
    TIMES,
    WEATHERS,
    Scenery,
    View,
    check_repaint,
    check_size,
)
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import wrap_os_errors, write_json
from crisalad_jax.utils.temporaries import in_use, made_folder, temporary_beside

Variation = Literal["stand", "season", "time", "weather", "traffic", "exposure"]
"""What changes from image to image of a place, besides paint; exposure has the noise with it.

The sun's place, the clouds and the white balance come of a picture's seed, which always changes.
"""
VARIATIONS: tuple[Variation, ...] = get_args(Variation)
_FIELDS: dict[Variation, tuple[str, ...]] = {
    "stand": ("lateral", "forward", "heading", "height", "pitch", "field"),
    "season": ("season",),
    "time": ("time",),
    "weather": ("weather",),
    "traffic": ("occluders",),
    "exposure": ("exposure", "noise"),
}
"""Fields of `View` that are one variation."""
RENDERER = 1
"""Version of the world: increase it if pictures change."""
SCENES_PER_CITY = 12
SPACING = 100.0
"""Metres between places in the files, where stations of a scene lie nearer in truth."""


@dataclasses.dataclass(frozen=True)
class WorldConfig:
    """Size and seed of a world."""

    scenes: int = 2400
    """Scenes to train on, of streets, corridors and country in turn."""
    stations: int = 4
    """Places of a scene, one behind the other: they look alike."""
    images_per_place: int = 4
    test_scenes: int = 100
    """Other scenes, with two images of each station: one to find and one to ask with."""
    image_size: tuple[int, int] = (120, 160)
    """Height and width in pixels."""
    sceneries: tuple[Scenery, ...] = SCENERIES
    repaint: float = 0.3
    """Largest `View.repaint`."""
    varied: tuple[Variation, ...] = VARIATIONS
    """What changes between the training images of a place. The rest is as in a plain `View`, the
    stand as the scene's camera. Test images change in all of these."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the types and ranges."""
        check_types(self)
        for name in ("scenes", "stations", "images_per_place", "test_scenes"):
            value = getattr(self, name)
            if value < 1:
                raise InputError(f"WorldConfig.{name}: found {value}, expected at least 1")
        check_repaint("WorldConfig.repaint", self.repaint)
        if not self.sceneries:
            raise InputError("WorldConfig.sceneries: found (), expected at least one scenery")
        check_seed("WorldConfig.seed", self.seed)
        check_size("WorldConfig.image_size", self.image_size)


def write_world(
    root: str | os.PathLike[str],
    config: WorldConfig,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render a world into `root`, whole or not at all.

    `root/train` has the layout of GSV-Cities; a city is some scenes of one kind. `root/test` has
    that of VPR-datasets-downloader. Coordinates are placeholders: places are 100 m apart.

    Args:
        root: a folder that does not exist, or is empty, or holds this world.
        config: how many scenes and images, their size, the seed.
        progress: called after every place with the number done and the number of all.

    Raises:
        InputError: `root` is a file, holds something else, or cannot be written to.
    """
    if has_world(root, config):
        return
    root = pathlib.Path(root)
    total = (config.scenes + config.test_scenes) * config.stations
    temporary = temporary_beside(root)
    with made_folder(root.parent), in_use(temporary):
        for number, _ in enumerate(_write(temporary, root, config), start=1):
            if progress is not None:
                progress(number, total)


def has_world(root: str | os.PathLike[str], config: WorldConfig) -> bool:
    """Return whether `root` holds this world already; False where it can be written there.

    Args:
        root: a folder.
        config: the world.

    Raises:
        InputError: `root` is a file, or holds something else.
    """
    root = pathlib.Path(root)
    return root.exists() and holds(root, _identity(config), "world.json", "a rendered world")


def _identity(config: WorldConfig) -> dict[str, Any]:
    """Return what world.json has of a world."""
    lists = {"image_size": list(config.image_size), "sceneries": list(config.sceneries)}
    varied = [name for name in VARIATIONS if name in config.varied]
    return {"renderer": RENDERER, **dataclasses.asdict(config), **lists, "varied": varied}


def _write(temporary: pathlib.Path, root: pathlib.Path, config: WorldConfig) -> Iterator[None]:
    """Write the world into `temporary`, then rename that to `root`; yield after every place.

    Raises:
        InputError: the world cannot be written there.
    """
    with wrap_os_errors(root):
        temporary.mkdir()
        for city in range(-(-config.scenes // SCENES_PER_CITY)):
            scenery = config.sceneries[city % len(config.sceneries)]
            first = city * SCENES_PER_CITY
            scenes = range(first, min(first + SCENES_PER_CITY, config.scenes))
            name = f"{scenery}{city:04d}"
            yield from _write_city(temporary / "train", config, name, scenery, scenes)
        yield from _write_test(temporary / "test" / "images" / "test", config)
        write_json(temporary / "world.json", _identity(config))
        os.replace(temporary, root)


def _write_city(
    root: pathlib.Path,
    config: WorldConfig,
    name: str,
    scenery: Scenery,
    scenes: Sequence[int],
) -> Iterator[None]:
    images = root / "Images" / name
    images.mkdir(parents=True)
    rows: list[str] = []
    for scene in scenes:
        for station in range(config.stations):
            place_id = scene * config.stations + station + 1
            lat = f"{10 + place_id * SPACING / METRES_PER_DEGREE:.7f}"
            rng = np.random.default_rng((config.seed, 0, scene, station))
            seed = _seed(config, 0, scene)
            for view in views(config, seed, scenery, station, config.images_per_place, rng):
                year, month = int(rng.integers(2012, 2022)), MONTHS[view.season]
                position = lat, "-40.0000000"
                row, file = gsv_image(name, place_id, (year, month), 0, position, panoid(rng))
                rows.append(row)
                write_jpeg(images / file, render(seed, view, config.image_size, scenery))
            yield
    write_gsv_table(root, name, rows)


def _write_test(folder: pathlib.Path, config: WorldConfig) -> Iterator[None]:
    config = dataclasses.replace(config, varied=VARIATIONS)
    for side in ("database", "queries"):
        (folder / side).mkdir(parents=True)
    for scene in range(config.test_scenes):
        scenery = config.sceneries[scene % len(config.sceneries)]
        for station in range(config.stations):
            rng = np.random.default_rng((config.seed, 1, scene, station))
            north = UTM_ORIGIN[1] + (scene * config.stations + station) * SPACING
            seed = _seed(config, 1, scene)
            found = views(config, seed, scenery, station, 2, rng)
            for side, view in zip(("database", "queries"), found, strict=True):
                fields = [""] * 14
                fields[:4] = f"{UTM_ORIGIN[0]:.2f}", f"{north:.2f}", "32", "T"
                fields[6], fields[13] = panoid(rng), f"{scenery}_{view.season}_{view.time}"
                path = folder / side / f"@{'@'.join(fields)}@.jpg"
                write_jpeg(path, render(seed, view, config.image_size, scenery))
            yield


def _seed(config: WorldConfig, split: int, scene: int) -> int:
    entropy = (config.seed, 2 + split, scene)
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0])


def views(
    config: WorldConfig,
    seed: int,
    scenery: Scenery,
    station: int,
    count: int,
    rng: np.random.Generator,
) -> list[View]:
    """Draw views of one station: a camera for the scene, and what changes from image to image."""
    place = build_place(seed, scenery)
    camera = np.random.default_rng((seed, 6))
    height, field = camera.uniform(*place.reach.height), camera.uniform(55.0, 95.0)
    pitch = camera.uniform(-4.0, 9.0)
    return [
        _view(config, place, (height, pitch, field), station * place.reach.step, rng)
        for _ in range(count)
    ]


def _view(
    config: WorldConfig,
    place: Place,
    camera: tuple[float, float, float],
    along: float,
    rng: np.random.Generator,
) -> View:
    height, pitch, field = camera
    reach = place.reach
    time = TIMES[rng.choice(3, p=(0.6, 0.25, 0.15))]
    view = View(
        lateral=float(rng.uniform(-1, 1) * reach.lateral),
        forward=float(along + rng.uniform(-1, 1) * reach.forward),
        heading=float(rng.uniform(-5, 5)),
        height=float(height * rng.uniform(0.93, 1.07)),
        pitch=float(pitch + rng.uniform(-1.5, 1.5)),
        field=float(field * rng.uniform(0.95, 1.05)),
        repaint=float(rng.uniform(0, config.repaint)),
        season=SEASONS[rng.integers(4)],
        time=time,
        weather=WEATHERS[rng.choice(4, p=(0.45, 0.3, 0.13, 0.12))],
        occluders=int(rng.integers(2**31)) if rng.random() < 0.6 else None,
        exposure=float(rng.uniform(-0.5, 0.6)),
        noise=float(rng.uniform(1, 5) + 2 * (time == "night")),
        seed=int(rng.integers(2**31)),
    )
    plain = View(forward=along, height=height, pitch=pitch, field=field)
    still = [name for one in _FIELDS if one not in config.varied for name in _FIELDS[one]]
    return dataclasses.replace(view, **{name: getattr(plain, name) for name in still})
