"""The documentation: it builds, nothing public is left out, and what it shows runs."""

import inspect
import os
import pathlib
import re
import subprocess
import sys

import pytest

import crisalad_jax as cj
from crisalad_jax import sinkhorn
from crisalad_jax.config.registry import REGISTRIES
from tests.training.programs import SOON

ROOT = pathlib.Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = sorted((ROOT / "docs").rglob("*.md"))
TEXTS = [
    *(README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", ROOT / "examples" / "README.md"),
    *PAGES,
]
MODULES = {name for name in cj.__all__ if inspect.ismodule(getattr(cj, name))}
LINK = re.compile(r"\]\(([^)\s]+)\)")
PATH = re.compile(r"`((?:examples|scripts|tests|docs|\.ci)/[\w./-]*[\w/])`")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", out]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return out


@pytest.fixture(scope="module")
def entries(site):
    """What stands below every heading of the reference, up to the next, by the heading's anchor."""
    found = {}
    for page in (site / "reference").rglob("*.html"):
        for piece in re.split(r"(?=<h[1-6] )", page.read_text(encoding="utf-8"))[1:]:
            anchor = re.match(r'<h[1-6] id="([^"]+)"', piece)
            if anchor:
                found[anchor[1]] = piece
    return found


def test_site_builds_without_a_dead_link(site):
    # --strict makes an error of every link and anchor that leads nowhere (with --quiet, of none).
    assert (site / "how-to" / "add-a-loss" / "index.html").is_file()
    assert (site / "reference" / "sinkhorn" / "index.html").is_file()


def _documented(entries, anchors):
    # An entry has words of its own, not a signature alone.
    return any("<p>" in entries.get(anchor, "") for anchor in anchors)


def test_reference_has_every_public_name(entries):
    missing = []
    for name in cj.__all__:
        anchors = [f"crisalad_jax.{name}"]
        if getattr(sinkhorn, name, None) == getattr(cj, name):
            anchors.append(f"crisalad_jax.sinkhorn.{name}")
        if name not in (*MODULES, "__version__") and not _documented(entries, anchors):
            missing.append(name)
    assert not missing


def test_reference_has_every_name_of_the_transport(entries):
    names = [name for name in vars(sinkhorn) if not name.startswith("_")]
    assert not [n for n in names if not _documented(entries, [f"crisalad_jax.sinkhorn.{n}"])]


@pytest.mark.parametrize("kind", sorted(REGISTRIES))
def test_reference_has_every_built_in_part(entries, kind):
    classes = {anchor.rpartition(".")[2] for anchor in entries}
    registry = REGISTRIES[kind]
    parts = [registry.find(name) for name in registry]
    ours = [part for part in parts if part.__module__.startswith("crisalad_jax.")]
    assert ours
    assert not [part.__name__ for part in ours if part.__name__ not in classes]


def test_public_names_say_what_they_do():
    constants = {"PRESETS", "__version__"}
    assert not [n for n in cj.__all__ if n not in constants and not getattr(cj, n).__doc__]


def test_a_name_left_out_would_be_found(entries):
    assert not _documented(entries, ["crisalad_jax.no_such_name"])


USES = [
    *(page for page in TEXTS if page.name != "CHANGELOG.md" and page.parent.name != "reference"),
    *sorted((ROOT / "examples").rglob("*.py")),
    *sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")),
]
# A link's anchor, a file, and the group of entry points have names of the package too.
NAME = re.compile(r"(?<![#/\w.])crisalad_jax\.(?!plugins\b)(\w+(?:\.\w+)*)|\bcj\.(\w+(?:\.\w+)*)")
IMPORTED = re.compile(r"from crisalad_jax((?:\.\w+)*) import ([\w, ]+)")


def _private(text):
    """The names in a text that are neither of the package nor of its published modules."""
    named = [f"{m[1] or m[2]}" for m in NAME.finditer(text)]
    named += [
        f"{m[1][1:]}.{name.strip()}".lstrip(".")
        for m in IMPORTED.finditer(text)
        for name in m[2].split(",")
    ]
    private = []
    for name in named:
        first, _, rest = name.partition(".")
        if first not in cj.__all__ or (
            first in MODULES and rest and not hasattr(getattr(cj, first), rest.partition(".")[0])
        ):
            private.append(name)
    return private


@pytest.mark.parametrize("page", USES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_is_shown_uses_public_names_alone(page):
    assert not _private(page.read_text(encoding="utf-8"))


def test_examples_in_public_docstrings_use_public_names_alone():
    shown = [line for n in cj.__all__ for line in (getattr(cj, n).__doc__ or "").splitlines()]
    assert not _private("\n".join(line for line in shown if line.lstrip().startswith(">>>")))


def test_a_private_name_would_be_found():
    shown = "import crisalad_jax.nn.model\nfrom crisalad_jax.nn.vit import A, B\ncj.no, cj.load"
    assert _private(shown) == ["nn.model", "nn.vit", "no", "nn.vit.A", "nn.vit.B"]
    modules = "cj.sinkhorn.solve(x)\nfrom crisalad_jax.sinkhorn import solve, none"
    assert _private(modules) == ["sinkhorn.none"]


def test_attacks_are_as_many_as_their_table_has():
    table = (ROOT / "docs" / "reliability" / "attacks.md").read_text(encoding="utf-8")
    tries, failures = re.findall(r"\*\*([\d,]+)\*\*", table.splitlines()[-1])
    page = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    assert f"{tries} times" in page
    assert f"**{tries}** | **{failures}** |" in page


def test_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 130


@pytest.mark.parametrize("page", TEXTS[:4], ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_outside_of_the_site_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    relative = [link.partition("#")[0] for link in LINK.findall(text) if ":" not in link]
    relative = [link for link in relative if not link.startswith("../../actions/")]  # a badge
    assert not [link for link in relative if link and not (page.parent / link).exists()]


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_that_a_page_names_exist(page):
    named = PATH.findall(page.read_text(encoding="utf-8"))
    assert not [name for name in named if not (ROOT / name).exists()]


@pytest.mark.slow
def test_what_the_pages_show_runs():
    pages = [page for page in TEXTS if "```" in page.read_text(encoding="utf-8")]
    # Most of the time is XLA's, which need not optimise what runs once.
    flags = f"{SOON} {os.environ.get('XLA_FLAGS', '')}"
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    program = [sys.executable, "tests/docs_blocks.py", *map(str, pages)]
    done = subprocess.run(
        program, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    ran = {m[1]: int(m[2]) for m in re.finditer(r"(\S+): (\d+) blocks", done.stdout)}
    for page in (README, *PAGES):
        if page == README or (page.parent.name == "how-to" and page.stem.startswith("add-")):
            assert ran[str(page)] >= 2, page
