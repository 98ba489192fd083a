"""The notebooks of the documentation: executed, portable, and they run."""

import pathlib
import re

import nbclient
import nbformat
import pytest

from crisalad_jax.experiments.demo import DemoConfig, run_demo
from crisalad_jax.synthetic import SyntheticCityConfig, write_synthetic_city

FOLDER = pathlib.Path(__file__).parents[1] / "docs" / "notebooks"
BOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 600_000
"""Bytes of a notebook: pages should open at once."""


@pytest.mark.parametrize("path", BOOKS, ids=lambda path: path.stem)
def test_a_notebook_holds_what_it_printed(path):
    book = nbformat.read(path, as_version=4)
    nbformat.validate(book)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    # A warning would be an output to stderr, and every output is a kind that pages show.
    assert {output.get("name", output.output_type) for output in outputs} <= {
        "stdout",
        "execute_result",
    }
    kinds = [set(output.get("data", ())) for output in outputs]
    assert sum(bool(kind & {"image/jpeg", "image/png"}) for kind in kinds) >= 2
    assert path.stat().st_size < LARGEST
    # Names of folders of the machine that it was executed on.
    text = re.sub(r'"image/\w+": "[^"]*"', "", path.read_text(encoding="utf-8"))
    assert not re.search(r"(?<![\w.\]])/(?:home|root|tmp|usr|opt|work|Users|var|mnt)\b", text)


@pytest.mark.parametrize("path", BOOKS, ids=lambda path: path.stem)
def test_links_lead_to_pages(path):
    # mkdocs checks and rewrites the links of Markdown pages alone: these are the site's own.
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8"))
    page = FOLDER / path.stem  # a page is the index of a folder
    assert links
    for link in links:
        target = (page / link).resolve()
        assert link.endswith("/"), link
        assert target.with_suffix(".md").is_file() or target.with_suffix(".ipynb").is_file(), link


def test_there_are_four():
    assert [path.stem for path in BOOKS] == ["first", "inside", "training", "transport"]


def _run(path, folder):
    book = nbformat.read(path, as_version=4)
    where = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(book, timeout=600, resources=where).execute()


def test_the_first_notebook_runs(tmp_path):
    city = SyntheticCityConfig(train_places=2, test_places=80)
    write_synthetic_city(tmp_path / "demo" / "city", city, quiet=True)
    _run(FOLDER / "first.ipynb", tmp_path)


@pytest.mark.slow
def test_the_others_run(tmp_path):
    run_demo(DemoConfig(train_places=48, test_places=24, epochs=1), tmp_path / "demo", quiet=True)
    for path in BOOKS:
        if path.stem != "first":
            _run(path, tmp_path)
