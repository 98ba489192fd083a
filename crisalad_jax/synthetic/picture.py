"""One picture of a place: sky, ground, shadows and parts on a canvas, then the camera's sensor."""

import functools
import itertools
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from crisalad_jax.config.checks import require
from crisalad_jax.synthetic.corridor import corridor, room
from crisalad_jax.synthetic.country import country
from crisalad_jax.synthetic.light import (
    GLOW,
    GRASS,
    SNOW_COLOUR,
    light_of,
    part_colours,
    shining,
)
from crisalad_jax.synthetic.mesh import GROUND_LAYER, Kind, Place, Rng, Scene
from crisalad_jax.synthetic.shapes import shapes
from crisalad_jax.synthetic.street import street
from crisalad_jax.synthetic.things import build_passers
from crisalad_jax.synthetic.view import (
    NEAR,
    SCENERIES,
    Camera,
    Scenery,
    View,
    check_size,
    clip_near,
)

_SUPERSAMPLING = 2
_BUILDERS = dict(zip(SCENERIES, (street, corridor, country, room, shapes), strict=True))


@functools.lru_cache(maxsize=32)
def build_place(seed: int, scenery: Scenery = "street") -> Place:
    """Build the place of a seed; the last 32 places are cached."""
    return _BUILDERS[scenery](np.random.default_rng((seed, 0)))


def render(
    place_seed: int,
    view: View,
    image_size: tuple[int, int] = (126, 168),
    scenery: Scenery = "street",
) -> UInt8[np.ndarray, "h w 3"]:
    """Render one RGB picture of a place; the same arguments give the same pixels.

    Args:
        place_seed: seed of the place, at least 0.
        view: where the camera stands, and the season, light, weather and traffic.
        image_size: height and width in pixels.
        scenery: kind of place, of `SCENERIES`.

    Raises:
        InputError: the seed is negative, or a side is not from 16 to 2048 pixels.
    """
    check_size("image_size", image_size)
    require(place_seed >= 0, f"place_seed: found {place_seed}, expected at least 0")
    place = build_place(place_seed, scenery)
    scene, picture = place.scene, _Picture(place, view, image_size)
    draw = picture.rng.random(len(scene.polygon_sizes))
    if view.occluders is not None:
        passers = build_passers(view.occluders, place.lanes, place.traffic, view.crowd)
        scene = Scene(*map(np.concatenate, zip(scene, passers, strict=True)))
        # A draw of 0 switches on the lights of every vehicle.
        draw = np.concatenate((draw, np.zeros(len(passers.polygon_sizes))))
    if not place.indoors:
        picture.draw_sky()
    picture.paint(scene, shining(scene, draw, picture.light.lit))
    return picture.develop()


class _Picture:
    """A picture that is being painted: RGB, and the light of its lamps."""

    def __init__(self, place: Place, view: View, image_size: tuple[int, int]) -> None:
        """Start with a black canvas."""
        self.place, self.view = place, view
        self.rng = np.random.default_rng((view.seed, 3))
        self.light = light_of(view, place, self.rng)
        self.size = height, width = image_size
        size = height * _SUPERSAMPLING, width * _SUPERSAMPLING
        self.camera = Camera(place.heading, view, size)
        self.canvas = np.zeros((*size, 3), np.uint8)
        self.glow = np.zeros((*size, 3), np.uint8)

    def draw_sky(self) -> None:
        """Draw the sky, its clouds, and the hills, which are too far to move with the camera."""
        view, light, camera = self.view, self.light, self.camera
        height, width = self.canvas.shape[:2]
        rng = np.random.default_rng((view.seed, 2))
        horizon_row = height / 2 + camera.focal * np.tan(camera.pitch)
        coarse = (height // 4, width // 4)
        rows = (np.arange(coarse[0]) + 0.5) * height / coarse[0]
        climb = np.clip(1 - rows / horizon_row, 0, 1)[:, None, None] ** 0.8
        sky = np.repeat(light.horizon * (1 - climb) + light.zenith * climb, coarse[1], axis=1)
        if view.weather == "clear":
            puffs = rng.random((7, 4)).astype(np.float32)
            puffs = cv2.resize(puffs, coarse[::-1], interpolation=cv2.INTER_CUBIC)
            cover = np.clip((puffs - rng.uniform(0.45, 0.9)) * 2.5, 0, 0.85)[..., None]
            sky += (light.horizon * 1.06 - sky) * cover
        sky = np.clip(sky * 255, 0, 255).astype(np.uint8)
        cv2.resize(sky, (width, height), self.canvas, interpolation=cv2.INTER_LINEAR)

        across, hills = np.linspace(-1, 1, 33), self.place.hills
        compass = camera.yaw + np.arctan(across * camera.tan_half_width)
        compass = np.rad2deg(compass + np.deg2rad(self.place.bearing)) % 360
        bearings = np.arange(len(hills)) * (360 / len(hills))
        tangent = np.interp(compass, bearings, hills, period=360)
        ridge = np.stack((width / 2 * (1 + across), horizon_row - camera.focal * tangent), -1)
        outline = np.concatenate((ridge, [(width, horizon_row + 2), (0, horizon_row + 2)]))
        hill = SNOW_COLOUR * 0.75 if view.season == "winter" else GRASS[view.season]
        haze = 0.85 if view.weather in ("haze", "rain") else 0.45
        colour = hill * light.ambient * (1 - haze) + light.horizon * haze
        cv2.fillPoly(self.canvas, [np.round(outline).astype(np.int32)], _bytes(colour))

    def paint(self, scene: Scene, shines: Bool[np.ndarray, " polygon"]) -> None:
        """Paint the parts from far to near; after the ground, the shadows on it."""
        seen = self.camera.see(scene.points)
        outlines = self.camera.outlines(seen, scene.polygon_sizes)
        polygons = np.append(0, np.cumsum(scene.part_sizes))
        points = np.append(0, np.cumsum(scene.polygon_sizes))[polygons]
        depth = np.add.reduceat(seen[:, 2], points[:-1]) / np.diff(points)
        paints = _bytes(part_colours(scene, depth, self.view, self.light))
        order = np.argsort(-scene.layer, kind="stable")
        if self.view.season == "winter":
            order = order[scene.kind[order] != Kind.LEAF]
        grounds = int((scene.layer[order] >= GROUND_LAYER).sum())
        runs = list(itertools.pairwise(polygons.tolist()))
        for number, part in enumerate(order.tolist()):
            if number == grounds and not self.place.indoors:
                self._shade_ground()
            dark: list[np.ndarray] = []
            bright: list[np.ndarray] = []
            for i in range(*runs[part]):
                outline = outlines[i]
                if outline is not None:
                    (bright if shines[i] else dark).append(outline)
            if dark:
                _fill(self.canvas, dark, paints[part])
                if self.light.lit:
                    _fill(self.glow, dark, (0, 0, 0))
            if bright:
                lamp = np.array(GLOW[int(scene.kind[part])][1])
                _fill(self.canvas, bright, _bytes(lamp * (0.5 + 0.4 * self.light.lit)))
                _fill(self.glow, bright, _bytes(lamp))

    def _shade_ground(self) -> None:
        """Darken the ground where buildings stand between it and the sun."""
        strength, to_sun = float(np.mean(self.light.sun)), self.light.to_sun
        if strength < 0.05:
            return
        drift = -to_sun[[0, 2]] / max(to_sun[1], 0.15)
        mask = np.zeros(self.canvas.shape[:2], np.uint8)
        for x0, x1, z0, z1, height in self.place.bodies:
            foot = np.array(((x0, z0), (x1, z0), (x1, z1), (x0, z1)))
            both = np.concatenate((foot, foot + drift * height)).astype(np.float32)
            hull = cv2.convexHull(both)[:, 0]
            seen = self.camera.see(np.insert(hull.astype(np.float64), 1, 0.0, axis=1))
            if seen[:, 2].min() < NEAR:
                seen = clip_near(seen)
            if len(seen) > 2:
                corners = np.clip(np.round(self.camera.project(seen)), -30000, 30000)
                cv2.fillConvexPoly(mask, corners.astype(np.int32), 255)
        ambient = float(np.mean(self.light.ambient))
        share = ambient / (ambient + strength * max(to_sun[1], 0.2))
        cv2.copyTo(cv2.convertScaleAbs(self.canvas, alpha=share), mask, self.canvas)

    def develop(self) -> UInt8[np.ndarray, "h w 3"]:
        """Make the camera's picture: lamplight, rain, white balance, exposure, noise."""
        view = self.view
        picture = cv2.resize(self.canvas, self.size[::-1], interpolation=cv2.INTER_AREA)
        picture = picture.astype(np.float32)
        if self.light.lit:
            picture = self._lamplight(picture)
        if view.weather == "rain" and not self.place.indoors:
            picture = _rain(picture, self.rng)
        warmth, tint = self.rng.uniform(-0.13, 0.13), self.rng.uniform(-0.04, 0.04)
        stops = view.exposure + np.array((warmth, tint, -warmth))
        picture *= (2.0**stops).astype(np.float32)
        if view.noise:
            picture += np.float32(view.noise) * self.rng.standard_normal(picture.shape, np.float32)
        return np.clip(np.round(picture), 0, 255).astype(np.uint8)

    def _lamplight(self, picture: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        """Add pools of light around street lamps, and a halo around everything that shines."""
        height, width = self.size
        small = (width // 4, height // 4)
        camera, lit = self.camera, self.light.lit
        scale = small[0] / (2 * camera.centre[0])
        pools = np.zeros((small[1], small[0]), np.float32)
        seen = camera.see(self.place.lamps)
        seen = seen[seen[:, 2] > 1.0]
        for (x, y), distance in zip(camera.project(seen) * scale, seen[:, 2], strict=True):
            radius = min(scale * camera.focal * 6.0 / distance, 2.0 * small[0])
            centre = np.clip(np.round((x, y + radius * 0.6)), -999, 999).astype(int).tolist()
            cv2.circle(pools, centre, max(1, int(radius)), 1.0, -1)
        pools = cv2.GaussianBlur(pools, (0, 0), small[0] / 20)
        pools = cv2.resize(pools, (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
        picture = picture * (1 + lit**2 * pools * np.array((2.2, 1.7, 0.9), np.float32))
        halo = cv2.resize(self.glow, small, interpolation=cv2.INTER_AREA).astype(np.float32)
        halo = cv2.GaussianBlur(halo, (0, 0), small[0] / 28)
        return picture + 0.4 * lit * cv2.resize(halo, (width, height))


def _fill(canvas: np.ndarray, outlines: list[np.ndarray], colour: Sequence[int]) -> None:
    cv2.fillPoly(canvas, outlines, colour, cv2.LINE_8, 2)


def _rain(picture: np.ndarray, rng: Rng) -> np.ndarray:
    height, width = picture.shape[:2]
    streaks = np.zeros((height, width), np.float32)
    for x, y, length in rng.uniform((0, -8, 4), (width, height, 11), (height * width // 240, 3)):
        end = (int(x - length * 0.18), int(y + length))
        cv2.line(streaks, (int(x), int(y)), end, 1.0, 1)
    return picture + cv2.GaussianBlur(streaks, (3, 3), 0)[..., None] * (0.08 * picture.mean() + 6)


def _bytes(colour: np.ndarray) -> list:
    """Convert colours (..., 3) of 0..1 to nested lists of 0..255, as OpenCV takes them."""
    return np.clip(colour * 255, 0, 255).astype(int).tolist()
