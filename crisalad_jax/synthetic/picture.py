"""One picture of a place: sky, ground, shadows and parts on a canvas, then the camera's sensor."""

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from crisalad_jax.synthetic.camera import (
    NEAR,
    Camera,
    clip_near,
    project_outlines,
)
from crisalad_jax.synthetic.light import (
    GLOW,
    GRASS,
    SNOW_COLOUR,
    Light,
    light_of,
    part_colours,
    shining,
    sun_direction,
)
from crisalad_jax.synthetic.mesh import GROUND_LAYER, Kind, Place, Scene, join_scenes
from crisalad_jax.synthetic.scenes import build_place
from crisalad_jax.synthetic.things import build_passers
from crisalad_jax.synthetic.view import Scenery, View, check_size
from crisalad_jax.utils.errors import InputError

_SUPERSAMPLING = 2


class _Canvas(NamedTuple):
    """Two uint8 (h, w, 3) images to paint on: the picture, and the light of its lamps."""

    picture: np.ndarray
    glow: np.ndarray


def render(
    place_seed: int,
    view: View,
    image_size: tuple[int, int] = (126, 168),
    scenery: Scenery = "street",
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw one picture of a place, RGB. The same arguments give the same pixels.

    Args:
        place_seed: which place; at least 0.
        view: where the camera stands, and the season, light, weather and traffic it meets.
        image_size: height and width in pixels.
        scenery: what kind of place it is.

    Raises:
        InputError: a negative seed, or a size out of range.
    """
    check_size("image_size", image_size)
    if place_seed < 0:
        raise InputError(f"place_seed: found {place_seed}, expected at least 0")
    place = build_place(place_seed, scenery)
    size = (image_size[0] * _SUPERSAMPLING, image_size[1] * _SUPERSAMPLING)
    camera = Camera(place.heading, view, size)
    light = light_of(view, indoors=place.indoors)
    rng = np.random.default_rng((view.seed, 3))
    sun = sun_direction(light, view.time, place.bearing, rng)
    scene = place.scene
    draw = rng.random(len(scene.polygon_sizes))
    if view.occluders is not None:
        passers = build_passers(view.occluders, place.lanes, traffic=place.traffic)
        scene = join_scenes(scene, passers)
        # A draw of 0 switches the lights of every vehicle on.
        draw = np.concatenate((draw, np.zeros(len(passers.polygon_sizes))))

    seen = camera.see(scene.points)
    outlines = project_outlines(scene, seen, camera)
    point_starts = np.concatenate(([0], np.cumsum(scene.polygon_sizes)))
    part_starts = point_starts[np.concatenate(([0], np.cumsum(scene.part_sizes)))]
    depth = np.add.reduceat(seen[:, 2], part_starts[:-1]) / np.diff(part_starts)
    colours = part_colours(scene, depth, view, light, sun)
    shines = shining(scene, draw, light.lit)

    order = np.argsort(-scene.layer, kind="stable")
    if view.season == "winter":
        order = order[scene.kind[order] != Kind.LEAF]
    grounds = int((scene.layer[order] >= GROUND_LAYER).sum())
    black = np.zeros((*size, 3), np.uint8)
    sky = black.copy() if place.indoors else _sky(place, view, light, camera, size)
    canvas = _Canvas(sky, black)
    _paint(canvas, scene, order[:grounds].tolist(), outlines, colours, shines, light.lit)
    if not place.indoors:
        _shade_ground(canvas.picture, place, camera, light, sun)
    _paint(canvas, scene, order[grounds:].tolist(), outlines, colours, shines, light.lit)
    return _develop(canvas, place, view, light, camera, rng)


def _sky(
    place: Place, view: View, light: Light, camera: Camera, size: tuple[int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the sky, its clouds, and the hills, which are too far to move with the camera."""
    height, width = size
    rng = np.random.default_rng((view.seed, 2))
    horizon_row = height / 2 + camera.focal * np.tan(camera.pitch)
    coarse = (height // 4, width // 4)
    rows = (np.arange(coarse[0]) + 0.5) * height / coarse[0]
    climb = np.clip(1 - rows / horizon_row, 0, 1)[:, None, None] ** 0.8
    sky = np.array(light.horizon) * (1 - climb) + np.array(light.zenith) * climb
    sky = np.repeat(sky, coarse[1], axis=1)
    if view.weather == "clear":
        puffs = rng.random((7, 4)).astype(np.float32)
        puffs = cv2.resize(puffs, coarse[::-1], interpolation=cv2.INTER_CUBIC)
        cover = np.clip((puffs - rng.uniform(0.45, 0.9)) * 2.5, 0, 0.85)[..., None]
        sky += (np.array(light.horizon) * 1.06 - sky) * cover
    canvas = np.clip(sky * 255, 0, 255).astype(np.uint8)
    canvas = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_LINEAR)

    across = np.linspace(-1, 1, 33)
    compass = camera.yaw + np.arctan(across * camera.tan_half_width) + np.deg2rad(place.bearing)
    bearings = np.arange(len(place.hills)) * (360 / len(place.hills))
    tangent = np.interp(np.rad2deg(compass) % 360, bearings, place.hills, period=360)
    ridge = np.stack((width / 2 * (1 + across), horizon_row - camera.focal * tangent), -1)
    outline = np.concatenate((ridge, [(width, horizon_row + 2), (0, horizon_row + 2)]))
    hill = np.array(SNOW_COLOUR * 0.75 if view.season == "winter" else GRASS[view.season])
    haze = 0.85 if view.weather in ("haze", "rain") else 0.45
    colour = hill * light.ambient * (1 - haze) + np.array(light.horizon) * haze
    cv2.fillPoly(canvas, [np.round(outline).astype(np.int32)], _bytes(colour))
    return canvas


def _paint(
    canvas: _Canvas,
    scene: Scene,
    parts: Iterable[int],
    outlines: list[np.ndarray | None],
    colours: Float[np.ndarray, "part 3"],
    shines: Bool[np.ndarray, " polygon"],
    lit: float,
) -> None:
    """Fill polygons in the order of `parts`; those that shine get their lamp's colour."""
    ends = np.cumsum(scene.part_sizes)
    starts = (ends - scene.part_sizes).tolist()
    ends = ends.tolist()
    paints = _bytes(colours)
    for part in parts:
        dark: list[np.ndarray] = []
        bright: list[np.ndarray] = []
        for i in range(starts[part], ends[part]):
            outline = outlines[i]
            if outline is not None:
                (bright if shines[i] else dark).append(outline)
        if dark:
            cv2.fillPoly(canvas.picture, dark, paints[part], cv2.LINE_8, 2)
            if lit:
                cv2.fillPoly(canvas.glow, dark, (0, 0, 0), cv2.LINE_8, 2)
        if bright:
            lamp = np.array(GLOW[int(scene.kind[part])][1])
            cv2.fillPoly(canvas.picture, bright, _bytes(lamp * (0.5 + 0.4 * lit)), cv2.LINE_8, 2)
            cv2.fillPoly(canvas.glow, bright, _bytes(lamp), cv2.LINE_8, 2)


def _shade_ground(
    canvas: np.ndarray, place: Place, camera: Camera, light: Light, sun: np.ndarray
) -> None:
    """Darken the ground where buildings stand between it and the sun."""
    strength = float(np.mean(light.sun))
    if strength < 0.05:
        return
    drift = -sun[[0, 2]] / max(sun[1], 0.15)
    mask = np.zeros(canvas.shape[:2], np.uint8)
    for x0, x1, z0, z1, height in place.bodies:
        foot = np.array(((x0, z0), (x1, z0), (x1, z1), (x0, z1)))
        both = np.concatenate((foot, foot + drift * height)).astype(np.float32)
        hull = cv2.convexHull(both)[:, 0]
        seen = camera.see(np.insert(hull.astype(np.float64), 1, 0.0, axis=1))
        if seen[:, 2].min() < NEAR:
            seen = clip_near(seen)
        if len(seen) > 2:
            corners = np.clip(np.round(camera.project(seen)), -30000, 30000).astype(np.int32)
            cv2.fillConvexPoly(mask, corners, 255)
    ambient = float(np.mean(light.ambient))
    shaded = cv2.convertScaleAbs(canvas, alpha=ambient / (ambient + strength * max(sun[1], 0.2)))
    cv2.copyTo(shaded, mask, canvas)


def _develop(
    canvas: _Canvas,
    place: Place,
    view: View,
    light: Light,
    camera: Camera,
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "h w 3"]:
    """Turn the canvas into the camera's picture: lamplight, rain, balance, exposure, noise."""
    height, width = (side // _SUPERSAMPLING for side in canvas.picture.shape[:2])
    picture = cv2.resize(canvas.picture, (width, height), interpolation=cv2.INTER_AREA)
    picture = picture.astype(np.float32)
    if light.lit:
        picture = _lamplight(picture, canvas.glow, place, light, camera)
    if view.weather == "rain" and not place.indoors:
        picture = _rain(picture, rng)
    warmth, tint = rng.uniform(-0.13, 0.13), rng.uniform(-0.04, 0.04)
    picture *= (2.0 ** (view.exposure + np.array((warmth, tint, -warmth)))).astype(np.float32)
    if view.noise:
        picture += np.float32(view.noise) * rng.standard_normal(picture.shape, np.float32)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def _lamplight(
    picture: np.ndarray, glow: np.ndarray, place: Place, light: Light, camera: Camera
) -> np.ndarray:
    """Add pools of light around street lamps, and a halo around everything that shines."""
    height, width = picture.shape[:2]
    small = (width // 4, height // 4)
    scale = small[0] / (2 * camera.centre[0])
    pools = np.zeros((small[1], small[0]), np.float32)
    seen = camera.see(place.lamps)
    seen = seen[seen[:, 2] > 1.0]
    for (x, y), distance in zip(camera.project(seen) * scale, seen[:, 2], strict=True):
        radius = min(scale * camera.focal * 6.0 / distance, 2.0 * small[0])
        centre = np.clip(np.round((x, y + radius * 0.6)), -999, 999).astype(int).tolist()
        disc = np.zeros_like(pools)
        cv2.circle(disc, centre, max(1, int(radius)), 1.0, -1)
        pools = np.maximum(pools, disc)
    pools = cv2.GaussianBlur(pools, (0, 0), small[0] / 20)
    pools = cv2.resize(pools, (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    picture = picture * (1 + light.lit**2 * pools * np.array((2.2, 1.7, 0.9), np.float32))
    halo = cv2.resize(glow, small, interpolation=cv2.INTER_AREA).astype(np.float32)
    halo = cv2.GaussianBlur(halo, (0, 0), small[0] / 28)
    return picture + 0.4 * light.lit * cv2.resize(halo, (width, height))


def _rain(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    height, width = picture.shape[:2]
    streaks = np.zeros((height, width), np.float32)
    for x, y, length in rng.uniform((0, -8, 4), (width, height, 11), (height * width // 240, 3)):
        end = (int(x - length * 0.18), int(y + length))
        cv2.line(streaks, (int(x), int(y)), end, 1.0, 1)
    return picture + cv2.GaussianBlur(streaks, (3, 3), 0)[..., None] * (0.08 * picture.mean() + 6)


def _bytes(colour: np.ndarray) -> list:
    """Convert colours (..., 3) of 0..1 to nested lists of 0..255, as OpenCV takes them."""
    return np.clip(colour * 255, 0, 255).astype(int).tolist()
