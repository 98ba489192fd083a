"""`crisalad render`."""

import dataclasses
import pathlib
from typing import Annotated, Any

from crisalad_jax.cli.common import echo, pick
from crisalad_jax.cli.flags import FOLDER, JsonFlag, QuietFlag
from crisalad_jax.synthetic import (
    SCENERIES,
    VARIATIONS,
    Scenery,
    Variation,
    WorldConfig,
    write_world,
)
from crisalad_jax.utils.output import counted


class Render(JsonFlag, QuietFlag):
    """Render streets, rooms, countryside and more: places to train on, and others to test on."""

    out: Annotated[pathlib.Path, FOLDER]
    """Folder for the world: train/ in the layout of GSV-Cities, test/ in that of
    VPR-datasets-downloader."""
    scenes: int = WorldConfig.scenes
    """Number of scenes to train on."""
    stations: int = WorldConfig.stations
    """Number of places per scene, one behind another; they look similar."""
    images_per_place: int = WorldConfig.images_per_place
    """Number of images per place; weather, light, season, traffic and viewpoint vary."""
    test_scenes: int = WorldConfig.test_scenes
    """Number of other scenes, to test on."""
    image_size: tuple[int, int] = WorldConfig.image_size
    """Height and width of the images in pixels."""
    sceneries: tuple[Scenery, ...] = SCENERIES
    """Kinds of scenes, which take turns."""
    repaint: float = WorldConfig.repaint
    """Largest standard deviation of objects' log colour between images."""
    varied: tuple[Variation, ...] = VARIATIONS
    """What changes between a place's training images, in addition to paint. Test images vary in
    all of these."""
    hard: float = WorldConfig.hard
    """Share of images taken from far to the side, turned, or through a crowd."""
    seed: int = WorldConfig.seed
    """Seed of the world."""


def run(arguments: Render) -> dict[str, Any]:
    """Render the world, and print what is in it; return the result for --json."""
    given = pick(arguments, *(field.name for field in dataclasses.fields(WorldConfig)))
    config = WorldConfig(**given)
    places = config.scenes * config.stations
    is_new = write_world(arguments.out, config, quiet=arguments.quiet)
    tests = config.test_scenes * config.stations
    echo(
        f"{arguments.out}: {'' if is_new else 'already rendered, '}{counted(places, 'place')} with "
        f"{counted(config.images_per_place, 'image')} each in {arguments.out / 'train'}; "
        f"{counted(tests, 'other place')} in {arguments.out / 'test'}"
    )
    return {"out": str(arguments.out), "places": places, "test_places": tests} | given
