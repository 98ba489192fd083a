"""`crisalad publish`, and weights at the hub for the verbs that take them."""

import json

from tests.cli.test_cli import fails, files_in, runs
from tests.experiments.test_publish import hub, made  # noqa: F401


def test_a_run_is_published_to_a_folder_that_weights_name(capfd, tmp_path, made):  # noqa: F811
    given = ("publish", made, "--to", tmp_path / "m", "--licence", "mit", "--json", "-")
    out, err = runs(capfd, *given)
    assert json.loads(out) == {"out": str(tmp_path / "m"), "licence": "mit"}
    assert f'cj.load("{tmp_path / "m"}") reads it' in err
    out, _ = runs(capfd, "info", "--weights", tmp_path / "m")
    assert "descriptor" in out
    fails(capfd, *given, words=("found a folder with files in it, expected a new or empty one",))


def test_weights_by_an_address_at_the_hub(capfd, tmp_path, made, hub):  # noqa: F811
    given = ("publish", made, "--to", "hf://me/mine", "--licence", "mit", "--quiet")
    out, _ = runs(capfd, *given)
    assert "/me/mine: model.safetensors, config.json, README.md" in out
    out, _ = runs(capfd, "info", "--weights", "hf://me/mine")
    assert "descriptor" in out
    words = ("hf://me/none/model.safetensors: found no such repository, or a private one",)
    fails(capfd, "info", "--weights", "hf://me/none", words=words)
    fails(capfd, *given, words=("expected a new or empty one",))


def test_bad_input_is_one_line(capfd, tmp_path, made):  # noqa: F811
    before = files_in(tmp_path)
    for given, words in (
        ((made, "--to", tmp_path / "to"), "licence"),
        ((made, "--licence", "mit"), "to"),
        ((tmp_path, "--to", tmp_path / "to", "--licence", "mit"), "expected a run with best"),
    ):
        fails(capfd, "publish", *given, words=(words,))
    assert files_in(tmp_path) == before
