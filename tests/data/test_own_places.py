"""Training places of one's own: folders, and tables."""

import math

import pytest

from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.data.class_groups import class_groups
from crisalad_jax.data.places import epoch_batches, read_places
from crisalad_jax.data.views import views_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note


def _touch(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"")  # reading places opens no image


@pytest.fixture
def folders(tmp_path):
    root = tmp_path / "mine"
    _touch(root, "bridge/2.jpg", "bridge/1.JPG", "north/park/a.png", "north/park/b.png")
    _touch(root, "lone/1.jpg", ".hidden/1.jpg", "bridge/notes.txt")
    return root


def _table(root, text):
    root.mkdir(exist_ok=True)
    (root / "places.csv").write_text(text, encoding="utf-8")
    return root / "places.csv"


def test_each_folder_with_images_is_a_place(folders):
    with pytest.warns(Note, match="left out 1 of 3 places, with fewer than 2 images"):
        places = read_places(folders, min_images=2)
    assert places.names == ("bridge", "north/park")
    assert places.cities == ("mine",)
    assert places.files == ("bridge/1.JPG", "bridge/2.jpg", "north/park/a.png", "north/park/b.png")
    assert places.image_place.tolist() == [0, 0, 1, 1]
    assert places.path(2) == folders / "north" / "park" / "a.png"
    assert places.describe_place(1) == "place north/park"
    assert read_places(folders, min_images=1).image_counts.tolist() == [2, 1, 2]
    batches = epoch_batches(
        places,
        places_per_batch=2,
        images_per_place=2,
        order="within-city",
        seed=0,
        epoch=0,
    )
    assert sorted(batches.ravel().tolist()) == [0, 1, 2, 3]


@pytest.mark.parametrize("by_file", [False, True])
def test_a_table_names_places(folders, by_file):
    table = _table(
        folders,
        "\ufeffplace,name,sky\n7,bridge/1.JPG,sun\nold town,lone/1.jpg,\n\n7,bridge/2.jpg,\n",
    )
    places = read_places(table if by_file else folders, min_images=1)
    assert places.names == ("7", "old town")
    assert places.files == ("bridge/1.JPG", "bridge/2.jpg", "lone/1.jpg")
    assert places.root == folders
    assert not views_of(places).known.any()


def test_a_table_with_positions_makes_classes(folders):
    names = ("bridge/1.JPG", "bridge/2.jpg", "north/park/a.png", "north/park/b.png")
    # 0.001 degrees of latitude are 111 m: two cells of 10 m that are no neighbours.
    rows = [f"{name},{i % 2},{0.001 * (i // 2)},3.00001,{90}" for i, name in enumerate(names)]
    table = _table(folders, "\n".join(["name,place,lat,lon,heading", *rows]))
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
    ("table", "lacking"),
    [
        ("name,place\nbridge/1.JPG,a\n", r"no positions \(lat,lon\)"),
        ("name,place,lat,lon\nbridge/1.JPG,a,1,2\n", r"no headings \(heading\)"),
        (None, r"no positions \(lat,lon\)"),
    ],
)
def test_classes_by_position_say_what_they_lack(folders, table, lacking):
    if table:
        _table(folders, table)
    places = read_places(folders, min_images=1)
    message = rf"^.*mine: found {lacking} of the images, which .*'cells' asks for, expected [^\n]*$"
    with pytest.raises(InputError, match=message):
        class_groups(places, ClassesConfig(kind="cells"), min_images=1, places_per_batch=1)
    # Classes that are the places need none.
    one = ClassesConfig(groups=1)
    (group,) = class_groups(places, one, min_images=1, places_per_batch=1)
    assert len(group.files) == len(places.files)
    if table and "lat" in table:
        assert math.isnan(places.views[0, 2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"places\.csv: found columns none, expected name,place\[,lat,lon\[,heading\]\]$"),
        ("name;place\n", "found no row below the header"),
        (
            "name;place;lat;lon\nlone/1.jpg;a;91,5;0\n",
            "line 2: lat: found '91,5', expected degrees",
        ),
        ("name,place\n,a\n", "line 2: found no name, expected"),
        ("name,place,lat\n", "found columns name, place, lat, expected"),
        ("name,place,heading\n", "found columns name, place, heading, expected"),
        ("name,place\n", "found no row below the header"),
        ("name,place\nlone/1.jpg\n", "line 2: found 1 fields, expected 2"),
        ("name,place\nlone/1.jpg,\n", "line 2: found no place, expected"),
        (
            "name,place\nlone/1.jpg,a\nlone/1.jpg,b\n",
            "line 3: found 'lone/1.jpg' twice, on line 2 too",
        ),
        ("name,place\nlone/9.jpg,a\n", "found 1 of 1 images missing"),
        ("name,place,lat,lon\nlone/1.jpg,a,91,0\n", "line 2: lat: found '91', expected degrees"),
        ("name,place,lat,lon\nlone/1.jpg,a,1,\n", "line 2: lon: found '', expected degrees"),
    ],
)
def test_bad_tables(folders, text, message):
    _table(folders, text)
    with pytest.raises(InputError, match=message):
        read_places(folders)


def test_what_is_no_layout(tmp_path, folders):
    _touch(folders, "1.jpg")
    with pytest.raises(InputError, match=r"1\.jpg: found an image beside the folders"):
        read_places(folders)
    flat = tmp_path / "flat"
    _touch(flat, "1.jpg", "2.jpg")
    with pytest.raises(InputError, match=r"flat: found 1\.jpg, 2\.jpg, expected the layout of GSV"):
        read_places(flat)
    _touch(tmp_path / "set", "database/1.jpg", "queries/1.jpg")
    with pytest.raises(InputError, match=r"set: found an evaluation set .*, expected the layout"):
        read_places(tmp_path / "set")
    with pytest.raises(InputError, match=r"cities: found Paris for .*, expected none"):
        read_places(tmp_path / "set", cities=["Paris"])


def test_missing_images_of_a_table_are_left_out_with_a_note(folders):
    text = "name,place\nbridge/1.JPG,a\nbridge/3.jpg,a\nbridge/2.jpg,a\nnone.jpg,b\n"
    table = _table(folders, text)
    with pytest.raises(InputError, match="found 2 of 4 images missing"):
        read_places(table, min_images=1)
    with pytest.warns(Note, match=r"places.csv: left out 2 of 4 images, which are missing"):
        places = read_places(table, min_images=1, on_bad_image="skip")
    assert places.files == ("bridge/1.JPG", "bridge/2.jpg")
    _table(folders, "name,place\nnone.jpg,b\n")
    with pytest.raises(InputError, match="found none of 1 images, expected some"):
        read_places(table, min_images=1, on_bad_image="skip")
