"""Commands without --weights: the model in the package, and one line that says so."""

import json
import shutil

import numpy as np
import pytest

from crisalad_jax.checkpoints.load import load
from crisalad_jax.data.images import list_images, read_image
from crisalad_jax.data.reading import Reading
from crisalad_jax.nn.model import describe
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.retrieval.maps.build import index
from tests.cli.test_cli import Capture, fails, runs

NOTE = "crisalad: note: no --weights: taking starter"


def said(capfd: Capture, *arguments: object) -> tuple[str, list[str]]:
    """Run; the words on stdout, and the notes."""
    out, err = runs(capfd, *arguments)
    notes = [line for line in err.splitlines() if line.startswith("crisalad: note")]
    return " ".join(out.split()), notes


def test_extract_takes_it(shared, tmp_path, capfd):
    given = ("extract", "--images", shared / "town", "--quiet")
    _, (note,) = said(capfd, *given, "--out", tmp_path / "default.npy")
    assert note.startswith(NOTE)
    assert json.loads((tmp_path / "default.npy.json").read_text())["weights"] == "starter"
    assert note.endswith("for the best recall: --weights megaloc")
    _, notes = said(capfd, *given, "--out", tmp_path / "named.npy", "--weights", "starter")
    assert notes == []
    params, config = load("starter")
    paths = list_images(shared / "town")
    images = np.stack([prepare_image(read_image(path), config) for path in paths])
    default, named = (np.load(tmp_path / f"{name}.npy") for name in ("default", "named"))
    # Batches of another size add up in another order; descriptors are unit vectors.
    np.testing.assert_allclose(default, describe(params, images, config), rtol=0, atol=2e-6)
    np.testing.assert_array_equal(named, default)


@pytest.mark.usefixtures("symbolic_shapes")
@pytest.mark.parametrize("runtime", ["jax", pytest.param("onnxruntime", marks=pytest.mark.slow)])
def test_a_map_is_made_asked_and_grown_without_weights(runtime, shared, tmp_path, capfd):
    images, out = shared / "town" / "images" / "test" / "database", tmp_path / "map"
    flags = ("--out", out, "--runtime", runtime, "--quiet")
    _, notes = said(capfd, "index", "--images", images, *flags)
    assert notes[0].startswith(NOTE)
    photograph = list_images(images)[1]
    asked = ("query", photograph, "--map", out, "--runtime", runtime, "--quiet", "--json", "-")
    answers, notes = said(capfd, *asked)
    first = json.loads(answers)["neighbours"][0]
    assert (first["name"], notes) == (photograph.name, [])
    assert first["similarity"] == pytest.approx(1, abs=1e-5)  # six digits are printed
    shutil.copytree(images, tmp_path / "more")
    shutil.copy(photograph, tmp_path / "more" / "new.jpg")
    words, notes = said(capfd, "index", "--images", tmp_path / "more", *flags)
    assert "1 image added" in words
    assert notes == []


def test_a_map_grows_by_its_own_model(shared, tmp_path, capfd):
    images, out = shared / "town" / "images" / "test", tmp_path / "map"
    flags = ("--out", out, "--quiet")
    weights = ("--weights", shared / "weights.safetensors")
    said(capfd, "index", "--images", images / "database", *weights, *flags)
    words, notes = said(capfd, "index", "--images", images / "queries", *flags)
    count = len(list_images(images / "queries"))
    assert f"{count} images added" in words
    assert notes == []


@pytest.fixture(scope="module")
def starters(shared, tmp_path_factory):
    """A map of the town's database, by the model in the package."""
    out = tmp_path_factory.mktemp("starter") / "map"
    database = shared / "town" / "images" / "test" / "database"
    index(load("starter"), database, out, weights="starter", reading=Reading(quiet=True))
    return out


@pytest.fixture
def own_map(starters, tmp_path):
    return shutil.copytree(starters, tmp_path / "map")


def test_a_map_of_another_versions_model_says_so(shared, own_map, capfd):
    value = json.loads((own_map / "map.json").read_text())
    value["model"] = "0" * 64
    del value["checksum"]  # as who edits the file
    (own_map / "map.json").write_text(json.dumps(value))
    words = ("starter of another version of this package", "`crisalad index` into a new folder")
    fails(capfd, "query", list_images(shared / "town")[0], "--map", own_map, words=words)


def test_a_map_asked_with_another_model_blames_no_version(shared, starters, capfd, weights):
    given = ("--map", starters, "--weights", weights)
    line = fails(capfd, "query", list_images(shared / "town")[0], *given, words=("(starter), but",))
    assert "version" not in line


def test_damaged_weights_are_found_unless_told_not_to_look(tmp_path, capfd, database, weights):
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1  # the last bit of a number
    (tmp_path / "damaged.safetensors").write_bytes(data)
    given = ("index", "--images", database, "--weights", tmp_path / "damaged.safetensors")
    fails(capfd, *given, "--out", tmp_path / "a", "--quiet", words=("damaged.safetensors",))
    words, _ = said(capfd, *given, "--out", tmp_path / "b", "--quiet", "--no-checksums")
    assert "7 images added" in words


def test_evaluate_takes_it_and_a_preset_is_still_untrained(shared, tmp_path, capfd):
    given = ("evaluate", "--data", shared / "town", "--quiet")
    words, (note,) = said(capfd, *given, "--json", tmp_path / "said.json")
    assert note.startswith(NOTE)
    assert json.loads((tmp_path / "said.json").read_text())["weights"] == "starter"
    words, notes = said(capfd, *given, "--preset", "tiny", "--grouping", "single")
    assert "untrained tiny, seed 0" in words
    assert notes == []
