"""What works with the core alone, what says which extra it lacks, and the wheel by itself."""

import os
import pathlib
import subprocess
import sys
import tomllib
import venv
import zipfile

import pytest
from packaging.requirements import Requirement

from crisalad_jax.cli import _COMMANDS
from crisalad_jax.utils import compiler
from crisalad_jax.utils.extras import EXTRAS

ROOT = pathlib.Path(__file__).parents[1]
CORE = ROOT / "tests" / "core_only.py"
# Modules of the extras cannot be imported, as if they were not installed.
WITHOUT_EXTRAS = f"""
import importlib.abc, runpy, sys

class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted({name for each in EXTRAS.values() for name in each})}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
"""


def without_extras(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS + program, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize(
    ("version", "taken"),
    [
        ("0.10.1", False),
        ("0.10.2", True),
        ("0.11.0", False),
        ("0.11.2", False),
        ("0.12.0.1", True),
        ("0.12.3", True),
        ("0.13.0", False),
    ],
)
def test_pip_takes_the_versions_of_jax_that_are_tested(version, taken):
    """0.11 crashes while it compiles for several CPU devices; newer ones nobody has tried."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = [Requirement(each) for each in project["dependencies"]]
    (jax,) = (each for each in requirements if each.name == "jax")
    assert jax.specifier.contains(version) == taken
    # What is installed without complaint starts without a warning.
    minor = tuple(map(int, version.split(".")[:2]))
    assert not taken or minor in compiler._TESTED


def test_research_needs_the_core_alone():
    done = without_extras(f"runpy.run_path({str(CORE)!r}, run_name='__main__')")
    assert done.returncode == 0, done.stderr


COMMAND = "from crisalad_jax.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.parametrize("verb", _COMMANDS)
def test_a_verb_names_the_extra_that_it_lacks(verb):
    done = without_extras(COMMAND, verb, "--help")
    assert done.returncode == 2
    assert done.stderr.startswith(f"crisalad {verb}: found no module ") or done.stderr.startswith(
        f"crisalad: crisalad {verb}: found no module "
    )
    assert "pip install 'crisalad-jax[" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_public_name_says_which_extra_it_lacks():
    done = without_extras("import crisalad_jax; crisalad_jax.make_train_step")
    last = done.stderr.strip().splitlines()[-1]
    assert last == (
        "ModuleNotFoundError: crisalad_jax.make_train_step: found no module optax, expected it "
        "with the extra train: pip install 'crisalad-jax[train]' (or [all])"
    )


def install(folder: pathlib.Path, *requirements: str) -> pathlib.Path:
    """A fresh environment with these; its python."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    command = [python, "-m", "pip", "install", "--quiet", *requirements]
    subprocess.run(command, check=True, cwd=folder)
    return python


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT]
    subprocess.run(command, check=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_holds_what_is_no_python(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    package = ROOT / "crisalad_jax"
    files = {
        path.relative_to(ROOT).as_posix()
        for path in package.rglob("*")
        if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc")
    }
    assert files <= held
    assert {"crisalad_jax/py.typed", "crisalad_jax/__init__.pyi"} <= files


@pytest.mark.slow
def test_the_core_is_installed_without_the_extras(wheel, tmp_path):
    python = install(tmp_path / "venv", str(wheel))
    program = (
        "import importlib.util, runpy; "
        f"found = [m for m in {sorted(set().union(*EXTRAS.values()))} "
        "if importlib.util.find_spec(m)]; "
        "assert not found, found; "
        f"runpy.run_path({str(CORE)!r}, run_name='__main__')"
    )
    subprocess.run([python, "-c", program], check=True, cwd=tmp_path)


@pytest.mark.slow
def test_the_wheel_runs_the_demo_and_every_help_without_the_checkout(wheel, tmp_path):
    python = install(tmp_path / "venv", f"{wheel}[all]")
    environment = {**os.environ, "PYTHONPATH": ""}
    crisalad = python.parent / "crisalad"
    for verb in _COMMANDS:
        done = subprocess.run(
            [crisalad, verb, "--help"], cwd=tmp_path, env=environment, capture_output=True
        )
        assert (done.returncode, done.stderr) == (0, b""), verb
        assert done.stdout
    subprocess.run([crisalad, "demo", "--out", "demo"], check=True, cwd=tmp_path, env=environment)
    made = {path.name for path in (tmp_path / "demo").iterdir()}
    assert made >= {"recall.png", "gallery.png", "recalls.md", "run"}
