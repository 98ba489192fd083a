"""The Dockerfile that serves a map: its files, its commands, and its steps without Docker."""

import importlib
import json
import os
import pathlib
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
import venv

import pytest
import yaml

from crisalad_jax import cli

ROOT = pathlib.Path(__file__).parents[1]
DOCKERFILE = ROOT / "examples" / "docker" / "Dockerfile"


def instructions() -> list[tuple[str, str]]:
    """Keyword and arguments of each line, continued ones joined."""
    text = DOCKERFILE.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in lines]


def only(keyword: str) -> str:
    (found,) = (rest for name, rest in instructions() if name == keyword)
    return found


def served() -> list[str]:
    """What runs in a container: the entry point, then the default command."""
    return json.loads(only("ENTRYPOINT")) + json.loads(only("CMD"))


def test_files_that_are_copied_exist():
    copied = [rest.split()[:-1] for name, rest in instructions() if name == "COPY"]
    assert copied
    assert all((ROOT / source).exists() for sources in copied for source in sources)


def test_the_command_is_one_of_ours():
    program, verb, *given = served()
    assert program == "crisalad"
    flags = cli._parse(verb, importlib.import_module(f"crisalad_jax.cli.{verb}"), given)
    assert (flags.host, str(flags.map)) == ("0.0.0.0", "/map")
    assert str(flags.port) == only("EXPOSE")
    assert f"127.0.0.1:{flags.port}/health" in only("HEALTHCHECK")


def test_it_runs_as_a_user_who_owns_the_cache():
    names = [name for name, _ in instructions()]
    assert only("USER") != "root"
    (made,) = (rest for name, rest in instructions() if name == "RUN" and "useradd" in rest)
    assert f"-o {only('USER')} {only('VOLUME')}" in made
    assert only("ENV") == f"CRISALAD_CACHE={only('VOLUME')}"
    assert names.index("USER") < names.index("ENTRYPOINT")


def test_the_workflow_builds_it():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text())
    steps = [step.get("run", "") for step in workflow["jobs"]["docker"]["steps"]]
    (build,) = (step for step in steps if step.startswith("docker build"))
    assert DOCKERFILE.relative_to(ROOT).as_posix() in build


@pytest.mark.slow
def test_its_steps_serve_a_map(tmp_path):
    """In a virtual environment in the place of the image, with the packages of this one."""
    bin = tmp_path / "venv" / "bin"
    venv.create(tmp_path / "venv", with_pip=True)
    # Packages of this environment stand for those that pip would download.
    site = next(path for path in sys.path if path.endswith("site-packages"))
    own = next((tmp_path / "venv" / "lib").iterdir()) / "site-packages"
    environment = os.environ | {"PATH": f"{bin}:{os.environ['PATH']}", "CRISALAD_TOKEN": "t" * 16}
    environment["CRISALAD_CACHE"] = str(tmp_path / "cache")
    environment.pop("PYTHONPATH", None)
    for name, rest in instructions():
        if name == "COPY":
            *sources, target = rest.split()
            for source in sources:
                to = tmp_path / target.lstrip("/")
                if (ROOT / source).is_dir():
                    shutil.copytree(ROOT / source, to)
                else:
                    to.mkdir(exist_ok=True)
                    shutil.copy(ROOT / source, to)
    (step,) = (rest for name, rest in instructions() if name == "RUN" and rest.startswith("pip "))
    step = step.replace('"/src', f'--no-deps "{tmp_path}/src')
    (own / "this.pth").write_text(site)
    subprocess.run(step, shell=True, env=environment, check=True, timeout=300)
    (tmp_path / "photos").mkdir()
    shutil.copy(ROOT / "docs" / "demo_gallery.png", tmp_path / "photos")
    given = "index --images photos --out map --weights hog --quiet"
    subprocess.run([bin / "crisalad", *given.split()], cwd=tmp_path, env=environment, check=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    here = {"8000": port, "/map": str(tmp_path / "map")}
    command = [here.get(each, each) for each in served()]
    health = re.search(r"CMD (\[.*)", only("HEALTHCHECK"))
    assert health is not None
    check = [each.replace("8000", port) for each in json.loads(health[1])]
    with subprocess.Popen(command, env=environment, cwd="/") as service:
        try:
            deadline = time.monotonic() + 240
            while subprocess.run(check, env=environment, capture_output=True).returncode:
                assert service.poll() is None, shlex.join(command)
                assert time.monotonic() < deadline
                time.sleep(1)
        finally:
            service.terminate()
    code = "import crisalad_jax; print(crisalad_jax.__file__)"
    found = subprocess.run(
        [bin / "python", "-c", code], env=environment, cwd="/", capture_output=True, text=True
    )
    assert found.stdout.startswith(str(own))
