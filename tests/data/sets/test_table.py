"""The table of public data sets: its fields, and commands that parse."""

import importlib
import pathlib
import re
import shlex

import pytest

import crisalad_jax.cli
from crisalad_jax.data.sets import SETS, find_set
from crisalad_jax.utils.errors import InputError

# Of the notes on formats: the common list.
CITIES = (
    "Bangkok BuenosAires LosAngeles MexicoCity OSL Rome Barcelona Chicago Madrid Miami Phoenix TRT "
    "Boston Lisbon Medellin Minneapolis PRG WashingtonDC Brussels London Melbourne Osaka PRS"
)
ROOT = pathlib.Path(crisalad_jax.cli.__file__).parents[2]
ADDRESSES = {
    "http": r"https?://.+",
    "rsync": r"rsync://.+",
    "huggingface": r"[\w.-]+/[\w.-]+",
    "kaggle": r"[\w.-]+/[\w.-]+",
}


@pytest.mark.parametrize("name", SETS)
def test_a_set_has_what_its_host_needs(name):
    published = SETS[name]
    assert re.fullmatch(r"[a-z0-9-]+", name)
    assert published.page.startswith(("https://", "http://"))
    assert published.sources
    assert "" not in published.sources
    assert bool(published.files) == published.is_fetched
    assert bool(published.steps) == (not published.is_fetched)
    for file in published.files:
        assert re.fullmatch(ADDRESSES[published.host], file.address)
        assert file.sha256 is None or re.fullmatch("[0-9a-f]{64}", file.sha256)
    assert len({file.name for file in published.files}) == len(published.files)
    assert published.gigabytes is None or published.gigabytes > 0
    assert "DIR" in published.command
    assert all("DIR" not in step for step in published.by_hand("mine"))


@pytest.mark.parametrize("name", SETS)
def test_the_commands_of_a_set_parse(name):
    for command in SETS[name].by_hand("mine")[-2:]:
        program, verb, *given = shlex.split(command)
        assert program == "crisalad"
        module = importlib.import_module(f"crisalad_jax.cli.{verb}")
        assert crisalad_jax.cli._parse(verb, module, given) is not None


def test_the_page_has_a_row_of_every_set():
    page = (ROOT / "docs" / "datasets.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([a-z0-9-]+)` \| .* \| (.*) \|$", page, re.MULTILINE))
    for name, published in SETS.items():
        for part in published.parts:
            for count in (part.database, part.queries):
                assert count is None or f"{count:,}" in rows[name]


def test_the_cities_of_gsv_cities():
    assert set(SETS["gsv-cities"].cities) == set(CITIES.split())


def test_every_nordland_is_named():
    nordlands = {name: SETS[name].parts[0] for name in SETS if name.startswith("nordland")}
    counts = {name: (part.database, part.queries) for name, part in nordlands.items()}
    assert counts == {  # docs/datasets.md
        "nordland": (27592, 27592),
        "nordland-subset": (27592, 2760),
        "nordland-star": (27592, 2760),
        "nordland-selavpr": (3450, 3450),
    }


@pytest.mark.parametrize(
    ("name", "nearest"), [("pits30k", "pitts30k"), ("st_lucia", "st-lucia"), ("Nord", "nordland")]
)
def test_an_unknown_set_is_one_line_with_the_nearest(name, nearest):
    with pytest.raises(InputError, match=f"^{name}: found no data set .*nearest: .*{nearest}"):
        find_set(name)
