"""The columns of a map's images against a list of them."""

import tracemalloc

import numpy as np
import pytest

from crisalad_jax.data.positions import AXES
from crisalad_jax.retrieval.maps.images import Images, MapImage

NAMES = ["a.jpg", "café/1.jpg", "tokyo/東京.png", "bad/\udcff\udcfe.jpg", "", "z" * 300]


def grown(count: int, *, size: int) -> tuple[Images, list[MapImage]]:
    """Columns that grew in portions, and the list; every third image has a position."""
    images, expected = Images(), []
    for first in range(0, count, size):
        numbers = range(first, min(first + size, count))
        names = [NAMES[n] if n < len(NAMES) else f"folder/{n}.jpg" for n in numbers]
        spots = [None if n % 3 else (float(n), -0.5 * n) for n in numbers]
        root = f"/root{first % 2}"
        sizes = [10**12 + n for n in numbers]
        images.extend(root, None, names, sizes, spots, AXES[2])
        columns = zip(names, sizes, spots, strict=True)
        expected += [MapImage(name, byte, spot, root) for name, byte, spot in columns]
    return images, expected


def test_images_are_those_that_were_appended():
    images, expected = grown(10_000, size=999)
    assert len(images) == 10_000
    assert list(images) == expected
    assert images[5:20:3] == expected[5:20:3]
    assert (images[-1], images[np.int64(7)]) == (expected[-1], expected[7])
    with pytest.raises(IndexError):
        images[10_000]
    assert [images.find(image.name) for image in expected] == list(range(10_000))
    assert images.find("folder/10000.jpg") is None
    assert images.twice() is None


def test_what_is_removed_has_no_number_and_may_come_again():
    images, expected = grown(10_000, size=5000)
    gone = [0, 3, 9_999]
    left = images.changed(gone, [4], [(1.0, 2.0)], AXES[2])
    expected_left = [image for n, image in enumerate(expected) if n not in gone]
    expected_left[2] = expected_left[2]._replace(position=(1.0, 2.0))
    assert list(left) == expected_left
    assert list(images) == expected  # which answers may hold
    assert left.removed_names == {expected[n].name: {expected[n].bytes} for n in gone}
    for number in gone:
        assert left.find(expected[number].name) is None
        assert images.find(expected[number].name) == number
    left.extend("/again", None, ["a.jpg"], [5], [None], None)
    assert left[left.find("a.jpg") or 0] == MapImage("a.jpg", 5, None, "/again")
    assert left.twice() is None
    assert left.find("a.jpg") == 9_997
    again = left.changed([10_000], [], [], AXES[2])
    assert again.find("a.jpg") is None
    assert again.removed_names["a.jpg"] == {10**12, 5}


def test_a_name_of_two_images_is_found():
    images, _ = grown(100, size=50)
    images.extend("/again", None, ["x.jpg", "folder/70.jpg"], [5, 5], [None, None], None)
    assert images.twice() == 101
    assert images.changed([70], [], [], None).twice() is None


@pytest.mark.parametrize(
    "change",
    [
        {"names": ["a.jpg"]},
        {"names": ["a.jpg", 5]},
        {"names": ["a.jpg", "/b.jpg"]},
        {"names": ["a.jpg", "x/../b.jpg"]},
        {"sizes": [1]},
        {"sizes": [1, "x"]},
        {"sizes": [1, 2**70]},
        {"positions": [None]},
        {"positions": [None, [1.0]]},
        {"positions": [None, [1.0, None]]},
        {"positions": [None, [1.0, 1e99]]},
        {"positions": [[1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]]},
        {"axes": ("lat", "north")},
        {"root": 5},
        {"added": 5},
        {"added": "May"},
    ],
)
def test_values_of_another_type_append_nothing(change):
    images, expected = grown(10, size=5)
    given = {"root": "/", "added": None, "names": ["a", "b"], "sizes": [1, 2]}
    given |= {"positions": [None, (1.0, 2.0)], "axes": AXES[2]}
    with pytest.raises((ValueError, TypeError, OverflowError, IndexError)):
        images.extend(**given | change)
    assert list(images) == expected
    images.extend(**given)
    assert images[-1] == MapImage("b", 2, (1.0, 2.0), "/")


def test_an_image_takes_at_most_64_bytes_and_its_name():
    """As NumPy's and Python's allocators count them, after names are sorted as by opening."""
    count, size = 100_000, 250
    names = [f"folder/{number:08d}.jpg" for number in range(count)]
    tracemalloc.start()
    try:
        images = Images()
        for first in range(0, count, size):
            some = names[first : first + size]
            images.extend("/root", None, some, [7] * size, [(1.0, 2.0)] * size, AXES[2])
        images.twice()
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert used <= count * (64 + len(names[0]))
