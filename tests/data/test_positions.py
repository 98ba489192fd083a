"""Positions from names and tables."""

import numpy as np
import pytest

from crisalad_jax.data.positions import Positions, read_image_table, utm_positions
from crisalad_jax.utils.errors import InputError
from tests.data.benchmarks.trees import refused


def test_names_say_east_and_north():
    others = ["plain.jpg", "@x@y@.jpg", "@nan@1@.jpg", "@1_0@2@.jpg", "@1e200@0@.jpg", "@1@2e8@"]
    others += ["@inf@0@.jpg", "@\u0661@2@.jpg", "@@.jpg", "@1@@.jpg"]
    found = utm_positions(["a/@0012.50@5000000.25@10@S@.jpg", "@1@-2@.png", *others])
    assert found.axes == ("east", "north")
    assert found.of == {
        "a/@0012.50@5000000.25@10@S@.jpg": (12.5, 5000000.25),
        "@1@-2@.png": (1.0, -2.0),
    }


@pytest.mark.parametrize(("north", "south"), [("4182401.73", False), ("5000000.25", True)])
def test_s_is_a_band_of_the_north_or_the_south(north, south):
    """San Francisco is in band S, which ends at 40 degrees, 4,430 km from the equator."""
    zone = utm_positions([f"@551550.00@{north}@10@S@.jpg"]).zone
    assert (zone.number, zone.south) == (10, south)


@pytest.mark.parametrize("at", [(float("nan"), 0.0), (0.0, 1e200), (-2e8, 0.0)])
def test_a_position_that_no_map_stores_is_refused(at):
    with pytest.raises(InputError, match=r"^a.jpg: found position .*, expected numbers of at most"):
        Positions(("x", "y"), {"a.jpg": at}).fitted("map", None, None)


@pytest.mark.parametrize(
    "at", [(np.float32(1), np.float32(2)), np.ones(2), (1.0, 2.0, 3.0), "12", None, ("1", "2")]
)
def test_what_is_no_pair_of_numbers_is_refused(at):
    """JSON, which maps keep them in, has no numbers of NumPy."""
    with pytest.raises(InputError, match=r"^a.jpg: found position .*, expected two Python numbers"):
        Positions(("x", "y"), {"a.jpg": at}).fitted("map", None, None)


def test_other_axes_are_refused():
    with pytest.raises(InputError, match=r"found axes .*lon.*lat.*, expected one of"):
        Positions(("lon", "lat"), {"a.jpg": (1.0, 2.0)}).fitted("map", None, None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name,east,y\n", "found columns name, east, y, expected only one of name,east,north"),
        ("name,east,north\na,1,2\na,1,2\n", "line 3: found 'a' twice, on line 2 too"),
        ("name,east,north\na,1\n", r"line 2: found 2 fields, expected 3 \(name,east,north\)"),
        ("name,east,north\na,1,inf\n", "line 2: north: found 'inf', expected a number from"),
        ("name,east,north\na,1,1e300\n", r"line 2: north: found '1e300', expected .* to 1e\+08"),
        ("name,east,north\na,1,1_0\n", "line 2: north: found '1_0', expected a number from"),
        ("name,lat,lon\na,91,0\n", "line 2: lat: found '91', expected a number from -90 to 90"),
        (b"name,east,north\n\xff,1,2\n", "cannot be read as UTF-8 CSV: 'utf-8'"),
        (None, "found no such file"),
    ],
)
def test_a_table_that_is_none_is_one_line(tmp_path, text, words):
    path = tmp_path / "positions.csv"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with refused(rf"positions\.csv: {words}"):
        read_image_table(path, all_positions=True)


@pytest.mark.parametrize("header", ["name,lat", "lon,name", "name,east,x", "name,north"])
def test_half_a_position_is_no_position_left_out(tmp_path, header):
    """A misspelt column would be noticed after the map is made, which keeps what it has."""
    (tmp_path / "a.csv").write_text(f"{header}\n")
    with refused("expected only one of name,east,north"):
        read_image_table(tmp_path / "a.csv")
