"""Published models by name: downloaded once, checked ever after, with faults on the way."""

import concurrent.futures
import dataclasses
import hashlib
import io
import json
import os
import pathlib
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator

import jax
import numpy as np
import pytest
import safetensors.numpy
import torch

import crisalad_jax as cj
import crisalad_jax.utils.download
from crisalad_jax.checkpoints import cache
from crisalad_jax.checkpoints.cache import cached_weights, is_cached
from crisalad_jax.checkpoints.formats import VOCABULARY, public_shapes
from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.public import read_checkpoint, write_checkpoint
from crisalad_jax.checkpoints.published import (
    PUBLISHED,
    Licence,
    Published,
    published_model,
    restriction_of,
)
from crisalad_jax.checkpoints.safetensors_io import read_header
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.nn.aggregators.pair_vpr import PairVprConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.utils import output
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import CACHE, user_cache
from crisalad_jax.utils.output import Note
from tests.conftest import assert_equal
from tests.file_server import FileServer, file_server
from tests.random_checkpoints import bare_vit

pytestmark = pytest.mark.filterwarnings("ignore::crisalad_jax.utils.output.Note")

CONFIG = bare_vit(depth=1, position_grid=3)
ROOT = pathlib.Path(__file__).parents[2]
FILE = "tiny_model.safetensors"
MIT, GPL = (
    Licence("MIT", True),
    Licence("GPL-3.0", True, "copyleft, which what you publish may inherit"),
)
NO_LICENCE = Licence("no licence file")


def state_bytes(seed: int, config: ModelConfig = CONFIG) -> bytes:
    """A file as Hugging Face has it, which needs no torch."""
    generator = np.random.default_rng(seed)
    shapes = public_shapes(config, "huggingface")
    arrays = {
        name: generator.normal(0, 0.02, shape).astype(np.float32) for name, shape in shapes.items()
    }
    return safetensors.numpy.save(arrays, metadata={"format": "pt"})


def with_backbone(**fields: int) -> ModelConfig:
    return dataclasses.replace(CONFIG, backbone=dataclasses.replace(CONFIG.backbone, **fields))


DATA = state_bytes(0)


@pytest.fixture
def server() -> Iterator[FileServer]:
    with file_server() as server:
        server.files[f"/{FILE}"] = DATA
        yield server


@pytest.fixture
def model(server: FileServer, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> Published:
    """A published model on the server; the working directory is an empty folder."""
    for name in (cache.OFFLINE, cache.MIRROR, "http_proxy", "HTTP_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    # The stalls and pauses of the default would last for minutes.
    monkeypatch.setattr(crisalad_jax.utils.download, "_ATTEMPTS", 2)
    monkeypatch.setattr(crisalad_jax.utils.download, "_PAUSE", 0.01)
    tiny = Published(
        name="tiny-model",
        format="huggingface",
        descriptor=64,
        parameters=88_640,
        images="56 x 56",
        licence=MIT,
        repository="https://example.org/tiny",
        file=FILE,
        url=server.url(f"/{FILE}"),
        paper="Nobody, 2026",
    )
    monkeypatch.setitem(PUBLISHED, tiny.name, tiny)
    return tiny


def register(model: Published, monkeypatch: pytest.MonkeyPatch, **changes: object) -> Published:
    changed = dataclasses.replace(model, **changes)  # pyright: ignore
    monkeypatch.setitem(PUBLISHED, changed.name, changed)
    return changed


def contents(folder: pathlib.Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def fails(name: str, words: str) -> str:
    """One line that begins with the model's name."""
    with pytest.raises(InputError, match=words) as error:
        cj.load(name)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"{name}: ")
    return str(error.value)


def test_a_name_loads_what_its_file_holds_and_downloads_once(model, server, tmp_path):
    assert not is_cached(model)
    (tmp_path / FILE).write_bytes(DATA)
    expected = read_checkpoint(tmp_path / FILE)
    for _ in range(2):
        loaded = cj.load("tiny-model")
        assert loaded.config == expected.config == CONFIG
        assert_equal(loaded.params, expected.params)
    assert [path for path, _ in server.asked] == [f"/{FILE}"]
    assert is_cached(model)
    folder = tmp_path / "cache" / "models" / "tiny-model"
    assert contents(folder) == ["record.json", "tiny-model.safetensors", FILE]
    record = json.loads((folder / "record.json").read_text())
    assert record["sha256"] == hashlib.sha256(DATA).hexdigest()
    assert (record["url"], record["file"]) == (model.url, FILE)


@pytest.mark.parametrize(
    ("licence", "words"),
    [
        (MIT, "licence MIT"),
        (GPL, "licence GPL-3.0: copyleft, which what you publish may inherit"),
        (NO_LICENCE, "no licence file: its authors have not said who may use it"),
    ],
)
def test_the_licence_is_told_each_time(model, monkeypatch, licence, words):
    register(model, monkeypatch, licence=licence)
    note = re.escape(f"tiny-model: {words} (https://example.org/tiny)")
    for _ in range(2):
        with pytest.warns(Note, match=f"^{note}$") as caught:
            cj.load("tiny-model")
        # Python shows a warning once for each line of a program: the caller's, not one of ours.
        assert {pathlib.Path(each.filename).name for each in caught} == {"test_cache.py"}


def test_a_licence_that_forbids_commerce_is_said_once(model, monkeypatch, tmp_path):
    """By the name that is loaded, and in another process by its file or a copy of it."""
    monkeypatch.setattr(output, "_SAID", said := set())
    register(model, monkeypatch, licence=Licence("CC-BY-NC-4.0", False))
    words = "licence CC-BY-NC-4.0: no commercial use (https://example.org/tiny)"

    def notes(path) -> list[str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            cj.load(path)
        return [str(each.message) for each in caught if issubclass(each.category, Note)]

    assert notes("tiny-model") == [f"tiny-model: {words}"]
    assert notes("tiny-model") == []
    file, copy = find_weights("tiny-model"), tmp_path / "half.safetensors"
    cj.convert(file, copy, half=True)
    for path in (file, copy):
        assert notes(path) == []
        said.clear()
        assert notes(path) == [f"{path}: {words}"]


def test_a_format_forbids_commerce_where_all_its_models_do(monkeypatch, tmp_path):
    monkeypatch.setattr(output, "_SAID", set())
    assert published_model("pairvpr-vitb14").restriction == restriction_of("pair-vpr")
    assert restriction_of("pair-vpr") == (
        "licence CSIRO non-commercial: no commercial use "
        "(https://github.com/csiro-robotics/Pair-VPR)"
    )
    forbidding = {name for name, each in PUBLISHED.items() if each.restriction}
    assert forbidding == {"pairvpr-vitb14"}
    assert restriction_of("dinov2") == restriction_of("fol") == restriction_of("reference") == ""
    config = dataclasses.replace(
        CONFIG, aggregator=PairVprConfig(dim=16, width=64, layers=1, hidden=8, positions=16)
    )
    public, ours = tmp_path / "public.pth", tmp_path / "ours.safetensors"
    shapes = parameter_shapes(config)
    blank = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    write_checkpoint(public, blank, config, "pair-vpr", {})
    with pytest.warns(Note, match=re.escape(f"{public}: licence CSIRO non-commercial: no ")):
        cj.convert(public, ours)
    assert read_header(ours)["restriction"] == restriction_of("pair-vpr")


def test_a_file_of_the_same_name_is_taken(model, server, tmp_path):
    for name in ("tiny-model", "starter"):
        pathlib.Path(name).write_bytes(state_bytes(1))
        with pytest.warns(Note, match=f"{name}: found a file of this name here, and took that"):
            assert find_weights(name) == pathlib.Path(name)
    pathlib.Path("tiny-model").unlink()
    pathlib.Path("tiny-model").mkdir()  # no file of weights
    with pytest.warns(Note, match="licence MIT"):
        assert find_weights("tiny-model").parent.parent == tmp_path / "cache" / "models"
    assert find_weights("folder/none.safetensors") == pathlib.Path("folder/none.safetensors")


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path / "own"))
    assert user_cache() == tmp_path / "own"
    monkeypatch.delenv("CRISALAD_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert user_cache() == tmp_path / "xdg" / "crisalad-jax"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # which its specification ignores
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert user_cache() == tmp_path / "home" / ".cache" / "crisalad-jax"
    monkeypatch.setenv("CRISALAD_CACHE", "~/own")
    assert user_cache() == tmp_path / "home" / "own"


def test_faults_leave_no_model(model, server, tmp_path):
    server.statuses = [404]
    fails("tiny-model", "found HTTP 404 .*it may have moved: https://example.org/tiny")
    assert not (tmp_path / "cache").exists()
    server.length = len(DATA) + 1
    fails("tiny-model", r"tiny_model\.safetensors: found .*, expected the whole file")
    assert not is_cached(model)
    server.length = None
    assert cj.load("tiny-model").config == CONFIG


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (DATA[:-100], "not a whole safetensors file"),
        (b"\n<!DOCTYPE html><title>Quota exceeded</title>", "found a page of HTML, expected a"),
        (safetensors.numpy.save({"x": np.zeros(3, np.float32)}), "found no checkpoint that we"),
        (
            state_bytes(0, with_backbone(dim=128, heads=2)),
            r"found 128 dimensions and \d+ parameters \(huggingface\), expected 64 and",
        ),
    ],
    ids=["cut", "a page", "of no layout", "of another size"],
)
def test_a_file_that_is_not_the_model_is_not_kept(model, server, tmp_path, data, words):
    server.files[f"/{FILE}"] = data  # a server that says it is whole
    fails("tiny-model", words)
    assert not (tmp_path / "cache").exists()


def test_the_server_has_another_file_later(model, server, tmp_path):
    cj.load("tiny-model")
    folder = tmp_path / "cache" / "models" / "tiny-model"
    for name in (FILE, "tiny-model.safetensors"):
        (folder / name).unlink()
    server.files[f"/{FILE}"], server.etag = state_bytes(1), '"2"'
    fails("tiny-model", "found SHA-256 .*expected .*as at the first download: the file was changed")
    assert contents(folder) == ["record.json"]
    server.files[f"/{FILE}"] = DATA
    assert cj.load("tiny-model").config == CONFIG


def test_changed_bytes_in_the_cache_are_told(model, server, tmp_path):
    weights = cached_weights(model, quiet=True)
    whole = weights.read_bytes()
    weights.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(InputError, match=f"^{weights}: .*bytes than were.*remove it, and the same"):
        cj.load("tiny-model")
    weights.unlink()
    cj.load("tiny-model")  # made anew, of the published file that is there
    assert weights.read_bytes() == whole
    record = weights.with_name("record.json")
    record.write_text(record.read_text().replace(model.file, "others"))
    with pytest.raises(InputError, match=r"record\.json: found other bytes"):
        cj.load("tiny-model")
    assert len(server.asked) == 1


def test_what_can_be_made_again_is(model, server, monkeypatch):
    weights = cached_weights(model, quiet=True)
    published = weights.with_name(FILE)
    os.utime(published)  # as a copy of the folder may have it
    before = weights.stat().st_mtime_ns
    assert cached_weights(model).stat().st_mtime_ns == before
    monkeypatch.setattr(cache, "VERSION", "9.9")
    assert cached_weights(model).stat().st_mtime_ns > before
    assert json.loads(weights.with_name("record.json").read_text())["version"] == "9.9"
    weights.unlink()
    assert cached_weights(model).read_bytes()  # converted anew
    published.unlink()  # for its room
    assert cj.load("tiny-model").config == CONFIG
    assert len(server.asked) == 1


def test_offline_only_the_cache_is_used(model, server, monkeypatch, tmp_path):
    monkeypatch.setenv("CRISALAD_OFFLINE", "1")
    fails("tiny-model", "found none in the cache .*CRISALAD_OFFLINE forbids the network")
    assert not (tmp_path / "cache").exists()
    monkeypatch.setenv("CRISALAD_OFFLINE", "0")
    cj.load("tiny-model")
    monkeypatch.setenv("CRISALAD_OFFLINE", "1")
    cj.load("tiny-model")
    assert len(server.asked) == 1


@pytest.mark.parametrize("kind", ["http", "file"])
def test_a_mirror_is_asked_first(model, server, monkeypatch, tmp_path, kind):
    folder = tmp_path / "files"
    folder.mkdir()
    mirror = server.url("/mirror") if kind == "http" else folder.as_uri()
    monkeypatch.setenv("CRISALAD_MIRROR", f"{mirror}/")
    with pytest.warns(Note, match=f"{FILE}: found no such file; trying {model.url}"):
        cj.load("tiny-model")
    published = cached_weights(model).with_name(FILE)
    for path in published.parent.iterdir():
        path.unlink()
    server.files = {f"/mirror/{FILE}": DATA}
    (folder / FILE).write_bytes(DATA)
    server.asked.clear()
    cj.load("tiny-model")
    assert [path for path, _ in server.asked] == ([f"/mirror/{FILE}"] if kind == "http" else [])
    record = json.loads(published.with_name("record.json").read_text())
    assert record["url"] == f"{mirror}/{FILE}"


def test_a_mirror_that_is_no_address(model, server, monkeypatch):
    monkeypatch.setenv("CRISALAD_MIRROR", "/folder")
    with pytest.raises(InputError, match=r"CRISALAD_MIRROR: found '/folder', expected https://"):
        cached_weights(model)
    assert server.asked == []


def test_a_file_without_an_address_is_put_there_by_hand(model, monkeypatch, tmp_path):
    register(model, monkeypatch, url=None, note="one of a folder")
    path = tmp_path / "cache" / "models" / "tiny-model" / FILE
    error = fails("tiny-model", "found no separate address .*one of a folder")
    assert str(path) in error
    path.parent.mkdir(parents=True)
    path.write_bytes(DATA[:-1])
    fails("tiny-model", "not a whole safetensors file")
    assert path.exists()  # the user's
    path.write_bytes(DATA)
    assert cj.load("tiny-model").config == CONFIG


def test_a_vocabulary_brings_its_backbone(model, server, monkeypatch):
    # AnyLoc's block is the ninth from the end.
    deep = with_backbone(depth=9)
    count = sum(leaf.size for leaf in jax.tree.leaves(parameter_shapes(deep)))
    server.files["/deep.safetensors"] = state_bytes(0, deep)
    address = server.url("/deep.safetensors")
    backbone = register(
        model, monkeypatch, name="tiny-deep", parameters=count, file="deep", url=address
    )
    words = np.random.default_rng(1).normal(size=(3, 64)).astype(np.float32)
    data = io.BytesIO()
    torch.save(torch.tensor(words), data)
    server.files["/words.pt"] = data.getvalue()
    register(
        model,
        monkeypatch,
        name="tiny-words",
        format=VOCABULARY,
        descriptor=3 * 64,
        parameters=count + words.size,
        licence=NO_LICENCE,
        file="words.pt",
        url=server.url("/words.pt"),
        backbone="tiny-deep",
    )
    with pytest.warns(Note) as notes:
        params, config = cj.load("tiny-words")
    told = [str(note.message) for note in notes]
    assert told[0].startswith("tiny-words: no licence file")
    assert told[1].startswith("tiny-deep: licence MIT")
    assert is_cached(backbone)
    assert config.descriptor_dim == 3 * 64
    np.testing.assert_array_equal(params.aggregator.words, words)
    assert_equal(params.backbone, load_weights(cached_weights(backbone))[0].backbone)


def test_torch_is_asked_for_before_a_download(model, server, monkeypatch, tmp_path):
    register(model, monkeypatch, format="dinov2", file="tiny.pth")
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr(cache.importlib.util, "find_spec", lambda name: None)
    fails("tiny-model", r"found no torch to read tiny\.pth: pip install")
    assert server.asked == []
    assert not (tmp_path / "cache").exists()


def test_of_two_at_once_one_downloads(model, server):
    server.waits = 0.3
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda _: cached_weights(model, quiet=True), range(2)))
    assert len(server.asked) == 1
    assert found == [cached_weights(model)] * 2


PROGRAM = """
import dataclasses, sys
from crisalad_jax.checkpoints.cache import cached_weights
from crisalad_jax.checkpoints.published import PUBLISHED
model = PUBLISHED["megaloc"]
print("ready", flush=True)
cached_weights(dataclasses.replace(model, url=sys.argv[1], file=sys.argv[2]), quiet=True)
"""


@pytest.mark.slow
def test_a_killed_download_is_gone_on_with_by_the_next_process(
    model, server, monkeypatch, tmp_path
):
    server.stalls = 1
    program = [sys.executable, "-c", PROGRAM, model.url, FILE]
    folder = tmp_path / "cache" / "models" / "megaloc"
    with subprocess.Popen(program, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        part = folder / f"{FILE}.part"
        for _ in range(500):
            if part.exists() and part.stat().st_size == 10:
                break
            time.sleep(0.02)
        process.kill()
    assert not (folder / FILE).exists()
    again = dataclasses.replace(model, name="megaloc")
    assert cached_weights(again, quiet=True).is_file()
    assert [wanted for _, wanted in server.asked] == [None, "bytes=10-"]
    assert (folder / FILE).read_bytes() == DATA
