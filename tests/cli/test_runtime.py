"""`--runtime` of the commands: the answers of JAX, and for every bad input one line."""

import importlib.util
import json
import pathlib
import shutil
import subprocess
import sys
import unittest.mock
import warnings
from collections.abc import Sequence

import jax
import numpy as np
import pytest

from crisalad_jax.checkpoints import runtime as runtimes
from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.engines import EngineName, NotExportableError
from crisalad_jax.checkpoints.export import ExportConfig, write_export
from crisalad_jax.checkpoints.load import HUB_FILE, find_weights
from crisalad_jax.checkpoints.runtime import fastest_engine, open_runtime
from crisalad_jax.checkpoints.weights import model_hash, save_weights
from crisalad_jax.cli import main
from crisalad_jax.config.io import to_plain
from crisalad_jax.data.images import read_image
from crisalad_jax.nn.model import Crisalad, Model, init_crisalad
from crisalad_jax.retrieval.describe import prepare_image
from crisalad_jax.retrieval.maps.map import Map
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.locks import lock
from tests.cli.test_cli import Capture, fails, runs
from tests.conftest import MODEL

pytestmark = pytest.mark.usefixtures("symbolic_shapes")

ENGINES: Sequence[EngineName] = ("onnxruntime", "openvino")
SLOW = pytest.mark.slow
# As of exports: the same operations, rounded in another order.
TOLERANCE = 2e-6


def town(shared: pathlib.Path) -> pathlib.Path:
    return shared / "town" / "images" / "test"


def succeeds(capfd: Capture, *arguments: object) -> str:
    """Run; the words on stdout. The first run of an engine tells that it exports the weights."""
    return " ".join(runs(capfd, *arguments)[0].split())


@pytest.mark.parametrize(
    ("engine", "grouping", "source"),
    [
        ("onnxruntime", "sequential", "weights"),
        pytest.param("openvino", "window", "weights", marks=SLOW),
        ("openvino", "single", "exported"),
    ],
)
def test_extract_gives_the_descriptors_of_jax(
    engine, grouping, source, shared, exported, weights, tmp_path, capfd
):
    flags = ("--images", shared / "town", "--grouping", grouping, "--batch-size", "4", "--quiet")
    model = {"weights": weights, "exported": exported}[source]
    found = []
    for runtime, file in (("jax", weights), (engine, model)):
        out = tmp_path / f"{runtime}.npy"
        given = ("extract", "--weights", file, "--runtime", runtime, "--out", out)
        succeeds(capfd, *given, *flags)
        found.append(np.load(out))
    np.testing.assert_allclose(*found, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("engine", ["onnxruntime", pytest.param("openvino", marks=SLOW)])
def test_evaluate_recalls_as_jax_does(engine, shared, tmp_path, capfd, weights):
    command = (
        *("evaluate", "--data", shared / "town", "--weights", weights),
        *("--batch-size", "4", "--seeds", "1", "--quiet"),
    )

    def recalls(runtime):
        file = tmp_path / f"{runtime}.json"
        succeeds(capfd, *command, "--runtime", runtime, "--json", file)
        # Not its similarities, which differ by rounding.
        results = json.loads(file.read_text())["results"]
        return [(each["grouping"], each["recalls"], each["by_seed"]) for each in results]

    assert len(recalls(engine)) == 4
    assert recalls(engine) == recalls("jax")


def test_a_map_of_one_runtime_answers_another(shared, tmp_path, capfd, weights):
    images, queries = town(shared) / "database", town(shared) / "queries"
    index = ("index", "--weights", weights, "--images", images, "--out", tmp_path / "map")
    succeeds(capfd, *index, "--runtime", "openvino", "--quiet")
    assert "7 were there already" in succeeds(capfd, *index, "--runtime", "onnxruntime", "--quiet")
    answers = []
    for runtime in ("jax", *ENGINES):
        said = tmp_path / f"{runtime}.jsonl"
        asked = ("query", queries, "--map", tmp_path / "map", "--k", "3", "--quiet")
        succeeds(capfd, *asked, "--runtime", runtime, "--json", said)
        lines = map(json.loads, said.read_text().splitlines())
        answers.append([[each["name"] for each in line["neighbours"]] for line in lines])
    assert answers[0] == answers[1] == answers[2] != []


@pytest.mark.usefixtures("engines_by_default")
def test_a_query_takes_the_fastest_engine_that_is_installed(
    shared, town_map, tmp_path, capfd, monkeypatch
):
    asked = ("query", town(shared) / "queries", "--map", town_map, "--k", "3", "--quiet")

    def answers(*flags):
        out = tmp_path / "answers.jsonl"
        said = succeeds(capfd, *asked, "--json", out, *flags)
        lines = map(json.loads, out.read_text().splitlines())
        found = [[each["similarity"] for each in line["neighbours"]] for line in lines]
        return said.split("; by ")[1].split(";")[0], found

    by, found = answers()
    assert by == "onnxruntime"
    expected = answers("--runtime", "jax")[1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE)
    real, absent = importlib.util.find_spec, ["onnxruntime"]
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name in absent else real(name)
    )
    with Map.open(town_map) as places:
        assert places.fastest_engine() == "openvino"
    absent.append("openvino")
    assert answers() == ("jax", expected)


@pytest.mark.usefixtures("engines_by_default")
def test_where_jax_describes_although_engines_are_there(weights, tmp_path, monkeypatch):
    plain = to_plain(MODEL)
    assert fastest_engine(weights, plain) == "onnxruntime"
    assert fastest_engine(weights, plain | {"compute_dtype": "bfloat16"}) == "jax"
    native = to_plain(MODEL.resized(None, ["native"]))
    assert fastest_engine(weights, native) == "jax"
    monkeypatch.setattr(
        runtimes.importlib.metadata, "entry_points", lambda group: ["cuda"] if group else []
    )
    assert fastest_engine(weights, plain) == "jax"
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert fastest_engine(weights, plain) == "onnxruntime"
    # Without a home there is no cache for an export, and before onnx is installed none can be made.
    monkeypatch.delenv("CRISALAD_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(pathlib.Path, "home", unittest.mock.Mock(side_effect=RuntimeError))
    assert fastest_engine(weights, plain) == "jax"
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path / "new"))
    monkeypatch.setitem(sys.modules, "onnx", None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no note of an export
        assert fastest_engine(weights, plain) == "jax"


@pytest.mark.usefixtures("engines_by_default")
def test_another_process_that_exports_is_not_waited_for(weights, tmp_path, monkeypatch):
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path))
    with lock(tmp_path / "exports"):
        assert fastest_engine(weights, to_plain(MODEL)) == "jax"


@pytest.mark.usefixtures("engines_by_default")
def test_a_model_that_no_engine_computes_is_tried_once(weights, tmp_path, monkeypatch):
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path))
    tried, failure = [], NotExportableError

    def refuse(*given: object) -> None:
        tried.append(given)
        raise failure("its descriptors differ")

    monkeypatch.setattr(runtimes, "_export", refuse)
    for _ in range(2):
        assert fastest_engine(weights, to_plain(MODEL)) == "jax"
    assert len(tried) == len(ENGINES)
    with pytest.raises(InputError, match="its descriptors differ"):
        open_runtime(weights, "onnxruntime")
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path / "again"))
    tried.clear()
    failure = InputError  # as of a full disk, which may pass
    for _ in range(2):
        assert fastest_engine(weights, to_plain(MODEL)) == "jax"
    assert len(tried) == 2 * len(ENGINES)


def test_an_exported_folder_takes_an_engine_that_reads_it(exported, tmp_path, monkeypatch):
    plain = to_plain(MODEL)
    assert fastest_engine(exported, plain) == "onnxruntime"
    assert fastest_engine(exported, plain | {"compute_dtype": "bfloat16"}) == "openvino"
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"format onnx, .* expected onnxruntime or openvino"):
        fastest_engine(exported, plain)


def test_what_is_no_exported_folder_is_what_its_name_means(tmp_path, monkeypatch, weights):
    """A folder of `crisalad publish`, and one that happens to have a published model's name."""
    published = tmp_path / "published"
    published.mkdir()
    shutil.copy(weights, published / HUB_FILE)
    assert find_weights(published, engine="auto") == published / HUB_FILE
    monkeypatch.chdir(tmp_path)
    (tmp_path / "starter").mkdir()
    assert find_weights("starter", engine="auto") == starter.FILES["starter"]


def test_a_damaged_export_says_what_to_remove(weights, tmp_path, monkeypatch):
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path))
    folder = open_runtime(weights, "onnxruntime").folder
    file = folder / "describe.onnx.data"
    data = file.read_bytes()
    file.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(InputError, match=f"remove {folder}, and the same command makes it again"):
        open_runtime(weights, "onnxruntime")


def printed_by(program: str) -> str:
    """What a program prints in a process of its own, whose imports are its alone."""
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_a_kept_export_describes_without_jax(shared, tmp_path, capfd, weights):
    out = tmp_path / "d.npy"
    extract = ("extract", "--weights", weights, "--images", town(shared) / "queries")
    succeeds(capfd, *extract, "--runtime", "onnxruntime", "--out", out, "--quiet")
    program = (
        "import sys, numpy as np\n"
        "from crisalad_jax.checkpoints.runtime import open_runtime\n"
        f"model = open_runtime({str(weights)!r}, 'onnxruntime')\n"
        "assert model.describe(np.zeros((1, 42, 56, 3), np.uint8)).shape == (1, 48)\n"
        "print('jax' in sys.modules)\n"
    )
    assert printed_by(program) == "False\n"


@pytest.fixture
def exported(params: Crisalad, tmp_path: pathlib.Path) -> pathlib.Path:
    write_export(tmp_path / "onnx", Model(params, MODEL), ExportConfig(format="onnx"))
    return tmp_path / "onnx"


@pytest.mark.parametrize("told", [True, pytest.param(False, marks=SLOW)])
def test_a_query_by_an_exported_folder_starts_without_jax(exported, shared, tmp_path, capfd, told):
    places, asked = tmp_path / "map", town(shared) / "queries"
    by = ("--weights", exported, "--runtime", "onnxruntime")
    succeeds(capfd, "index", "--images", asked, "--out", places, *by, "--quiet")
    query = ("query", asked, "--map", places, *by[0 if told else 2 :], "--quiet")
    program = (
        "import sys\n"
        "from crisalad_jax.cli import main\n"
        f"assert main({list(map(str, query))!r}) == 0\n"
        # jaxtyping is slow to import.
        "slow = {'jax', 'jaxtyping'}\n"
        "print(slow & sys.modules.keys())\n"
    )
    assert printed_by(program).endswith("\nset()\n")


def test_bad_input_is_one_line(exported, shared, tmp_path, capfd, monkeypatch):
    flags = ("--images", town(shared) / "queries", "--out", tmp_path / "d.npy", "--quiet")
    extract = ("extract", "--weights", exported, *flags, "--runtime", "onnxruntime")
    words = ("grouping single, expected any", "sequential")
    fails(capfd, *extract, "--grouping", "sequential", words=words)
    fails(capfd, *extract, "--image-size", "56", "42", words=("42 x 56", "expected 56 x 42"))
    fails(capfd, *extract, "--compute-dtype", "bfloat16", words=("bfloat16 with onnxruntime",))
    fails(capfd, *extract[:-2], words=(exported,))  # JAX takes no folder
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    fails(capfd, *extract, words=("no module onnxruntime", "pip install 'crisalad-jax[onnx]'"))
    data = (exported / "describe.onnx.data").read_bytes()
    (exported / "describe.onnx.data").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    words = ("describe.onnx.data: found other bytes than were written",)
    fails(capfd, *extract[:-1], "openvino", words=words)
    assert not (tmp_path / "d.npy").exists()


def test_a_program_outside_of_its_folder_is_not_opened(exported, tmp_path):
    folder = tmp_path / "program"
    shutil.copytree(exported, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["program"]["file"] = "../" + manifest["program"]["file"]
    del manifest["checksum"]
    write_json(folder / "manifest.json", manifest)
    with pytest.raises(InputError, match=f"^{folder}: found file '../describe.onnx', expected a"):
        open_runtime(folder, "onnxruntime")


def test_an_encoder_of_a_plugin_that_does_not_attend_fits_all_groupings(exported, tmp_path):
    """The plug-in itself is not there: the folder says it."""
    folder = tmp_path / "program"
    shutil.copytree(exported, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    with pytest.raises(InputError, match="grouping single, expected any"):
        open_runtime(folder, "onnxruntime").check_groupings(["sequential"])
    assert manifest["attends_across_images"] is True
    manifest["model"]["cross_image"] = {"name": "scaled"}
    del manifest["checksum"]
    write_json(folder / "manifest.json", manifest | {"attends_across_images": False})
    open_runtime(folder, "onnxruntime").check_groupings(["sequential"])


def test_a_program_of_other_weights_is_not_a_maps(exported, shared, tmp_path, capfd):
    other = tmp_path / "other.safetensors"
    save_weights(other, Model(init_crisalad(jax.random.key(0), MODEL), MODEL))
    images, places = town(shared) / "queries", tmp_path / "map"
    succeeds(capfd, "index", "--images", images, "--out", places, "--weights", other, "--quiet")
    query = ("query", images, "--map", places, "--weights", exported, "--quiet")
    fails(capfd, *query, "--runtime", "onnxruntime", words=(exported, "map"))


def test_an_int8_program_is_a_model_of_its_own(params, shared, tmp_path, capfd, weights):
    """It may ask a map of the weights that it was made of; nothing else may ask its maps."""
    photographs = town(shared) / "queries"
    calibration = np.stack(
        [prepare_image(read_image(path), MODEL) for path in sorted(photographs.iterdir())]
    )
    eight = tmp_path / "int8"
    manifest = write_export(
        eight, Model(params, MODEL), ExportConfig(format="onnx"), calibration=calibration
    )
    assert manifest["quantised_from"] == model_hash(params, MODEL) != manifest["model_sha256"]
    of_floats, of_bytes = tmp_path / "floats.map", tmp_path / "bytes.map"
    engine = ("--runtime", "onnxruntime")
    index = ("index", "--images", photographs, "--quiet")
    succeeds(capfd, *index, "--weights", weights, "--out", of_floats)
    succeeds(capfd, *index, "--weights", eight, "--out", of_bytes, *engine)
    query = ("query", photographs, "--quiet")
    _, notes = runs(capfd, *query, "--map", of_floats, "--weights", eight, *engine)
    assert f"{eight}: an int8 program of the model that made {of_floats}" in notes
    appends = ("serve", "--map", of_floats, "--weights", eight, *engine, "--append", "--port", "0")
    assert main([str(each) for each in appends]) == 2
    refused = (
        f"{eight}: found model {manifest['model_sha256']}, expected {model_hash(params, MODEL)}"
    )
    assert f"crisalad: {refused} with append" in capfd.readouterr().err
    fails(capfd, *query, "--map", of_bytes, "--weights", weights, words=(of_bytes, "made by model"))
    _, notes = runs(capfd, *query, "--map", of_bytes, "--weights", eight, *engine)
    assert "int8" not in notes
