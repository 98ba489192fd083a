"""Light on surfaces: the colours of parts by hour, weather and season."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from crisalad_jax.synthetic.mesh import Colour, Kind, Scene, scaled
from crisalad_jax.synthetic.view import Season, Time, View, Weather


class Light(NamedTuple):
    """The light on a place, and the colours of its sky."""

    ambient: Colour
    sun: Colour
    elevation: float
    """Degrees of the sun over the horizon."""
    zenith: Colour
    horizon: Colour
    lit: float
    """Brightness of lamps and windows, 0 to 1."""
    veil: Colour = (0.0, 0.0, 0.0)
    """What distance turns into."""
    visibility: float = 900.0
    """Metres over which contrast falls to 1/e."""


_LIGHTS: dict[Time, Light] = {
    "noon": Light(
        ambient=(0.58, 0.62, 0.68),
        sun=(0.66, 0.61, 0.52),
        elevation=48.0,
        zenith=(0.28, 0.48, 0.80),
        horizon=(0.76, 0.85, 0.93),
        lit=0.0,
    ),
    "dusk": Light(
        ambient=(0.45, 0.40, 0.46),
        sun=(0.52, 0.33, 0.18),
        elevation=11.0,
        zenith=(0.24, 0.27, 0.47),
        horizon=(0.93, 0.64, 0.45),
        lit=0.5,
    ),
    "night": Light(
        ambient=(0.25, 0.26, 0.36),
        sun=(0.0, 0.0, 0.0),
        elevation=40.0,
        zenith=(0.03, 0.04, 0.10),
        horizon=(0.13, 0.13, 0.20),
        lit=1.0,
    ),
}


class _Air(NamedTuple):
    """The effect of weather on light."""

    sun: float
    """Share of the sunlight that comes through."""
    ambient: float
    veil: float
    """Share of grey in the sky's colours, 0 to 1."""
    grey: float
    """Brightness of that grey relative to the clear horizon."""
    visibility: float
    """Metres over which haze reduces contrast to 1/e."""


_AIRS: dict[Weather, _Air] = {
    "clear": _Air(sun=1.0, ambient=1.0, veil=0.0, grey=1.0, visibility=900.0),
    "overcast": _Air(sun=0.12, ambient=1.2, veil=0.8, grey=0.95, visibility=500.0),
    "haze": _Air(sun=0.35, ambient=1.15, veil=0.75, grey=0.95, visibility=75.0),
    "rain": _Air(sun=0.05, ambient=1.05, veil=0.9, grey=0.8, visibility=190.0),
}
_LAMPS = Light(
    ambient=(0.72, 0.71, 0.69),
    sun=(0.22, 0.22, 0.21),
    elevation=65.0,
    zenith=(0.92, 0.95, 1.0),
    horizon=(0.92, 0.95, 1.0),
    lit=0.25,
    veil=(0.22, 0.22, 0.22),
    visibility=45.0,
)
_INDOORS: dict[Time, Light] = {
    "noon": _LAMPS,
    "dusk": _LAMPS._replace(zenith=(0.55, 0.50, 0.52), horizon=(0.55, 0.50, 0.52), lit=0.6),
    "night": _LAMPS._replace(zenith=(0.06, 0.06, 0.10), horizon=(0.06, 0.06, 0.10), lit=0.8),
}
"""Light indoors; the sky is what windows show."""
_SUN_HEIGHT: dict[Season, float] = {"spring": 0.85, "summer": 1.2, "autumn": 0.85, "winter": 0.5}
_LEAVES: dict[Season, tuple[Colour, Colour]] = {
    "spring": ((0.44, 0.56, 0.22), (0.74, 0.60, 0.62)),
    "summer": ((0.20, 0.37, 0.13), (0.30, 0.43, 0.16)),
    "autumn": ((0.70, 0.46, 0.12), (0.60, 0.23, 0.10)),
}
"""Two hues by season, between which a tree's leaves lie; in winter there are no leaves."""
_TWIGS: Colour = (0.40, 0.34, 0.29)
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
GRASS: dict[Season, Colour] = {
    "spring": (0.40, 0.54, 0.24),
    "summer": (0.38, 0.46, 0.22),
    "autumn": (0.50, 0.44, 0.25),
    "winter": (0.40, 0.46, 0.34),
}
SNOW_COLOUR = np.array((0.90, 0.92, 0.96))
GLOW: dict[int, tuple[float, Colour]] = {
    Kind.GLASS: (0.34, (1.0, 0.78, 0.42)),
    Kind.SHOP: (0.8, (0.92, 0.82, 0.60)),
    Kind.LAMP: (1.0, (1.0, 0.88, 0.62)),
    Kind.HEADLIGHT: (1.0, (1.0, 0.97, 0.86)),
    Kind.TAILLIGHT: (1.0, (0.95, 0.12, 0.08)),
}
"""Share of polygons that shine after dark and their colour, by kind."""


def light_of(view: View, *, indoors: bool = False) -> Light:
    """Combine the light of the hour with the weather and the season's sun, or take lamps' light."""
    if indoors:
        return _INDOORS[view.time]
    light, air = _LIGHTS[view.time], _AIRS[view.weather]
    level = sum(light.horizon) / 3 * air.grey
    grey = (level, level, level)
    horizon = _mixed(light.horizon, grey, air.veil)
    return light._replace(
        ambient=scaled(light.ambient, air.ambient),
        sun=scaled(light.sun, air.sun),
        elevation=light.elevation * _SUN_HEIGHT[view.season],
        zenith=_mixed(light.zenith, grey, air.veil),
        horizon=horizon,
        veil=horizon,
        visibility=air.visibility,
    )


def _mixed(first: Colour, second: Colour, share: float) -> Colour:
    """Mix the first colour with a share, 0 to 1, of the second."""
    red, green, blue = (a + (b - a) * share for a, b in zip(first, second, strict=True))
    return (red, green, blue)


def sun_direction(
    light: Light, time: Time, bearing: float, rng: np.random.Generator
) -> Float[np.ndarray, "3"]:
    """Draw the sun's direction from the street: about south at noon, west at dusk."""
    compass = {"noon": 180.0, "dusk": 270.0, "night": 180.0}[time] + rng.uniform(-50, 50)
    azimuth, elevation = np.deg2rad(compass - bearing), np.deg2rad(light.elevation)
    level = np.cos(elevation)
    return np.array((np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level))


def part_colours(
    scene: Scene,
    seen_depth: Float[np.ndarray, " part"],
    view: View,
    light: Light,
    sun: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "part 3"]:
    """Compute the colour of every part, 0 to 1: material, season, light and haze."""
    albedo = scene.albedo.copy()
    if view.season in _LEAVES:
        leaf = (scene.kind == Kind.LEAF) | (scene.kind == Kind.BUSH)
        first, second = (np.array(c) for c in _LEAVES[view.season])
        hue, shade = scene.albedo[leaf, 0:1], scene.albedo[leaf, 1:2]
        albedo[leaf] = (first * (1 - hue) + second * hue) * shade
    else:
        bush = scene.kind == Kind.BUSH
        albedo[bush] = np.array(_TWIGS) * scene.albedo[bush, 1:2]
    albedo[scene.kind == Kind.GRASS] = GRASS[view.season]
    if view.season == "winter":
        cover = np.zeros(max(Kind) + 1)
        cover[list(_SNOW)] = list(_SNOW.values())
        share = cover[scene.kind][:, None]
        albedo = albedo * (1 - share) + SNOW_COLOUR * share
    if view.weather == "rain":
        albedo[(scene.kind == Kind.ROAD) | (scene.kind == Kind.PAVEMENT)] *= 0.72
    facing = np.clip(scene.normal @ sun, 0, None)[:, None]
    skyward = 0.85 + 0.15 * scene.normal[:, 1:2]
    colour = albedo * (np.array(light.ambient) * skyward + np.array(light.sun) * facing)
    if view.repaint:
        rng = np.random.default_rng((view.seed, 5))
        paint = rng.normal(0, view.repaint, (len(colour), 1))
        tint = rng.normal(0, view.repaint / 3, colour.shape)
        colour *= np.exp(paint + tint)
    glass = scene.kind == Kind.GLASS
    colour[glass] += 0.16 * np.array(light.zenith)
    window = scene.kind == Kind.WINDOW
    colour[window] = np.array(light.horizon) * scene.albedo[window]
    haze = 1 - np.exp(-np.clip(seen_depth, 0, 2000) / light.visibility)[:, None]
    return colour * (1 - haze) + np.array(light.veil) * haze


def shining(
    scene: Scene, draw: Float[np.ndarray, " polygon"], lit: float
) -> Bool[np.ndarray, " polygon"]:
    """Choose the polygons that shine: a random share of windows, all lamps, none by day."""
    share = np.zeros(max(Kind) + 1)
    if lit:
        for kind, (part_share, _) in GLOW.items():
            share[kind] = part_share * (0.35 + 0.65 * lit)
    return draw < np.repeat(share[scene.kind], scene.part_sizes)
