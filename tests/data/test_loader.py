"""Batches of images: what is in them, that nothing but the seed decides it, and bad files."""

import itertools
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.data import loader
from crisalad_jax.data.augmentations import NoAugmentation
from crisalad_jax.data.augmentations.light import LightAugmentConfig
from crisalad_jax.data.augmentations.rand_augment import RandAugmentConfig
from crisalad_jax.data.images import read_image
from crisalad_jax.data.loader import ImageBatch, ImageCache, training_batches
from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.reading import image_batches
from crisalad_jax.data.resize import resize_image
from crisalad_jax.data.samplers.base import epoch_batches
from crisalad_jax.utils.errors import InputError
from tests.conftest import write_picture
from tests.data.benchmarks.trees import refused

SIZE = (28, 42)
LIGHT = LightAugmentConfig(flip=0.5)
STILL = LightAugmentConfig(
    crop=0.0, shift=0.0, rotation=0.0, flip=0.5, blur=0.0, colour=0.0, grey=0.0
)


@pytest.fixture
def places(tmp_path: Path) -> Places:
    for place, view in itertools.product(range(7), range(3)):
        write_picture(tmp_path / "A" / str(place) / f"{view}.jpg", 3 * place + view)
    return read_places(tmp_path / "A", min_images=3)


def start(places: Places, **changes) -> Iterator[ImageBatch]:
    arguments = {
        "image_size": SIZE,
        "places_per_batch": 2,
        "images_per_place": 3,
        "sampler": "within-city",
        "augmentation": NoAugmentation(),
        "seed": 1,
        "epoch": 4,
    }
    return training_batches(places, **(arguments | changes))


def train(places: Places, **changes) -> list[ImageBatch]:
    return list(start(places, **changes))


def plain(path: Path) -> np.ndarray:
    return resize_image(read_image(path), SIZE)


def assert_same(found: list[ImageBatch], expected: list[ImageBatch]) -> None:
    assert len(found) == len(expected) > 0
    for a, b in zip(found, expected, strict=True):
        for x, y in zip(a, b, strict=True):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)


def test_training_batches_hold_the_images_that_the_epoch_drew(places):
    batches = train(places)
    drawn = epoch_batches(
        places, places_per_batch=2, images_per_place=3, sampler="within-city", seed=1, epoch=4
    )
    assert len(batches) == len(drawn) == 3
    for batch, images in zip(batches, drawn.reshape(3, 6), strict=True):
        assert batch.images.dtype == np.uint8
        assert batch.labels.dtype == np.int32
        assert batch.indices.dtype == np.int64
        np.testing.assert_array_equal(batch.indices, images)
        np.testing.assert_array_equal(batch.labels, images // 3)  # three images a place
        assert batch.valid.all()
        for image, index in zip(batch.images, images, strict=True):
            np.testing.assert_array_equal(image, plain(places.path(index)))


def test_training_resizes_bytes_to_one_size_by_the_models_filter(places):
    """Antialiased, as Pillow always does, whatever the model's own way."""
    how = PreprocessingConfig(
        size_rule="native", filter="bicubic", antialias=False, pixels="floats"
    )
    batch, *_ = train(places, preprocessing=how)
    assert batch.images.dtype == np.uint8
    for image, index in zip(batch.images, batch.indices, strict=True):
        expected = resize_image(
            read_image(places.path(index)), SIZE, filter="bicubic", antialias=True
        )
        np.testing.assert_array_equal(image, expected)


@pytest.mark.parametrize("augmentation", [NoAugmentation(), LIGHT, RandAugmentConfig()])
def test_threads_restarts_and_caches_do_not_change_a_bit(places, augmentation):
    whole = train(places, augmentation=augmentation)
    for threads in (0, 1, 5):
        assert_same(train(places, augmentation=augmentation, threads=threads), whole)
    assert_same(train(places, augmentation=augmentation, start_step=1), whole[1:])
    assert train(places, augmentation=augmentation, start_step=3) == []
    cache = ImageCache()
    for _ in range(2):
        assert_same(train(places, augmentation=augmentation, cache=cache), whole)


def test_opencv_has_one_thread_while_batches_are_read(places):
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        first, second = (
            image_batches([places.path(0)] * 4, image_size=SIZE, batch_size=2) for _ in range(2)
        )
        next(first)
        next(second)
        assert cv2.getNumThreads() == 1
        first.close()
        assert cv2.getNumThreads() == 1
        assert len(list(second)) == 1
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


def test_parts_of_a_batch_are_the_whole(places):
    """For processes, each of which reads one: also on from the middle of an epoch."""
    options = {"augmentation": RandAugmentConfig(), "start_step": 1}
    whole = train(places, **options)
    parts = [train(places, part=(number, 3), **options) for number in range(3)]
    steps = [zip(*step, strict=True) for step in zip(*parts, strict=True)]
    assert_same([ImageBatch(*map(np.concatenate, step)) for step in steps], whole)
    with pytest.raises(InputError, match=r"found 0 and \(0, 4\), expected .* parts of 6"):
        train(places, part=(0, 4))
    with pytest.raises(InputError, match=r"found 0 and \(3, 3\)"):
        train(places, part=(3, 3))


@pytest.mark.parametrize("threads", [0, 1, 2, 5])
@pytest.mark.parametrize("batch_size", [1, 5, 20, 50])
def test_batches_of_any_size_are_the_images_one_by_one(places, batch_size, threads):
    paths = [places.path(number % 21) for number in range(47)]
    batches = list(image_batches(paths, image_size=SIZE, batch_size=batch_size, threads=threads))
    images = np.concatenate([batch.images[batch.valid] for batch in batches])
    np.testing.assert_array_equal(images, np.stack([plain(path) for path in paths]))
    indices = np.concatenate([batch.indices for batch in batches])
    padding = -47 % batch_size
    np.testing.assert_array_equal(indices, [*range(47), *[-1] * padding])
    for batch in batches:
        np.testing.assert_array_equal(batch.labels, batch.indices)
        np.testing.assert_array_equal(batch.valid, batch.indices >= 0)
        assert not batch.images[~batch.valid].any()
    assert list(image_batches([], image_size=SIZE, batch_size=batch_size)) == []


def test_augmentation_draws_from_seed_epoch_step_and_slot(places):
    config = RandAugmentConfig()
    for step, batch in enumerate(train(places, augmentation=config)):
        for slot, index in enumerate(batch.indices):
            generator = np.random.default_rng((1, 4, step, slot))
            expected = config.apply(plain(places.path(index)), generator, of_place=generator)
            np.testing.assert_array_equal(batch.images[slot], expected)


def test_a_place_is_mirrored_as_a_whole(places):
    mirrored = []
    for epoch in range(20):
        for batch in train(places, augmentation=STILL, epoch=epoch):
            for slot, index in enumerate(batch.indices):
                image = plain(places.path(index))
                flipped = np.array_equal(batch.images[slot], image[:, ::-1])
                assert flipped or np.array_equal(batch.images[slot], image)
                mirrored.append(flipped)
    by_place = np.array(mirrored).reshape(-1, 3)
    assert (by_place == by_place[:, :1]).all()
    # 120 fair coins fall outside 35 to 85 heads once in 200,000 draws.
    assert 35 <= by_place[:, 0].sum() <= 85


@pytest.mark.parametrize("content", [b"", b"no image", None])
def test_a_bad_training_image(places, content):
    path = places.path(4)
    whole = train(places)
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    before = start(places)
    bad = next(number for number, batch in enumerate(whole) if 4 in batch.indices)
    for number in range(bad):
        assert_same([next(before)], [whole[number]])
    with refused(f"{path}: "):
        next(before)
    batches = train(places, on_bad_image="skip")
    slots = np.concatenate([batch.indices for batch in batches])
    valid = np.concatenate([batch.valid for batch in batches])
    images = np.concatenate([batch.images for batch in batches])
    np.testing.assert_array_equal(valid, slots != 4)
    assert (~valid).sum() == 1
    assert not images[~valid].any()
    np.testing.assert_array_equal(images[valid], np.concatenate([b.images for b in whole])[valid])


def test_cache_decodes_once_within_its_budget(places):
    paths = [places.path(i) for i in range(4)]
    height, width = SIZE
    cache = ImageCache(budget_bytes=3 * height * width * 2)  # room for two images
    first = [cache.read(path, Preparation(SIZE)) for path in paths]
    for path in paths[:2]:
        path.unlink()
    for path, image in zip(paths[:2], first, strict=False):
        np.testing.assert_array_equal(cache.read(path, Preparation(SIZE)), image)
    paths[2].unlink()
    with pytest.raises(InputError):
        cache.read(paths[2], Preparation(SIZE))
    with pytest.raises(InputError):
        cache.read(paths[0], (14, 14))  # another size is another image
    with pytest.raises(ValueError, match="read-only"):
        first[0][0, 0] = 0


def test_as_many_threads_decode_as_are_asked_for(places, monkeypatch):
    """Each waits until all do: fewer, such as the images of two batches, would wait for ever."""
    barrier = threading.Barrier(7, timeout=30)
    read = loader.read_pixels

    def wait(*args, **options):
        barrier.wait()
        return read(*args, **options)

    monkeypatch.setattr(loader, "read_pixels", wait)
    paths = [places.path(i) for i in range(7)]
    batches = list(image_batches(paths, image_size=SIZE, batch_size=2, threads=7))
    assert sum(batch.valid.sum() for batch in batches) == 7


def test_an_abandoned_iterator_stops_reading(places, monkeypatch):
    reads = []
    go_on = threading.Event()

    def slow_read(path, *, enough, read_far):
        reads.append(path)
        if len(reads) > 16:
            assert go_on.wait(timeout=30)
        return np.zeros((*SIZE, 3), np.uint8)

    monkeypatch.setattr(loader, "read_pixels", slow_read)
    before = set(threading.enumerate())
    paths = [f"{i}" for i in range(400)]
    batches = image_batches(paths, image_size=SIZE, batch_size=16, threads=1)
    next(batches)
    started = set(threading.enumerate()) - before
    # Closing cancels what has not begun, then waits for what has: let that go on meanwhile.
    threading.Timer(1, go_on.set).start()
    batches.close()
    for thread in started:
        thread.join(timeout=30)
        assert not thread.is_alive()
    # The first batch, and the image that the thread had in hand.
    assert len(reads) <= 17


def test_an_abandoned_iterator_does_not_hold_up_the_exit(places):
    program = (
        "import sys\n"
        "from crisalad_jax.data.reading import image_batches\n"
        "batches = image_batches([sys.argv[1]] * 10**6, image_size=(28, 28), batch_size=4)\n"
        "next(batches)\n"
        "print('leaving')\n"
    )
    # A million images would take minutes; the timeout only keeps a failure from hanging.
    done = subprocess.run(
        [sys.executable, "-c", program, str(places.path(0))],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout.strip()) == (0, "leaving"), done.stderr


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_step": 4}, "start_step, part: found 4 .*, expected 0 to 3"),
        ({"image_size": (0, 14)}, "image_size"),
        ({"on_bad_image": "black"}, "on_bad_image: found 'black', expected one of skip, stop"),
        ({"threads": -1}, "threads: found -1"),
        ({"augmentation": "nonne"}, "^augmentation: found 'nonne', expected one of .*none"),
        ({"augmentation": RandAugmentConfig}, "^augmentation: found .*, expected .* or its name$"),
    ],
)
def test_bad_arguments_raise_at_the_call(places, changes, message):
    with pytest.raises(InputError, match=message):
        start(places, **changes)


class Cutting(NoAugmentation):
    part_name = "cutting"

    def apply(self, image, generator, *, of_place):
        return image[1:]


def test_an_augmentation_that_returns_another_shape_is_named(places):
    with pytest.raises(InputError, match=r"^augmentation cutting: found to return uint8 of shape "):
        train(places, augmentation=Cutting())
