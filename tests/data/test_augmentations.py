"""Every operation against Pillow, strengths against torchvision's table, and the draws."""

import cv2
import numpy as np
import pytest
from PIL import Image

from crisalad_jax.data.augmentations import Augmentation
from crisalad_jax.data.augmentations import rand_augment as module
from crisalad_jax.data.augmentations.camera import CameraAugmentConfig
from crisalad_jax.data.augmentations.colour_crop import ColourCropConfig
from crisalad_jax.data.augmentations.light import LightAugmentConfig
from crisalad_jax.data.augmentations.rand_augment import OPERATIONS, RandAugmentConfig
from crisalad_jax.utils.errors import InputError
from parity.reference.augment import OPERATIONS as PILLOWS
from parity.reference.augment import strengths as torchvisions


def picture(height=224, width=224, seed=0):
    """Smooth colour, noise, and a range of levels that does not fill 0 to 255."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(20, 220, (9, 9, 3)).astype(np.float32)
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    noise = rng.uniform(-15, 15, (height, width, 3))
    return np.clip(smooth + noise, 5, 235).astype(np.uint8)


GEOMETRIC = ("ShearX", "ShearY", "TranslateX", "TranslateY", "Rotate")
PHOTOMETRIC = tuple(name for name in PILLOWS if name not in GEOMETRIC)


def strengths(name, shape):
    for magnitude in (0, 4, 9, 30):
        strength = OPERATIONS[name].strength(magnitude / 30, *shape)
        yield strength
        if OPERATIONS[name].signed:
            yield -strength


def test_names_strengths_and_signs_are_torchvisions():
    for magnitude in range(31):
        table = torchvisions(magnitude, 200, 100)
        assert list(OPERATIONS) == list(table) == list(PILLOWS)
        for name, (expected, signed) in table.items():
            found = OPERATIONS[name]
            assert found.strength(magnitude / 30, 100, 200) == pytest.approx(expected)
            assert found.signed == signed


def one_level(level):
    """One level in two channels, and the full range in the third."""
    image = np.full((20, 30, 3), level, np.uint8)
    image[:, :, 1] = np.random.default_rng(1).integers(0, 256, (20, 30))
    return image


IMAGES = {
    "square": picture(),
    "wide": picture(70, 126),
    "2 x 3": picture(2, 3),
    "a pixel": picture(1, 1),
    "mirrored": np.flip(picture(70, 126), axis=1),
    "black": one_level(0),
    "white": one_level(255),
}


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
@pytest.mark.parametrize("name", PHOTOMETRIC)
def test_photometric_operations_are_pillows_bit_for_bit(name, image):
    for strength in strengths(name, image.shape[:2]):
        expected = PILLOWS[name](Image.fromarray(image), strength)
        np.testing.assert_array_equal(OPERATIONS[name].apply(image, strength), expected)


@pytest.mark.parametrize("image", ["square", "wide", "a pixel", "mirrored"])
@pytest.mark.parametrize("name", GEOMETRIC)
def test_geometric_operations_are_pillows(name, image):
    image = IMAGES[image]
    for strength in strengths(name, image.shape[:2]):
        warped = OPERATIONS[name].apply(image, strength)
        expected = np.asarray(PILLOWS[name](Image.fromarray(image), strength))
        # Pillow cuts off fractions where OpenCV rounds: at most a level, half of one on average.
        # A point within rounding of the rim may be black in one only: at most 4 pixels allowed.
        difference = np.abs(warped.astype(int) - expected).max(axis=-1)
        assert (difference > 1).sum() <= 4
        assert difference[difference <= 1].mean() < 0.9
        # Moved pixels are to be the same pixels.
        if name.startswith("Translate"):
            np.testing.assert_array_equal(warped, expected)


def test_operations_are_drawn_uniformly(monkeypatch):
    drawn = []

    def spy(name):
        operation = OPERATIONS[name]

        def apply(image, strength):
            drawn.append((name, strength))
            return image

        return operation._replace(apply=apply)

    monkeypatch.setattr(module, "OPERATIONS", {name: spy(name) for name in OPERATIONS})
    generator = np.random.default_rng(0)
    image = np.zeros((224, 224, 3), np.uint8)
    for _ in range(4000):
        augment(image, RandAugmentConfig(), generator)
    assert len(drawn) == 12_000
    counts = np.array([sum(d == name for d, _ in drawn) for name in OPERATIONS])
    expected = 12_000 / 14
    # 34.5 is the 0.1 % point of chi-squared with 13 degrees of freedom; the seed is fixed.
    assert ((counts - expected) ** 2 / expected).sum() < 34.5
    for name, operation in OPERATIONS.items():
        signs = np.array([np.sign(strength) for d, strength in drawn if d == name])
        # Five standard deviations of a fair coin thrown about 857 times: 0.17.
        assert abs(signs.mean()) < 0.17 if operation.signed else (signs >= 0).all()
    # With replacement: the three of a draw are all different with probability 14*13*12 / 14**3.
    triples = [len({name for name, _ in drawn[i : i + 3]}) for i in range(0, 12_000, 3)]
    # Five standard deviations of the share of 4000 draws: 0.032.
    assert np.mean([n == 3 for n in triples]) == pytest.approx(14 * 13 * 12 / 14**3, abs=0.032)


def augment(image: np.ndarray, config: Augmentation, generator: np.random.Generator) -> np.ndarray:
    """What is drawn for a place by another generator does not matter here."""
    return config.apply(image, generator, of_place=np.random.default_rng(99))


@pytest.mark.parametrize(
    "config", [RandAugmentConfig(), LightAugmentConfig(), CameraAugmentConfig()]
)
@pytest.mark.parametrize("shape", [(224, 224), (70, 126), (1, 1)])
def test_the_same_seed_gives_the_same_picture(config, shape):
    image = picture(*shape)
    untouched = image.copy()
    first, second = (
        [augment(image, config, np.random.default_rng(seed)) for seed in range(8)] for _ in "ab"
    )
    for a, b in zip(first, second, strict=True):
        assert a.dtype == np.uint8
        assert a.shape == image.shape
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(image, untouched)
    if shape != (1, 1):
        assert len({a.tobytes() for a in first}) > 4


STILL = {"crop": 0.0, "shift": 0.0, "rotation": 0.0, "blur": 0.0, "colour": 0.0, "grey": 0.0}


def light(image, seed=0, **changes):
    config = LightAugmentConfig(**{**STILL, **changes})
    return augment(image, config, np.random.default_rng(seed))


def blob(height, width, x, y):
    """A bright spot of standard deviation 3 about pixel (x, y)."""
    columns, rows = np.arange(width) - x, np.arange(height)[:, None] - y
    spot = 250 * np.exp(-(columns**2 + rows**2) / 18)
    return np.repeat(np.rint(spot).astype(np.uint8)[..., None], 3, axis=-1)


def centroid(image):
    weights = image[..., 0].astype(float)
    rows, columns = np.indices(weights.shape)
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def spots_moved(**changes):
    """Where spots at the centre and 40 pixels to its right go, for 100 seeds."""
    starts = [(80, 60), (120, 60)]
    images = [blob(121, 161, *start) for start in starts]
    return np.array([[centroid(light(i, seed, **changes)) for i in images] for seed in range(100)])


def test_light_crop_magnifies_about_the_centre():
    moved = spots_moved(crop=0.2)
    # A spot's centroid is known to about 0.02 pixels after rounding to 8 bits; 0.1 is safe.
    np.testing.assert_allclose(moved[:, 0], [[80, 60]] * 100, atol=0.1)
    magnification = (moved[:, 1, 0] - moved[:, 0, 0]) / 40
    assert magnification.min() > 0.997
    assert magnification.max() < 1 / 0.8 + 0.003
    # 100 uniform draws leave 15 % of either end empty with probability below 1e-6.
    assert magnification.min() < 1 / (1 - 0.2 * 0.15)
    assert magnification.max() > 1 / (1 - 0.2 * 0.85)


def test_light_shift_is_a_share_of_each_side():
    moved = spots_moved(shift=0.05)[:, 0] - (80, 60)
    # Tolerances as above.
    limits = np.array([0.05 * 161, 0.05 * 121])
    assert (np.abs(moved) < limits + 0.1).all()
    assert (moved.min(axis=0) < -0.7 * limits).all()
    assert (moved.max(axis=0) > 0.7 * limits).all()


def test_light_rotation_is_in_degrees_about_the_centre():
    moved = spots_moved(rotation=10.0)
    # Tolerances as above: 0.1 pixel at a radius of 40 is 0.15 degrees.
    np.testing.assert_allclose(moved[:, 0], [[80, 60]] * 100, atol=0.1)
    arm = moved[:, 1] - moved[:, 0]
    np.testing.assert_allclose(np.hypot(*arm.T), 40, atol=0.1)
    degrees = np.degrees(np.arctan2(arm[:, 1], arm[:, 0]))
    assert np.abs(degrees).max() < 10.15
    assert degrees.min() < -7
    assert degrees.max() > 7


def test_light_border_reflects():
    # Reflection makes up no new levels: a picture of 100 to 150 stays so.
    image = np.random.default_rng(0).integers(100, 151, (60, 80, 3), dtype=np.uint8)
    for seed in range(20):
        warped = light(image, seed, shift=0.3, rotation=20.0)
        assert warped.min() >= 100
        assert warped.max() <= 150


def test_light_blur_is_gaussian():
    image = blob(81, 81, 40, 40)
    blurred = np.array([light(image, seed, blur=2.0) for seed in range(50)])
    weights = np.stack([image, *blurred])[..., 0].sum(axis=1, dtype=float)
    before, *variances = weights @ (np.arange(81) - 40) ** 2 / weights.sum(axis=1)
    sigmas = np.sqrt(np.maximum(np.array(variances) - before, 0))
    # Variances add; rounding to 8 bits and the kernel's cut at 3 sigma lose a few percent.
    assert sigmas.max() < 2.05
    assert sigmas.max() > 1.6
    assert sigmas.min() < 0.5


@pytest.mark.parametrize("seed", range(5))
def test_light_colour_is_brightness_then_contrast_then_saturation(seed):
    image = picture()
    generator = np.random.default_rng(seed)
    # The same draws in the same order: scale, two shifts, angle, sigma, then the three factors.
    generator.random(5)
    brightness, contrast, saturation = generator.uniform(0.7, 1.3, 3)
    luma = np.array([0.299, 0.587, 0.114])
    expected = image * brightness
    mean = (expected @ luma).mean()
    expected = mean + contrast * (expected - mean)
    grey = (expected @ luma)[..., None]
    expected = np.clip(grey + saturation * (expected - grey), 0, 255)
    # Half a level from rounding to 8 bits, and less than half from OpenCV's fixed-point factors.
    np.testing.assert_allclose(light(image, seed, colour=0.3), expected, atol=1, rtol=0)


def test_light_gamma_is_one_exponent_of_all_intensities():
    levels = np.arange(256)
    ramp = np.repeat(levels.astype(np.uint8)[None, :, None], 3, axis=-1)
    logarithms = []
    for seed in range(20):
        found = light(ramp, seed, gamma=0.5)[0, :, 0]
        exponent = np.log(found[128] / 255) / np.log(128 / 255)
        # Half a level from rounding, and up to 0.7 from the rounding of the level of the exponent.
        np.testing.assert_allclose(found, 255 * (levels / 255) ** exponent, atol=1.3)
        logarithms.append(np.log(exponent))
    assert 0.35 < np.abs(logarithms).max() < 0.51  # rounding changes a logarithm by up to 0.01
    assert min(logarithms) < 0 < max(logarithms)


def test_light_illumination_is_smooth_and_as_strong_as_asked():
    grey = np.full((60, 80, 3), 128, np.uint8)
    found = np.array([light(grey, seed, illumination=0.3) for seed in range(10)], float)
    # Cubic interpolation overshoots the draws by up to a half.
    assert 0.2 < np.abs(np.log(found / 128)).max() < 0.45
    # A row is 20 pixels from draw to draw, which are at most 0.6 apart: 128 x 0.6 x 1.5 / 20 = 6.
    assert np.abs(np.diff(found, axis=1)).max() <= 8


def test_light_grey_has_equal_channels():
    image = picture()
    grey = light(image, grey=1.0)
    np.testing.assert_array_equal(grey, grey[..., :1].repeat(3, axis=-1))
    # Rounded luma against Pillow's, which has the same weights in 16 bits.
    expected = np.asarray(Image.fromarray(image).convert("L")).astype(int)
    assert np.abs(grey[..., 0] - expected).max() <= 1
    share = np.mean(
        [np.ptp(light(image[:8, :8], s, grey=0.3), axis=-1).max() == 0 for s in range(300)]
    )
    # Five standard deviations of 300 draws: 0.13.
    assert share == pytest.approx(0.3, abs=0.13)


STEADY = {
    **STILL,
    **dict.fromkeys(("perspective", "texture", "filters", "occlusion", "motion"), 0.0),
    **dict.fromkeys(("coarse", "noise", "jpeg"), 0.0),
}


def photographed(image, seed=0, **changes):
    config = CameraAugmentConfig(**{**STEADY, **changes})
    return augment(image, config, np.random.default_rng(seed))


@pytest.mark.parametrize("augmented", [light, photographed])
def test_no_strength_changes_nothing(augmented):
    np.testing.assert_array_equal(augmented(picture(70, 126)), picture(70, 126))
    none = augment(picture(70, 126), RandAugmentConfig(operations=0), np.random.default_rng(0))
    np.testing.assert_array_equal(none, picture(70, 126))


def test_another_stand_moves_a_spot_by_no_more_than_its_corners():
    image = blob(90, 120, 60, 45)
    moves = [
        centroid(photographed(image, seed, perspective=0.05)) - centroid(image)
        for seed in range(20)
    ]
    reach = np.abs(moves).max(axis=0)
    # The middle is where the diagonals cross: to first order it moves by at most twice as much as
    # the corners, which move by a twentieth of the sides.
    assert (reach > 0.5).all()
    assert (reach < 2 * 0.05 * np.array([120, 90])).all()


def test_texture_keeps_the_mean_and_is_as_strong_as_asked():
    """Four scales of unit deviation, times a half: at a strength of s the deviation is near s."""
    grey = np.full((160, 160, 3), 128, np.uint8)
    found = [photographed(grey, seed, texture=0.2).astype(float) / 128 for seed in range(30)]
    assert abs(np.mean(found) - 1) < 0.02
    deviations = [image.std() for image in found]
    # Drawn from 0 to 0.2; interpolation between coarse numbers takes a part of it.
    assert 0.1 < max(deviations) < 0.2
    assert min(deviations) < 0.04


def test_random_filters_keep_the_mean_and_the_deviation_of_the_colours():
    image = np.clip(picture(70, 126), 60, 190)
    for seed in range(6):
        found = photographed(image, seed, filters=1.0).astype(float)
        assert not np.array_equal(found, image)
        # Mixed with the image, and clipped to bytes: up to a fifth of the deviation.
        assert abs(found.mean() - image.mean()) < 0.2 * image.std()


def test_what_covers_is_of_one_colour_and_no_more_than_a_part():
    image = picture(70, 126)
    for seed in range(10):
        found = photographed(image, seed, occlusion=1.0)
        changed = (found != image).any(axis=-1)
        assert changed.mean() < 0.17  # at most two fifths of each side
        colours = {tuple(colour) for colour in found[changed]}
        assert len(colours) <= 1


def test_motion_keeps_a_spot_in_its_place_and_spreads_it_along_a_line():
    image = blob(90, 120, 60, 45)
    before = (image > 100).any(axis=-1)
    for seed in range(6):
        found = photographed(image, seed, motion=1.0)
        np.testing.assert_allclose(centroid(found), centroid(image), atol=1.0)
        assert found.max() < image.max()
        assert (found > 20).any(axis=-1).any(axis=0).sum() > before.any(axis=0).sum()


def test_fewer_pixels_have_less_detail_and_the_same_size():
    image = picture(70, 126)
    for seed in range(6):
        found = photographed(image, seed, coarse=1.0)
        assert found.shape == image.shape
        detail = [np.abs(np.diff(each.astype(float), axis=1)).mean() for each in (found, image)]
        assert detail[0] < detail[1]


def test_noise_is_at_most_as_strong_as_asked():
    grey = np.full((100, 100, 3), 128, np.uint8)
    deviations = [photographed(grey, seed, noise=6.0).std() for seed in range(30)]
    assert max(deviations) < 6.5
    assert max(deviations) > 4


def test_jpeg_is_of_the_qualities_that_are_named():
    """As OpenCV writes it of the qualities that are drawn."""
    image = picture(64, 64)
    files = {
        cv2.imdecode(
            cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))[1], cv2.IMREAD_COLOR
        ).tobytes()
        for quality in range(12, 85)
    }
    for seed in range(6):
        assert photographed(image, seed, jpeg=1.0).tobytes() in files


@pytest.mark.parametrize(
    ("config", "field", "value"),
    [
        (CameraAugmentConfig, "jpeg", 1.5),
        (CameraAugmentConfig, "texture", float("nan")),
        (ColourCropConfig, "hue", 0.6),
        (LightAugmentConfig, "grey", 1.1),
        (RandAugmentConfig, "magnitude", 31),
    ],
)
def test_bad_strengths_are_named(config, field, value):
    with pytest.raises(InputError, match=rf"^{config.__name__}\.{field}: found {value}, expected"):
        config(**{field: value})
