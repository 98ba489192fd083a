"""`crisalad data`."""

import json

import numpy as np
import pytest

from crisalad_jax.data.sets import SETS
from crisalad_jax.utils.download import OFFLINE
from tests.cli.test_cli import fails, files_in, runs
from tests.conftest import write_picture
from tests.data.benchmarks.trees import write_utm
from tests.data.sets.test_fetch import pairs, server  # noqa: F401


def test_the_table_has_every_set(capfd):
    out, _ = runs(capfd, "data", "list")
    rows = {row.split()[1]: row for row in out.splitlines() if row.startswith("│ ")}
    assert rows.keys() == SETS.keys()
    assert "75,984 + 315" in rows["tokyo247"]
    assert "by hand" in rows["tokyo247"]
    assert "21.4 GB" in rows["nordland"]
    assert "CC-BY-NC-SA-4.0" in rows["nordland"]
    assert "not known" in rows["eynsham"]
    out, _ = runs(capfd, "data", "list", "--json", "-")
    assert [each["name"] for each in json.loads(out)["sets"]] == list(SETS)


def test_one_set_is_told_with_its_steps(capfd):
    out, _ = runs(capfd, "data", "list", "msls")
    assert "18,871 database images and 740 queries" in out
    assert "by hand:\n1. Log in at https://www.mapillary.com/dataset/places" in out
    assert "5. crisalad evaluate --data DIR --layout msls-subtask" in out
    out, _ = runs(capfd, "data", "list", "amstertime")
    assert "to get it: crisalad data fetch amstertime --to DIR" in out


def test_what_only_a_person_can_get_prints_the_steps_and_is_code_2(capfd, tmp_path):
    fails(
        *(capfd, "data", "fetch", "tokyo247", "--to", tmp_path / "tokyo"),
        words=("tokyo247: found a set that only a person can get (write to relja@relja.info)",),
    )
    from crisalad_jax.cli import main

    assert main(["data", "fetch", "tokyo247", "--to", str(tmp_path / "tokyo")]) == 2
    out = capfd.readouterr().out
    assert "1. Write to relja@relja.info" in out
    assert f"4. crisalad data check {tmp_path / 'tokyo'} --set tokyo247" in out
    assert files_in(tmp_path) == set()


@pytest.mark.usefixtures("pairs")
def test_a_set_is_fetched_and_checked(capfd, tmp_path):
    given = ("data", "fetch", "tiny", "--to", tmp_path / "to", "--quiet")
    out, err = runs(capfd, *given, "--json", tmp_path / "f.json")
    assert err == ""
    assert "tiny, test" in out
    assert "as published" in out
    value = json.loads((tmp_path / "f.json").read_text())
    assert value["problems"] == []
    assert [part["known"] for part in value["parts"]] == ["tiny, test"]
    fails(capfd, *given, words=("found a folder with files in it, expected a new or empty one",))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f.json", "to"]


def test_a_folder_that_does_not_match_is_code_2_and_its_json_is_written(capfd, tmp_path):
    folder = tmp_path / "svox" / "images" / "test"
    write_utm(folder, np.zeros((2, 2)), np.zeros((1, 2)))
    for path in folder.rglob("*.jpg"):
        path.unlink()
        write_picture(path, 0)
    given = ("data", "check", tmp_path / "svox", "--quiet", "--json", tmp_path / "c.json")
    words = ("found 2 database images and 1 queries, expected those of svox: test: 17,166",)
    fails(capfd, *given, words=words)
    value = json.loads((tmp_path / "c.json").read_text())
    assert value["parts"][0]["database"] == 2
    assert len(value["problems"]) == 1
    (tmp_path / "svox").rename(tmp_path / "mine")
    out, _ = runs(capfd, "data", "check", tmp_path / "mine", "--quiet")
    assert "nothing to compare" in out


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("fetch",), "data fetch: found no name, expected one after it"),
        (("check",), "data check: found no name, expected one after it"),
        (("fetch", "sped"), "--to: found none, expected a new folder for the set"),
        (("fetch", "spd", "--to", "x"), "spd: found no data set of this name"),
        (("list", "--to", "x"), "--to: found with data list, expected only one of the two"),
        (("fetch", "sped", "--set", "sped"), "--set: found with data fetch"),
        (("check", "nowhere"), "nowhere: found no such folder, expected one with"),
        (("check", ".", "--set", "pits"), "nearest: pitts30k"),
        (("lst",), "found 'lst', expected one of list, fetch, check"),
    ],
)
def test_bad_input_is_one_line(capfd, tmp_path, monkeypatch, given, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(OFFLINE, "1")
    fails(capfd, "data", *given, words=(words,))
    assert files_in(tmp_path) == set()
