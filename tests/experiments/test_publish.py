"""A run as a folder for the hub: its card, its weights, and back by `load`."""

import json
import os
import pathlib
import re
import shutil
from collections.abc import Iterator

import huggingface_hub
import huggingface_hub.constants
import numpy as np
import pytest
import scipy.stats

import crisalad_jax as cj
from crisalad_jax.checkpoints.load import open_model
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.data.places import read_places
from crisalad_jax.experiments.publish import publish
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.run_files import write_data
from crisalad_jax.utils.download import OFFLINE
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.output import Note
from tests.conftest import RECIPE, assert_equal, write_picture
from tests.hub_server import Hub, hub_server

VALIDATIONS = [
    {"step": 3, "epoch": 1, "R@1": 0.2, "R@5": 0.4},
    {"step": 6, "epoch": 2, "R@1": 0.6, "R@5": 0.8},
    {"step": 9, "epoch": 3, "R@1": 0.4, "R@5": 0.6},
]


@pytest.fixture
def made(shared, benchmark, tmp_path) -> pathlib.Path:
    """The files of a finished run, without the training."""
    out = tmp_path / "runs" / "mine"
    out.mkdir(parents=True)
    write_json(out / "config.json", to_plain(RECIPE))
    for name in ("best.safetensors", "last.safetensors"):
        shutil.copyfile(shared / "weights.safetensors", out / name)
    steps = [{"step": step, "loss": 0.5} for step in range(1, 10)]
    lines = sorted([*steps, *VALIDATIONS], key=lambda each: each["step"])
    (out / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    write_data(out, "city", read_places(shared / "city", min_images=2), benchmark)
    return out


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Iterator[Hub]:
    monkeypatch.delenv(OFFLINE, raising=False)
    monkeypatch.setenv("HF_TOKEN", "hf_thisisasecretofthetests")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    with hub_server(monkeypatch) as hub:
        yield hub


def example_of(card: str) -> str:
    (example,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    return example


def test_the_folder_is_what_the_hub_s_users_expect(made, params, tmp_path):
    to = tmp_path / "model"
    assert publish(made, to, licence="apache-2.0") == str(to)
    assert sorted(os.listdir(to)) == ["README.md", "config.json", "model.safetensors"]
    model = cj.load(to)
    assert_equal(model.params, params)
    assert model.config == RECIPE.model
    about = json.loads((to / "config.json").read_text())
    assert from_plain(ModelConfig, about["model"], source="") == RECIPE.model
    assert from_plain(TrainConfig, about["training"], source="") == RECIPE
    card = huggingface_hub.ModelCard.load(to / "README.md")  # as the hub reads it
    assert card.data.license == "apache-2.0"
    assert card.data.library_name == "crisalad-jax"
    assert card.data.pipeline_tag == "image-feature-extraction"
    assert "visual-place-recognition" in (card.data.tags or [])
    results = card.data.eval_results or []
    assert {(each.metric_type, each.metric_value) for each in results} == {
        ("recall_at_1", 60.0),
        ("recall_at_5", 80.0),
    }
    assert all(each.dataset_name == "town/test (@UTM, 25 m)" for each in results)


def test_the_card_tells_data_recipe_and_recalls_with_their_intervals(made, tmp_path):
    publish(made, tmp_path / "model", licence="cc-by-nc-4.0")
    card = (tmp_path / "model" / "README.md").read_text()
    assert "- Data: city (8 places, 24 images); validated on town/test (@UTM, 25" in card
    assert "The weights: cc-by-nc-4.0." in card
    assert f"- Batches: {RECIPE.places_per_batch} places of {RECIPE.images_per_place} imag" in card
    (row,) = (line for line in card.splitlines() if line.startswith("| town/test"))
    assert "validation at step 6, single" in row
    for recall, share in ((60.0, 0.6), (80.0, 0.8)):
        # Of five independent queries the number of hits in a resample is binomial.
        ends = [100 * scipy.stats.binom.ppf(q, 5, share) / 5 for q in (0.025, 0.975)]
        assert f"| {recall} [{ends[0]:.1f}-{ends[1]:.1f}] |" in row
    publish(made, tmp_path / "other", licence="mit", data="Streets of my own")
    assert "- Data: Streets of my own." in (tmp_path / "other" / "README.md").read_text()


def test_the_card_s_example_runs_beside_the_folder_without_the_network(
    made, tmp_path, monkeypatch, capsys
):
    publish(made, tmp_path / "model", licence="mit")
    for number in range(3):
        write_picture(tmp_path / "photos" / f"{number}.png", number)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(OFFLINE, "1")
    exec(example_of((tmp_path / "model" / "README.md").read_text()), {})
    printed = capsys.readouterr().out
    rows = np.array(re.findall(r"\d+", printed), int).reshape(3, 2)
    assert rows[:, 0].tolist() == [0, 1, 2]  # the most like an image is itself


def test_recalls_of_evaluations_are_rows_and_another_model_s_are_noted(made, tmp_path):
    row = {"grouping": "single", "rerank": None, "recalls": {"R@1": 0.5}, "intervals": {}}
    row["intervals"] = {"R@1": [0.25, 0.75]}
    values = {"benchmark": "Nordland*", "weights": str(made / "best.safetensors")}
    write_json(tmp_path / "a.json", values | {"results": [row, row | {"rerank": "selavpr:20"}]})
    publish(made, tmp_path / "a", licence="mit", evaluations=[tmp_path / "a.json"])
    card = (tmp_path / "a" / "README.md").read_text()
    assert "| Nordland* | single | 50.0 [25.0-75.0] | - |" in card
    assert "| Nordland* | single + selavpr:20 | 50.0 [25.0-75.0] | - |" in card
    write_json(tmp_path / "b.json", values | {"weights": "salad", "results": [row]})
    with pytest.warns(Note, match="found an evaluation of salad"):
        publish(made, tmp_path / "b", licence="mit", evaluations=[tmp_path / "b.json"])


def test_a_run_that_says_little_has_a_card_that_says_so(made, tmp_path):
    for name in ("metrics.jsonl", "data.json", "best.safetensors"):
        (made / name).unlink()
    publish(made, tmp_path / "model", licence="mit")
    card = (tmp_path / "model" / "README.md").read_text()
    assert "- Data: the run has no record of it." in card
    assert "The run has no validation, and no evaluation was given." in card
    assert "model-index" not in card


def test_a_model_goes_to_the_hub_and_comes_back_and_stays_without_the_network(
    made, params, hub, tmp_path, monkeypatch
):
    assert publish(made, "hf://me/mine", licence="mit", quiet=True).endswith("/me/mine")
    there = set(hub.repositories["me/mine"])
    assert there == {"README.md", "config.json", "model.safetensors"}
    assert hub.messages == ["Publish mine"]
    (card,) = hub.cards  # which the client sent to be checked as YAML
    assert 'cj.load("hf://me/mine")' in example_of(card)
    for address in ("hf://me/mine", "hf://me/mine@main", "hf://me/mine/model.safetensors"):
        assert_equal(cj.load(address, quiet=True).params, params)
    monkeypatch.setenv(OFFLINE, "1")
    hub.asked.clear()
    assert cj.load("hf://me/mine").config == RECIPE.model
    opened = open_model("hf://me/mine", "jax", lambda config: config)
    assert opened.name == "hf://me/mine"  # not that of a folder in the cache
    assert hub.asked == []
    monkeypatch.delenv(OFFLINE)
    with pytest.raises(InputError, match="expected a new or empty one"):
        publish(made, "hf://me/mine", licence="mit", quiet=True)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"licence": "Apache 2.0"}, "licence: found 'Apache 2.0', expected the hub's name for one"),
        ({"to": "hf://me"}, "hf://me: found no address at the hub"),
        ({"to": "hf://me/mine/x.safetensors"}, "found a file, expected a repository"),
        ({"to": "full"}, "full: found a folder with files in it, expected a new or empty one"),
        ({"run": "full"}, "full: found notes.txt, expected a run with best.safetensors or last"),
        ({"run": "none"}, "none: found no such folder, expected a run with best.safetensors"),
        ({"evaluations": ["full/notes.txt"]}, "full/notes.txt: found no JSON"),
        ({"evaluations": ["other.json"]}, "other.json: found no 'benchmark', expected what"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(made, tmp_path, monkeypatch, changes, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    (tmp_path / "other.json").write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    given = {"run": made, "to": "to", "licence": "mit"} | changes
    with pytest.raises(InputError, match=re.escape(words)) as error:
        publish(given.pop("run"), given.pop("to"), **given)
    assert "\n" not in str(error.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_weights_that_are_damaged_are_not_published(made, tmp_path):
    data = bytearray((made / "best.safetensors").read_bytes())
    data[-1] ^= 1
    (made / "best.safetensors").write_bytes(bytes(data))
    with pytest.raises(InputError, match="found other bytes than were written"):
        publish(made, tmp_path / "to", licence="mit")
    assert not (tmp_path / "to").exists()
