"""`crisalad models`, and published models by name at the verbs that take weights."""

import dataclasses
import json
import pathlib

import numpy as np
import pytest

from crisalad_jax.checkpoints.cache import cached_weights
from crisalad_jax.checkpoints.published import PUBLISHED, Licence, Published
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.training.start import read_start
from tests.checkpoints.test_cache import CONFIG, DATA, FILE
from tests.cli.test_cli import fails, runs
from tests.conftest import RECIPE, assert_equal, write_picture


@pytest.fixture(autouse=True)
def _mirror(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model of which only the mirror, a folder, has the file."""
    (tmp_path / "mirror").mkdir()
    (tmp_path / "mirror" / FILE).write_bytes(DATA)
    monkeypatch.setenv("CRISALAD_MIRROR", (tmp_path / "mirror").as_uri())
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CRISALAD_OFFLINE", raising=False)
    model = Published(
        name="tiny-model",
        format="huggingface",
        descriptor=64,
        parameters=88_640,
        images="56 x 56",
        licence=Licence("no licence file"),
        repository="https://github.com/nobody/tiny",
        file=FILE,
        url=None,
        paper="Nobody, 2026",
        note="in an archive",
    )
    monkeypatch.setitem(PUBLISHED, model.name, model)


def test_the_table_has_every_model_and_marks_those_in_the_cache(capfd, tmp_path):
    out, _ = runs(capfd, "models")
    rows = {row.split()[1]: row for row in out.splitlines() if row.startswith("│ ")}
    assert rows.keys() >= PUBLISHED.keys()
    for words in ("8,448", "228.6 M", "MIT", "gmberton/MegaLoc"):
        assert words in rows["megaloc"]
    assert "no licence file" in rows["tiny-model"]
    assert f"{len(PUBLISHED)} models; * in the cache, {tmp_path / 'cache'}" in out
    runs(capfd, "info", "--weights", "tiny-model")
    out, _ = runs(capfd, "models")
    assert " tiny-model * " in out
    assert out.count(" * ") == 2  # with the line that explains it


def test_one_model_is_told_with_all_that_is_known(capfd):
    out, _ = runs(capfd, "models", "tiny-model")
    facts = dict(line.split(maxsplit=1) for line in out.splitlines())
    known = {"parameters": "88,640", "images": "56 x 56", "file": FILE, "url": "not given"}
    known |= {"backbone": "-", "licence": "no licence file", "cached": "no"}
    assert facts.items() >= known.items()


def test_both_are_written_as_json(capfd, tmp_path):
    out, _ = runs(capfd, "models", "--json", "-")
    value = json.loads(out)
    assert value["cache"] == str(tmp_path / "cache")
    assert [each["name"] for each in value["models"]] == list(PUBLISHED)
    runs(capfd, "models", "megaloc", "--json", tmp_path / "m.json")
    facts = json.loads((tmp_path / "m.json").read_text())
    (megaloc,) = (each for each in value["models"] if each["name"] == "megaloc")
    assert facts.items() >= megaloc.items()
    assert (facts["licence"], facts["commercial"]) == ("MIT", True)


def test_the_model_in_the_package_is_told_of_in_the_same_words(capfd):
    out, _ = runs(capfd, "models", "starter")
    facts = dict(line.split(maxsplit=1) for line in out.splitlines())
    known = {"descriptor": "2,304", "parameters": "1,583,632", "licence": "Apache-2.0"}
    assert facts.items() >= known.items()  # docs/starter.md
    assert facts["images"].startswith("192 x 256")
    assert pathlib.Path(facts["file"]).is_file()


@pytest.mark.parametrize(("name", "nearest"), [("megalok", "megaloc"), ("startr", "starter")])
def test_an_unknown_name_is_one_line(capfd, name, nearest):
    for arguments in (["models", name], ["info", "--weights", name]):
        words = (f"crisalad: {name}: found no ", f"nearest: {nearest}")
        fails(capfd, *arguments, words=words)


def test_weights_by_name(capfd, tmp_path):
    out, notes = runs(capfd, "info", "--weights", "tiny-model")
    assert "88,640" in out
    assert notes.startswith("crisalad: note: tiny-model: no licence file: ")
    weights = tmp_path / "cache" / "models" / "tiny-model" / "tiny-model.safetensors"
    assert load_weights(weights)[1] == CONFIG
    write_picture(tmp_path / "images" / "a.png", 0)
    given = ("--weights", "tiny-model", "--images", tmp_path / "images", "--quiet")
    size = ("--image-size", "42", "42")
    runs(capfd, "extract", *given, *size, "--out", tmp_path / "d.npy")
    assert np.load(tmp_path / "d.npy").shape == (1, 64)
    runs(capfd, "index", *given, *size, "--out", tmp_path / "map")
    with Map.open(tmp_path / "map") as places:
        assert places.metadata.weights == str(weights)
    out, _ = runs(capfd, "query", tmp_path / "images", "--map", tmp_path / "map", *given[:2])
    assert "a.png" in out


@pytest.mark.slow  # draws the rest of the model
@pytest.mark.filterwarnings("ignore::crisalad_jax.utils.output.Note")
def test_a_run_starts_from_weights_or_a_backbone_by_name():
    expected, config = load_weights(cached_weights(PUBLISHED["tiny-model"]))
    whole = read_start(dataclasses.replace(RECIPE, model=config), weights="tiny-model", quiet=True)
    assert_equal(whole, expected)
    model = dataclasses.replace(RECIPE.model, backbone=config.backbone)
    start = read_start(dataclasses.replace(RECIPE, model=model), backbone="tiny-model", quiet=True)
    assert_equal(start.backbone, expected.backbone)
