"""Places that folders and tables name, and places by position or order, against ones by hand."""

import itertools

import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.data.class_groups import class_groups, views_of
from crisalad_jax.data.loader import ImageCache, training_batches
from crisalad_jax.data.places import read_places
from crisalad_jax.data.samplers.base import epoch_batches
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import RECIPE, write_picture, write_video
from tests.data.benchmarks.trees import refused, touch_all, write_sides
from tests.data.test_sources import write_jpeg


def _street(folder, xs):
    """Images along a line, without a picture in them, and a table of their positions."""
    names = [f"{number:02d}.jpg" for number in range(len(xs))]
    _write_table(touch_all(folder, names) / "gps.csv", "name,x,y", zip(names, xs, strict=True))
    return folder


def _write_table(path, header, rows):
    """A table; of a row that is shorter than the header the rest is 0."""
    columns = header.count(",") + 1
    lines = [",".join(map(str, [*row, *[0] * (columns - len(row))])) for row in rows]
    path.write_text("\n".join([header, *lines]), encoding="utf-8")
    return path


def _by_radius(root, min_images):
    """Places of a radius of 10 m."""
    return read_places(root, place_radius=10, positions=root / "gps.csv", min_images=min_images)


def _near(places):
    assert places.near is not None
    return [each.tolist() for each in places.near]


# By hand, radius 10: image 0 is a centre; 4 and 10 are within 10 m of it; 11 is a centre; 15 is
# within 10 m of it; 30 is a centre; so is 5000. Then 4 is nearer 0 and 10 nearer 11 than 0.
XS = (0, 4, 10, 11, 15, 30, 5000)
BY_HAND = {"00.jpg": [0, 1], "03.jpg": [2, 3, 4], "05.jpg": [5], "06.jpg": [6]}


def test_a_radius_makes_places_as_by_hand(tmp_path):
    root = _street(tmp_path / "walk", XS)
    touch_all(root, ["99.jpg"])
    with pytest.warns(Note, match=r"left out 1 of 8 images, which have no position"):
        places = _by_radius(root, 1)
    assert places.names == tuple(BY_HAND)
    groups = [list(group) for group in BY_HAND.values()]
    assert places.files == tuple(f"{image:02d}.jpg" for image in itertools.chain(*groups))
    assert places.image_counts.tolist() == [2, 3, 1, 1]
    assert places.root == root
    # Centres at 0, 11, 30 and 5000: up to 40 m apart they are near.
    assert _near(places) == [[1, 2], [0, 2], [0, 1], []]


def test_places_with_few_images_are_left_out_and_counted(tmp_path):
    root = _street(tmp_path / "walk", XS)
    with pytest.warns(Note, match=r"left out 2 of 4 places, with fewer than 2 images$"):
        places = _by_radius(root, 2)
    assert places.names == ("00.jpg", "03.jpg")
    assert _near(places) == [[1], [0]]  # by their new numbers
    words = r"largest has 3, of 4 places \(--place-radius, .*--min-images\)$"
    with refused(f"walk: found no place with at least 4 images; the {words}"):
        _by_radius(root, 4)


@pytest.mark.parametrize(
    ("degrees", "radius", "counts"),
    [
        # One degree of latitude is 110.6 km at the equator, and 111.7 km at the poles. 9 is nearer
        # 12 than 0.
        ([(f"{47 + metres / 111_170:.8f}", 8.5) for metres in (0, 9, 12, 100)], 10, [1, 2, 1]),
        # At 50 degrees 0.0002 of longitude are 111,320 m x cos 50 x 0.0002 = 14.3 m; zone 32
        # begins at 6 degrees east.
        ([(50, 5.9999), (50, 6.0001)], 14, [1, 1]),
        ([(50, 5.9999), (50, 6.0001)], 15, [2]),
    ],
)
def test_degrees_are_metres_of_utm(tmp_path, degrees, radius, counts):
    rows = [(f"{number}.jpg", *point) for number, point in enumerate(degrees)]
    touch_all(tmp_path, [row[0] for row in rows])
    table = _write_table(tmp_path / "t.csv", "name,lat,lon", rows)  # a table is a source
    places = read_places(table, place_radius=radius, min_images=1)
    assert places.image_counts.tolist() == counts
    if len(counts) == 3:
        assert places.names == ("0.jpg", "2.jpg", "3.jpg")
        assert _near(places) == [[1], [0], []]


def test_exif_data_says_where(tmp_path):
    # 0.36 seconds of latitude are 111.3 km / 3600 x 0.36 = 11.1 m.
    for name, seconds in (("a.jpg", 46.56), ("b.jpg", 46.92)):
        write_jpeg(tmp_path / name, _2=(52.0, 13.0, seconds))
    for radius, counts in ((10, [1, 1]), (13, [2])):
        places = read_places(tmp_path, place_radius=radius, min_images=1)
        assert places.image_counts.tolist() == counts


@pytest.mark.parametrize("seed", [0, 1])
def test_negatives_of_a_batch_are_farther_than_its_positives(tmp_path, seed):
    # Two loops through the same square of streets, at random steps.
    rng = np.random.default_rng(seed)
    corners = [(0, 0), (300, 0), (300, 200), (0, 200), (0, 0)]
    points = {}
    for loop in range(2):
        along = np.sort(rng.uniform(0, 4, 300))
        for number, t in enumerate(along):
            (x0, y0), (x1, y1) = corners[int(t)], corners[int(t) + 1]
            part = t - int(t)
            x, y = x0 + part * (x1 - x0), y0 + part * (y1 - y0) + rng.uniform(-2, 2)
            points[f"{loop}/{number:03d}.jpg"] = (x, y)
    rows = [(name, *point) for name, point in points.items()]
    table = _write_table(touch_all(tmp_path, points) / "t.csv", "name,x,y", rows)
    places = read_places(table, place_radius=10, min_images=4)
    where = np.array([points[file] for file in places.files])
    draw = {"places_per_batch": 8, "images_per_place": 4, "sampler": "shuffled", "seed": seed}
    batches = epoch_batches(places, epoch=0, **draw)
    for batch in batches:
        place, at = places.image_place[batch.ravel()], where[batch.ravel()]
        distance = np.linalg.norm(at[:, None] - at, axis=-1)
        same = place[:, None] == place
        assert distance[same].max() <= 20 < distance[~same].min()  # two radii
    # An epoch uses nearly all places: of 100 m of street there are some nine.
    assert len(batches) * 8 >= 0.7 * len(places.names)
    assert len(np.unique(places.image_place[batches[..., 0]])) == len(batches) * 8  # each once
    np.testing.assert_array_equal(batches, epoch_batches(places, epoch=0, **draw))
    longer = epoch_batches(places, epoch=0, steps=3 * len(batches), **draw)
    assert len(longer) == 3 * len(batches)
    np.testing.assert_array_equal(longer[: len(batches)], batches)


def test_too_many_places_for_a_batch(tmp_path):
    # 100 m hold at most three 40 m apart.
    places = _by_radius(_street(tmp_path / "walk", range(0, 100, 2)), 2)
    draw = {"images_per_place": 2, "sampler": "shuffled", "seed": 0, "epoch": 0}
    assert len(epoch_batches(places, places_per_batch=2, **draw))
    with pytest.raises(InputError, match=r"expected places_per_batch 5 .* not near each other"):
        epoch_batches(places, places_per_batch=5, **draw)


def test_every_n_frames_in_order(tmp_path):
    touch_all(tmp_path, [*(f"a/{number}.jpg" for number in range(1, 6)), "b/1.jpg", "b/2.jpg"])
    places = read_places(tmp_path, place_frames=2, min_images=1)
    assert places.names == ("a/1.jpg", "a/3.jpg", "a/5.jpg", "b/1.jpg")
    assert places.image_counts.tolist() == [2, 2, 1, 2]
    # The last of one folder is no neighbour of the first of the next.
    assert _near(places) == [[1], [0, 2], [1], []]
    for name in ("c.avi", "d.avi"):
        write_video(tmp_path / name, 4, rate=10)
    places = read_places(tmp_path / "*.avi", place_frames=2, fps=10, min_images=1)
    assert _near(places) == [[1], [0], [3], [2]]  # nor are those of two videos


@pytest.mark.parametrize("cache", [None, ImageCache(), ImageCache(40_000)])
def test_a_video_trains_as_its_frames(tmp_path, cache):
    video = write_video(tmp_path / "walk.avi", 16, rate=10)
    places = read_places(video, place_frames=4, fps=10, min_images=4)
    seconds = ("0.000", "0.400", "0.800", "1.200")
    assert places.names == tuple(f"walk.avi#t={second}" for second in seconds)
    how = {"sampler": "shuffled", "augmentation": "none", "seed": 0, "epoch": 0, "cache": cache}
    sizes = {"image_size": (48, 64), "places_per_batch": 2, "images_per_place": 2}
    batches = training_batches(places, **sizes, **how)
    for batch in batches:
        # Frame i is grey of level 10 i; MJPG and the resize to the same size leave it to a level.
        frames = np.rint(batch.images.mean(axis=(1, 2, 3)) / 10).astype(int)
        assert (frames // 4).tolist() == batch.labels.tolist()
        first, second = batch.labels[0], batch.labels[2]
        assert abs(first - second) > 1


UNFIT = "^.*walk: found conflicting arguments, expected --cities for the layout of G"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"place_radius": 0}, r"^--place-radius: found 0, expected metres above 0$"),
        ({"place_frames": 1}, r"^--place-frames: found 1, expected at least 2$"),
        ({"place_radius": 5, "place_frames": 4}, UNFIT),
        ({"positions": "gps.csv"}, UNFIT),
        ({"place_frames": 4, "cities": ["a"]}, UNFIT),
        ({"place_frames": 4, "fps": 2.0}, r"^--fps: found 2 without a video"),
        ({"place_radius": 5}, r"walk: found no position of 7 images, expected --positions TA"),
    ],
)
def test_arguments_that_do_not_fit_are_told(tmp_path, given, words):
    with pytest.raises(InputError, match=words):
        read_places(_street(tmp_path / "walk", XS), **given)


def test_a_source_that_has_no_places_says_which_flags_make_them(tmp_path):
    root = _street(tmp_path / "walk", XS)
    video = write_video(tmp_path / "walk.avi", 3)
    for source in (root / "gps.csv", video):
        with pytest.raises(InputError, match=r"; --place-radius METRES makes places by positions"):
            read_places(source)
    (tmp_path / "other.csv").write_text("name,x,y\nz.jpg,1,2\n")
    with pytest.raises(InputError, match=r"found none of the 7 images of .*, expected names such"):
        read_places(root, place_radius=5, positions=tmp_path / "other.csv")


def test_classes_of_a_group_are_not_near(tmp_path):
    places = _by_radius(_street(tmp_path / "walk", range(0, 400, 2)), 2)
    config = ClassesConfig(kind="places", groups=5)
    groups = class_groups(places, config, min_images=2, places_per_batch=2)
    assert len(groups) == 5
    for group in groups:
        assert group.near is None
        numbers = [places.names.index(name) for name in group.names]
        assert not any(set(_near(places)[number]) & set(numbers) for number in numbers)


def test_training_takes_a_folder_and_a_table(tmp_path):
    rows = []
    for place, view in itertools.product(range(6), range(3)):
        rows.append((f"{place}-{view}.jpg", 100 * place + view))
        write_picture(tmp_path / "walk" / rows[-1][0], place, noise=10.0 * (1 + view))
    table = _write_table(tmp_path / "gps.csv", "name,x,y", rows)
    given = {"place_radius": 10, "positions": table, "quiet": True}
    result = cj.train(RECIPE, tmp_path / "walk", tmp_path / "run", **given)
    assert result.steps == 3 * 2  # six places, three a batch, three epochs


@pytest.fixture
def folders(tmp_path):
    names = ("bridge/2.jpg", "bridge/1.JPG", "north/park/a.png", "north/park/b.png", "lone/1.jpg")
    return touch_all(tmp_path / "mine", [*names, ".hidden/1.jpg", "bridge/notes.txt"])


def test_each_folder_with_images_is_a_place(folders):
    with pytest.warns(Note, match="left out 1 of 3 places, with fewer than 2 images"):
        places = read_places(folders, min_images=2)
    assert places.names == ("bridge", "north/park")
    assert places.cities == ("mine",)
    assert places.files == ("bridge/1.JPG", "bridge/2.jpg", "north/park/a.png", "north/park/b.png")
    assert places.image_place.tolist() == [0, 0, 1, 1]
    assert places.path(2) == folders / "north" / "park" / "a.png"
    assert read_places(folders, min_images=1).image_counts.tolist() == [2, 1, 2]
    sizes = {"places_per_batch": 2, "images_per_place": 2}
    batches = epoch_batches(places, sampler="within-city", seed=0, epoch=0, **sizes)
    assert sorted(batches.ravel().tolist()) == [0, 1, 2, 3]


@pytest.mark.parametrize("by_file", [False, True])
def test_a_table_names_places(folders, by_file):
    text = "\ufeffplace,name,sky\n7,bridge/1.JPG,sun\nold town,lone/1.jpg,\n\n7,bridge/2.jpg,\n"
    table = folders / "places.csv"
    table.write_text(text, encoding="utf-8")
    places = read_places(table if by_file else folders, min_images=1)
    assert places.names == ("7", "old town")
    assert places.cities == ("mine",)
    assert places.files == ("bridge/1.JPG", "bridge/2.jpg", "lone/1.jpg")
    assert places.root == folders
    assert not views_of(places).known.any()


def test_a_table_may_be_of_several_cities(folders):
    """Far from each other, with places of the same names; in the order of the cities."""
    rows = [
        *(
            ("bridge/1.JPG", 1, 60.0, 170.0, "Nome"),
            ("north/park/b.png", 1, -20.0, -40.0, "Anchieta"),
        ),
        *(
            ("bridge/2.jpg", 1, 60.1, 170.0, "Nome"),
            ("north/park/a.png", 2, -20.0, -40.1, "Anchieta"),
        ),
    ]
    _write_table(folders / "places.csv", "name,place,lat,lon,city", rows)
    places = read_places(folders, min_images=1)
    assert places.cities == ("Anchieta", "Nome")
    assert places.names == ("1 of Anchieta", "2 of Anchieta", "1 of Nome")
    assert places.files == ("north/park/b.png", "north/park/a.png", "bridge/1.JPG", "bridge/2.jpg")
    assert places.place_city.tolist() == [0, 0, 1]
    # 0.1 degrees of longitude and of latitude, each in its city's zone.
    views = views_of(places)
    assert abs(views.east[0] - views.east[1]) == pytest.approx(10_460, rel=1e-2)
    assert abs(views.north[2] - views.north[3]) == pytest.approx(11_140, rel=1e-2)
    _write_table(folders / "places.csv", "name,place,lat,lon", [row[:4] for row in rows])
    with refused("expected at most 60, .* a set of several cities needs a column city"):
        views_of(read_places(folders, min_images=1))


def test_a_table_with_positions_makes_classes(folders):
    names = ("bridge/1.JPG", "bridge/2.jpg", "north/park/a.png", "north/park/b.png")
    # 0.001 degrees of latitude are 111 m: two cells of 10 m that are no neighbours.
    rows = [(name, i % 2, 0.001 * (i // 2), 3.00001, 90) for i, name in enumerate(names)]
    table = _write_table(folders / "places.csv", "name,place,lat,lon,heading", rows)
    places = read_places(table, min_images=1)
    views = views_of(places)
    # The central meridian of zone 31 is 3 degrees, whose east is 500 km.
    assert views.east == pytest.approx([500_001.113] * 4, abs=0.01)  # 1.113 m, to 1 cm
    assert views.heading.tolist() == [90.0] * 4
    config = ClassesConfig(kind="cells", groups=1, spacing=1, sector_spacing=1)
    (group,) = class_groups(places, config, min_images=2, places_per_batch=1)
    assert group.files == names  # the places of the table have one image of each cell
    assert group.image_counts.tolist() == [2, 2]
    assert views_of(group).north == pytest.approx([0, 0, 110.53, 110.53], abs=0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"places\.csv: found columns none; missing name$"),
        ("name;place\n", "found no place with at least 4 images"),
        ("name,place,heading\n", "found columns name, place, heading, expected"),
        ("name,place\nlone/1.jpg,\n", "line 2: found no place, expected"),
    ],
)
def test_bad_tables(folders, text, message):
    (folders / "places.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_places(folders)


def test_what_is_no_layout(tmp_path, folders):
    touch_all(folders, ["1.jpg"])
    words = "mine: found .*, expected the layout of GSV.*, without an image next to the folders"
    with pytest.raises(InputError, match=words):
        read_places(folders)
    write_sides(tmp_path / "set", ["1.jpg"], ["1.jpg"])
    with pytest.raises(InputError, match="set: found database/, queries/, expected the layout of"):
        read_places(tmp_path / "set")


def test_missing_images_of_a_table_are_left_out_with_a_note(folders):
    table = folders / "places.csv"
    table.write_text("name,place\nbridge/1.JPG,a\nbridge/3.jpg,a\nbridge/2.jpg,a\nnone.jpg,b\n")
    with pytest.raises(InputError, match="found 2 of 4 images missing"):
        read_places(table, min_images=1)
    with pytest.warns(Note, match=r"places.csv: left out 2 of 4 images, which are missing"):
        places = read_places(table, min_images=1, on_bad_image="skip")
    assert places.files == ("bridge/1.JPG", "bridge/2.jpg")
    table.write_text("name,place\nnone.jpg,b\n")
    with pytest.raises(InputError, match="found 1 of 1 images missing"):
        read_places(table, min_images=1, on_bad_image="skip")
