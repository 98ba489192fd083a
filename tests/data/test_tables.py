"""Names of Windows and macOS in tables and lists, in every reader of them."""

import tracemalloc
import unicodedata

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.data.places import read_places
from crisalad_jax.data.positions import positions_of
from crisalad_jax.data.sources import open_source
from crisalad_jax.data.tables import Disk, matched, read_table
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json
from tests.data.benchmarks.test_netvlad import write as write_mat
from tests.data.benchmarks.trees import lists_of, touch

COMPOSED, DECOMPOSED = (unicodedata.normalize(form, "café") for form in ("NFC", "NFD"))
WAYS = [
    pytest.param(COMPOSED, rf"{COMPOSED}\é.jpg", id="backslashes"),
    pytest.param(COMPOSED, f"{DECOMPOSED}/{unicodedata.normalize('NFD', 'é')}.jpg", id="composed"),
    pytest.param(DECOMPOSED, f"{COMPOSED}/é.jpg", id="decomposed"),
]
"""The folder's name on disk, and how a table writes the image in it."""


def image(folder, cafe: str) -> str:
    """Make the image on disk, and return its name there."""
    form = "NFC" if cafe == COMPOSED else "NFD"
    name = f"{cafe}/{unicodedata.normalize(form, 'é')}.jpg"
    touch(folder / name)
    return name


@pytest.mark.parametrize(("cafe", "written"), WAYS)
def test_every_table_finds_its_images(tmp_path, cafe, written):
    name = image(tmp_path / "set" / "database", cafe)
    assert written != name
    image(tmp_path / "set" / "queries", cafe)
    slash = "\\" if "\\" in written else "/"
    table = tmp_path / "set" / "positions.csv"
    lines = [f"{side}{slash}{written},1,2" for side in ("database", "queries")]
    table.write_text("\n".join(["name,east,north", *lines]), encoding="utf-8")
    assert lists_of(open_benchmark(tmp_path / "set").positives) == [[0]]
    table.unlink()
    (tmp_path / "set" / "ground_truth.csv").write_text(f"{written},{written}\n", encoding="utf-8")
    assert lists_of(open_benchmark(tmp_path / "set").positives) == [[0]]

    folder = tmp_path / "set" / "database"
    (folder / "places.csv").write_text(f"name,place,lat,lon\n{written},a,1,2\n", encoding="utf-8")
    places = read_places(folder, min_images=1)
    assert places.files == (name,)
    assert places.views.tolist()[0][:2] == [1, 2]
    (folder / "images.csv").write_text(f"name,x,y\n{written},1,2\n", encoding="utf-8")
    source = open_source(folder / "images.csv")
    assert source.names == [name]
    assert source.positions.of == {name: (1, 2)}
    (folder / "list.txt").write_text(f"{written}\n", encoding="utf-8")
    assert open_source(folder / "list.txt").names == [name]
    assert positions_of(folder / "images.csv", [name], [folder / name], folder).of == {name: (1, 2)}


@pytest.mark.parametrize(("cafe", "written"), WAYS)
def test_every_list_finds_its_images(tmp_path, cafe, written):
    path = tmp_path / image(tmp_path, cafe)
    for kind in ("dbImages", "qImages"):
        np.save(tmp_path / f"a_{kind}.npy", np.array([written]))
    assert open_benchmark(tmp_path).database == (path,)
    names, place = np.array([written], object), np.array([[1.0], [2.0]])
    sides = {"dbImage": names, "qImage": names, "utmDb": place, "utmQ": place}
    write_mat(tmp_path / "a.mat", **sides, numDb=1.0, numQ=1.0)
    assert open_benchmark(tmp_path / "a.mat").queries == (path,)


def test_a_city_with_an_accent(tmp_path):
    city = unicodedata.normalize("NFD", "Málaga")
    touch(tmp_path / "Images" / city / f"{city}_0000001_2020_05_090_36.7_-4.4_a.jpg")
    (tmp_path / "Dataframes").mkdir()
    (tmp_path / "Dataframes" / "Malaga.csv").write_text(
        "place_id,year,month,northdeg,city_id,lat,lon,panoid\n1,2020,5,90,Málaga,36.7,-4.4,a\n",
        encoding="utf-8",
    )
    places = read_places(tmp_path, min_images=1)
    assert places.path(0).is_file()


def test_one_image_twice_is_told(tmp_path):
    touch(tmp_path / "a" / "é.jpg")
    (tmp_path / "list.csv").write_text("name\na/é.jpg\na\\é.jpg\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"line 3: found 'a\\\\é.jpg' twice, on line 2 too"):
        open_source(tmp_path / "list.csv")


def test_a_name_means_itself_first(tmp_path):
    r"""Where there are both a file called a\b.jpg and b.jpg in a folder a."""
    for name in ("a\\b.jpg", "a/b.jpg"):
        touch(tmp_path / name)
        assert Disk().find(tmp_path, name) == tmp_path / name
    assert matched(["a\\b", "a/b", "c"], ["a/b", "a\\b"]) == {"a\\b": "a\\b", "a/b": "a/b"}
    assert Disk().find(tmp_path, "../x/b.jpg") is None
    assert Disk().find(tmp_path / "a", "..\\a\\b.jpg") == tmp_path / "a" / ".." / "a" / "b.jpg"


@pytest.mark.parametrize("start", ["", "name,lat,lon\n", 'name,lat,lon\n"', "name;"])
def test_a_line_of_100_mb_is_read_no_further_than_it_takes_to_refuse_it(tmp_path, start):
    path = tmp_path / "long.csv"
    with path.open("wb") as file:
        file.write(start.encode())
        file.truncate(10**8)
    tracemalloc.start()
    with pytest.raises(InputError, match=r"long.csv: cannot be read as UTF-8 CSV: field larger"):
        read_table(path, "name")[2].__next__()
    assert tracemalloc.get_traced_memory()[1] < 3e7
    tracemalloc.stop()


def test_a_list_and_json_have_a_size_beyond_which_they_are_not_read(tmp_path):
    for name in ("list.txt", "recipe.json"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(2**27 + 1)
    with pytest.raises(InputError, match=r"list.txt: found 134217729 bytes, expected a list of"):
        open_source(tmp_path / "list.txt")
    with pytest.raises(InputError, match=r"recipe.json: found 134217729 bytes, expected a recipe"):
        read_json(tmp_path / "recipe.json", "a recipe")
