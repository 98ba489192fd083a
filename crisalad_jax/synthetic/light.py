"""Compute light on surfaces: the colours of parts by hour, weather and season."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from crisalad_jax.synthetic.mesh import Colour, Kind, Place, Rng, Scene, Vector, palette
from crisalad_jax.synthetic.view import SEASONS, Season, Time, View, Weather


class Light(NamedTuple):
    """The light on a place, and its sky's colours; arrays are red, green and blue, 0 to 1."""

    ambient: np.ndarray
    sun: np.ndarray
    zenith: np.ndarray
    horizon: np.ndarray
    elevation: float
    """Height of the sun above the horizon, in degrees."""
    lit: float
    """Brightness of lamps and windows, 0 to 1."""
    veil: np.ndarray = np.full(3, 0.22)
    """Colour into which distant parts fade."""
    visibility: float = 45.0
    """Metres over which contrast falls to 1/e."""
    to_sun: np.ndarray = np.zeros(3)
    """Unit vector towards the sun in the place's axes: x right, y up, z along the street."""


_OUTDOORS: dict[Time, Light] = {
    "noon": Light(*palette("58 62 68, 66 61 52, 28 48 80, 76 85 93"), elevation=48.0, lit=0.0),
    "dusk": Light(*palette("45 40 46, 52 33 18, 24 27 47, 93 64 45"), elevation=11.0, lit=0.5),
    "night": Light(*palette("25 26 36, 0 0 0, 3 4 10, 13 13 20"), elevation=40.0, lit=1.0),
}
_INDOORS: dict[Time, Light] = {
    "noon": Light(*palette("72 71 69, 22 22 21, 92 95 100, 92 95 100"), elevation=65.0, lit=0.25),
    "dusk": Light(*palette("72 71 69, 22 22 21, 55 50 52, 55 50 52"), elevation=65.0, lit=0.6),
    "night": Light(*palette("72 71 69, 22 22 21, 6 6 10, 6 6 10"), elevation=65.0, lit=0.8),
}
"""Light indoors; the sky is what windows show."""
_AIRS: dict[Weather, tuple[float, ...]] = {
    "clear": (1.0, 1.0, 0.0, 1.0, 900.0),
    "overcast": (0.12, 1.2, 0.8, 0.95, 500.0),
    "haze": (0.35, 1.15, 0.75, 0.95, 75.0),
    "rain": (0.05, 1.05, 0.9, 0.8, 190.0),
}
"""By weather: shares of the sunlight and the ambient light that come through, share of grey in the
sky's colours, brightness of that grey relative to the clear horizon, and visibility in metres."""
_SUN_HEIGHT: dict[Season, float] = {"spring": 0.85, "summer": 1.2, "autumn": 0.85, "winter": 0.5}
_LEAVES: dict[Season, tuple[Colour, ...]] = {
    "spring": palette("44 56 22, 74 60 62"),
    "summer": palette("20 37 13, 30 43 16"),
    "autumn": palette("70 46 12, 60 23 10"),
    "winter": palette("40 34 29, 40 34 29"),
}
"""Two hues per season, between which leaves vary; in winter trees have none, and bushes twigs."""
_SNOW: dict[int, float] = {
    Kind.ROOF: 0.92,
    Kind.LEDGE: 0.75,
    Kind.PAVEMENT: 0.85,
    Kind.ROAD: 0.5,
    Kind.GRASS: 0.95,
    Kind.SOIL: 0.8,
    Kind.BUSH: 0.3,
    Kind.NEEDLE: 0.4,
}
"""Share of a surface that snow covers, by kind."""
GRASS = dict(zip(SEASONS, palette("40 54 24, 38 46 22, 50 44 25, 40 46 34"), strict=True))
SNOW_COLOUR = np.array((0.90, 0.92, 0.96))
GLOW: dict[int, tuple[float, Vector]] = {
    Kind.GLASS: (0.34, (1.0, 0.78, 0.42)),
    Kind.SHOP: (0.8, (0.92, 0.82, 0.60)),
    Kind.LAMP: (1.0, (1.0, 0.88, 0.62)),
    Kind.HEADLIGHT: (1.0, (1.0, 0.97, 0.86)),
    Kind.TAILLIGHT: (1.0, (0.95, 0.12, 0.08)),
}
"""Share of polygons that shine after dark, and the colour of their light, by kind."""


def light_of(view: View, place: Place, rng: Rng) -> Light:
    """Return the light of the hour, weather and season; indoors it depends only on the hour.

    The sun's direction is drawn at random: about south at noon, west at dusk.
    """
    light = (_INDOORS if place.indoors else _OUTDOORS)[view.time]
    if not place.indoors:
        sun, ambient, share, brightness, visibility = _AIRS[view.weather]
        grey = sum(light.horizon) / 3 * brightness
        zenith, horizon = (sky + (grey - sky) * share for sky in (light.zenith, light.horizon))
        light = light._replace(
            ambient=light.ambient * ambient,
            sun=light.sun * sun,
            elevation=light.elevation * _SUN_HEIGHT[view.season],
            zenith=zenith,
            horizon=horizon,
            veil=horizon,
            visibility=visibility,
        )
    compass = (270.0 if view.time == "dusk" else 180.0) + rng.uniform(-50, 50)
    azimuth, elevation = np.deg2rad(compass - place.bearing), np.deg2rad(light.elevation)
    level = np.cos(elevation)
    to_sun = np.array((np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level))
    return light._replace(to_sun=to_sun)


def part_colours(
    scene: Scene, depth: Float[np.ndarray, " part"], view: View, light: Light
) -> Float[np.ndarray, "part 3"]:
    """Compute each part's colour from material, season, light and haze at `depth` in metres."""
    albedo = scene.albedo.copy()
    leaf = np.isin(scene.kind, (Kind.LEAF, Kind.BUSH))
    first, second = _LEAVES[view.season]
    hue, shade = albedo[leaf, 0:1], albedo[leaf, 1:2]
    albedo[leaf] = (first * (1 - hue) + second * hue) * shade
    albedo[scene.kind == Kind.GRASS] = GRASS[view.season]
    if view.season == "winter":
        share = _by_kind(scene, _SNOW)[:, None]
        albedo = albedo * (1 - share) + SNOW_COLOUR * share
    if view.weather == "rain":
        albedo[np.isin(scene.kind, (Kind.ROAD, Kind.PAVEMENT))] *= 0.72
    facing = np.clip(scene.normal @ light.to_sun, 0, None)[:, None]
    skyward = 0.85 + 0.15 * scene.normal[:, 1:2]
    colour = albedo * (light.ambient * skyward + light.sun * facing)
    if view.repaint:
        rng = np.random.default_rng((view.seed, 5))
        paint = rng.normal(0, view.repaint, (len(colour), 1))
        tint = rng.normal(0, view.repaint / 3, colour.shape)
        colour *= np.exp(paint + tint)
    colour[scene.kind == Kind.GLASS] += 0.16 * light.zenith
    window = scene.kind == Kind.WINDOW
    colour[window] = light.horizon * scene.albedo[window]
    haze = 1 - np.exp(-np.clip(depth, 0, 2000) / light.visibility)[:, None]
    return colour * (1 - haze) + light.veil * haze


def shining(
    scene: Scene, draw: Float[np.ndarray, " polygon"], lit: float
) -> Bool[np.ndarray, " polygon"]:
    """Choose the polygons that shine: where `draw` is below their `GLOW` share, scaled by `lit`."""
    gain = 0.35 + 0.65 * lit if lit else 0.0
    share = _by_kind(scene, {kind: share * gain for kind, (share, _) in GLOW.items()})
    return draw < np.repeat(share, scene.part_sizes)


def _by_kind(scene: Scene, values: dict[int, float]) -> Float[np.ndarray, " part"]:
    """Look up every part's value by its kind, 0 by default."""
    table = np.zeros(max(Kind) + 1)
    table[list(values)] = list(values.values())
    return table[scene.kind]
