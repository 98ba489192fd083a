"""The GSV-Cities reader on small trees, against the rows they were written from."""

import csv
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.places import Places, read_places
from crisalad_jax.data.samplers.base import epoch_batches
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note
from tests.conftest import PHOTOGRAPHS
from tests.data.benchmarks.trees import touch_all
from tests.data.test_class_groups import places_of

COLUMNS = ["place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid"]


def make_rows(city_id: str, place: int, images: int) -> list[list[str]]:
    # lat and lon as no float would print them, northdeg beyond 360
    return [
        [str(place), "2013", "8", str(355 + i), city_id, "48.850", "-2.0e0", f"pano{i}"]
        for i in range(images)
    ]


def image_name(row: list[str]) -> str:
    place, year, month, north, city_id, lat, lon, pano = row
    return (
        f"{city_id}_{place[-5:].zfill(7)}_{year.zfill(4)}_{month.zfill(2)}_{north.zfill(3)}"
        f"_{lat}_{lon}_{pano}"
    )


def write_city(
    root: Path,
    city: str,
    rows: list[list[str]],
    *,
    folder: str | None = None,
    suffix: str = ".jpg",
) -> None:
    table = root / "Dataframes" / f"{city}.csv"
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    for row in rows:
        touch_all(root / "Images" / (folder or row[4]), [image_name(row) + suffix])


@pytest.fixture
def two_cities(tmp_path: Path) -> Path:
    # B: rows interleaved, one place of 3 images, the folder named by the CSV, .JPG files
    write_city(tmp_path, "A", [row for p in (0, 7, 99) for row in make_rows("A", p, 4)])
    rows = [row for p in (7, 12) for row in make_rows("Bid", p, 5)] + make_rows("Bid", 3, 3)
    write_city(tmp_path, "B", rows[::2] + rows[1::2], folder="B", suffix=".JPG")
    return tmp_path


def uneven(cities: int, places_per_city: int) -> Places:
    """Places with 4, 5, 6, 4, ... images, without files."""
    counts = 4 + np.arange(cities * places_per_city) % 3
    return places_of(np.zeros((counts.sum(), 3)), counts.tolist(), cities)


def test_reads_what_was_written(two_cities):
    with pytest.warns(Note, match="left out 1 of 6 places, with fewer than 4 images"):
        places = read_places(two_cities)
    assert places.cities == ("A", "B")
    assert places.place_city.tolist() == [0, 0, 0, 1, 1]
    assert places.image_counts.tolist() == [4, 4, 4, 5, 5]
    assert places.place_start.tolist() == [0, 4, 8, 12, 17, 22]
    # Place 3 of B has too few images.
    assert places.names == ("0 of A", "7 of A", "99 of A", "7 of B", "12 of B")
    assert places.views[:2].tolist() == [[48.85, -2.0, 355.0], [48.85, -2.0, 356.0]]
    for image, place in enumerate(places.image_place):
        path = places.path(image)
        assert path.is_file()
        city_id, place_id = path.name.split("_")[:2]
        assert city_id == ("A" if place < 3 else "Bid")
        assert f"{int(place_id)} of {city_id[0]}" == places.names[place]
    assert len(set(places.files)) == 22
    assert places.files[0] == "Images/A/A_0000000_2013_08_355_48.850_-2.0e0_pano0.jpg"
    assert {Path(file).suffix for file in places.files[12:]} == {".JPG"}


def test_chosen_cities_keep_their_order(two_cities):
    places = read_places(two_cities, cities=["B", "A"], min_images=3)
    assert places.cities == ("B", "A")
    assert places.names == ("3 of B", "7 of B", "12 of B", "0 of A", "7 of A", "99 of A")


def test_a_city_that_was_not_downloaded(two_cities):
    """Its table came with the others: the message says how to go on, and that works."""
    shutil.rmtree(two_cities / "Images" / "A")
    with pytest.raises(InputError, match=r"A\.csv: line 2: found no file Images/A.* --cities"):
        read_places(two_cities)
    assert read_places(two_cities, cities=["B"], min_images=3).cities == ("B",)


def test_ids_with_an_offset_name_files_without_it(tmp_path):
    write_city(tmp_path, "A", make_rows("A", 300042, 4))
    places = read_places(tmp_path)
    assert "A_0000042_" in places.files[0]
    assert places.names == ("42 of A",)


def test_a_repeated_row_is_one_image(tmp_path):
    rows = make_rows("A", 1, 4)
    write_city(tmp_path, "A", [*rows, rows[2]])
    assert read_places(tmp_path).image_counts.tolist() == [4]


def test_no_tables(tmp_path):
    (tmp_path / "Dataframes").mkdir()
    with pytest.raises(InputError, match="no CSV file"):
        read_places(tmp_path)


def test_missing_columns_are_listed(two_cities):
    (two_cities / "Dataframes" / "A.csv").write_text("place_id,year,month,city_id,lat,panoid\n")
    with pytest.raises(InputError, match=r"A.csv: found columns .*; missing northdeg, lon$"):
        read_places(two_cities)


def test_a_missing_image_is_named_with_its_line_or_left_out_with_a_note(two_cities):
    (two_cities / "Images" / "A" / f"{image_name(make_rows('A', 7, 4)[1])}.jpg").unlink()
    with pytest.raises(InputError, match=r"A\.csv: line 7: .*A_0000007_2013_08_356_48.850"):
        read_places(two_cities)
    with pytest.warns(Note) as notes:
        places = read_places(two_cities, min_images=4, on_bad_image="skip")
    assert [str(each.message).split(": ")[1] for each in notes] == [
        "left out 1 rows, whose images are missing",
        "left out 2 of 6 places, with fewer than 4 images",  # place 7 of A has 3 now
    ]
    assert places.names == ("0 of A", "99 of A", "7 of B", "12 of B")
    assert places.image_counts.tolist() == [4, 4, 5, 5]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cities": ["A", "Paris"]}, r"\(--cities\): found A, Paris, expected some of .*: A, B"),
        ({"cities": ["A", "A"]}, "found A, A, expected .*, each once"),
    ],
)
def test_bad_cities(two_cities, given, message):
    with pytest.raises(InputError, match=message):
        read_places(two_cities, **given)


@pytest.mark.parametrize(
    ("column", "text"),
    [("place_id", "x1"), ("month", ""), ("lat", "n/a")],
)
def test_a_field_that_is_no_number(two_cities, column, text):
    row = make_rows("A", 1, 1)[0]
    row[COLUMNS.index(column)] = text
    with (two_cities / "Dataframes" / "A.csv").open("a") as file:
        file.write(",".join(row) + "\n")
    with pytest.raises(InputError, match=rf"A\.csv: line 14: found .*{text}.*, expected whole"):
        read_places(two_cities)


def draw(places: Places, sampler="shuffled", seed=0, epoch=0, **changes) -> np.ndarray:
    sizes = {"places_per_batch": 4, "images_per_place": 4} | changes
    return epoch_batches(places, sampler=sampler, seed=seed, epoch=epoch, **sizes)


@pytest.mark.parametrize("sampler", ["within-city", "shuffled"])
def test_epoch_samples_each_place_once(sampler):
    """As a function of the seed and the epoch; a city after the other, or all mixed."""
    places = uneven(cities=3, places_per_city=10)
    batches = draw(places, sampler, 1, 2)
    np.testing.assert_array_equal(batches, draw(places, sampler, 1, 2))
    assert (batches != draw(places, sampler, 1, 3)).any()
    assert (batches != draw(places, sampler, 2, 2)).any()
    assert batches.shape == (7, 4, 4)  # 30 places: the last two are dropped
    cities = places.place_city[places.image_place[batches[..., 0]]]
    changes = (np.diff(cities.ravel()) != 0).sum()
    assert changes == 2 if sampler == "within-city" else changes > 2
    labels = places.image_place[batches]
    assert (labels == labels[..., :1]).all()
    assert Counter(labels[..., 0].ravel().tolist()).most_common(1)[0][1] == 1
    assert len(np.unique(batches)) == batches.size


def test_an_epoch_of_so_many_steps_is_drawn_over_and_over():
    places = uneven(1, 6)
    once, often, seven = (
        draw(places, epoch=1, images_per_place=2, steps=steps) for steps in (None, 120, 7)
    )
    assert (len(once), len(often)) == (1, 120)  # of six places a batch of four is one
    np.testing.assert_array_equal(often[:1], once)
    np.testing.assert_array_equal(often[:7], seven)
    labels = places.image_place[often]
    assert (labels == labels[..., :1]).all()
    for batch in labels[..., 0]:
        assert len(set(batch.tolist())) == 4
    assert len({tuple(batch) for batch in labels[..., 0].tolist()}) > 100  # of 360
    # 120 draws of four of six: 80 each, give or take 5 standard deviations of 5.2.
    assert (abs(np.bincount(labels[..., 0].ravel()) - 80) < 26).all()


def test_every_image_is_sampled_equally_often():
    places = uneven(1, 6)
    seen = np.zeros(len(places.files))
    epochs = 600
    for epoch in range(epochs):
        batches = draw(places, epoch=epoch, places_per_batch=6, images_per_place=2)
        seen[batches.ravel()] += 1
    share = 2 / places.image_counts[places.image_place]
    # 5 standard deviations of a binomial share; the largest of 29 deviations is below 4 with
    # probability 0.998, and a fixed subset would be off by 0.5.
    np.testing.assert_array_less(
        abs(seen / epochs - share), 5 * np.sqrt(share * (1 - share) / epochs)
    )


def test_within_city_shuffles_places_and_cities():
    places = uneven(cities=3, places_per_city=4)
    first_cities, first_places = set(), set()
    for epoch in range(40):
        batches = draw(places, "within-city", epoch=epoch)
        first = places.image_place[batches[0, 0, 0]]
        first_places.add(int(first))
        first_cities.add(int(places.place_city[first]))
    assert first_cities == {0, 1, 2}
    assert len(first_places) > 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images_per_place": 5}, "place 0 has 4 images, expected at least .* 5"),
        ({"places_per_batch": 0}, "found places_per_batch=0, .* expected numbers from 1"),
        ({"steps": 0}, "found .*steps=0, expected numbers from 1"),
        ({"sampler": "random"}, "sampler: found 'random', expected one of cliques, .*within-city"),
    ],
)
def test_bad_epoch_arguments(changes, message):
    with pytest.raises(InputError, match=message):
        draw(uneven(2, 3), **({"places_per_batch": 2} | changes))


@pytest.mark.skipif(not (PHOTOGRAPHS / "sped_train").is_dir(), reason="needs the real photographs")
def test_real_training_set():
    places = read_places(PHOTOGRAPHS / "sped_train", min_images=2)
    assert places.cities == ("SPED",)
    assert places.image_counts.tolist() == [2] * 400
    with pytest.raises(InputError, match="at least 4 images; the largest has 2"):
        read_places(PHOTOGRAPHS / "sped_train")
