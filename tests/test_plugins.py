"""Plug-ins from --plugin to the tables, and what is said of those that are wrong."""

import dataclasses
import json
import pathlib
import pickle
import re
import shutil
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.config import plugins
from crisalad_jax.config.io import read_config, to_plain
from crisalad_jax.config.plugins import load_plugin
from crisalad_jax.config.registry import REGISTRIES
from crisalad_jax.nn.model import Model, describe
from crisalad_jax.sinkhorn import SinkhornConfig, solve
from crisalad_jax.training.losses import LossConfig, metric_loss
from crisalad_jax.training.trainer import run_keys
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import write_json
from crisalad_jax.utils.pytree import named_leaves
from tests.cli.test_cli import Capture, fails, succeeds
from tests.conftest import BATCH, MODEL, RECIPE, random_params, write_city, write_town

ROOT = pathlib.Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
WITHOUT_ENCODER = dataclasses.replace(MODEL, cross_image="none")


pytestmark = pytest.mark.usefixtures("own_parts")


@pytest.mark.parametrize("kind", ["dist-info", "egg-info", "DIST-INFO"])
def test_an_installed_packages_entry_points_are_plugins(kind, tmp_path, monkeypatch):
    part = "import crisalad_jax as cj\n@cj.register_aggregator('first-patch')\n"
    part += "def first_patch(features):\n    return features.patches[0]\n"
    (tmp_path / "installed_part.py").write_text(part)
    folder = tmp_path / f"installed_part-1.0.{kind}"
    folder.mkdir()
    name = "PKG-INFO" if kind == "egg-info" else "METADATA"
    (folder / name).write_text("Metadata-Version: 2.1\nName: installed-part\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[crisalad_jax.plugins]\nmine = installed_part\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    plugins.load_entry_points.cache_clear()
    monkeypatch.setattr(plugins, "_LOADED", {})
    monkeypatch.setitem(sys.modules, "installed_part", None)  # so that it is gone again
    del sys.modules["installed_part"]
    plugins.load_entry_points()
    assert "first-patch" in REGISTRIES["aggregator"]


def load(folder: pathlib.Path, text: str) -> pathlib.Path:
    """Load a plug-in of this text; return its file."""
    path = folder / "mine.py"
    path.write_text(text)
    load_plugin(str(path))
    return path


# Bad input, in the library and through the command line

BROKEN = {
    "raises": ("import os\nraise RuntimeError('no licence\\nfound')\n",
        "cannot be loaded: it raises RuntimeError in line 2: no licence found"),
    "syntax": ("x = 1\ndef broken(:\n", "cannot be loaded: it raises SyntaxError in line 2: "),
    "ends": ("import sys\n\nsys.exit(0)\n", "cannot be loaded: it raises SystemExit in line 3: 0"),
    "taken": ("""
import crisalad_jax as cj

@cj.register_step("newton")
def mine(problem, potentials):
    return potentials
""", "register_step 'newton': found the name taken by crisalad_jax.nn.transport.steps.NewtonStep, "
        "expected another name for mine"),
    "recipe": ("""
import crisalad_jax as cj

@cj.register_recipe("salad")
def mine(model, preset):
    return cj.TrainConfig(model=model)
""", "register_recipe 'salad': found the name taken by crisalad_jax.training.recipes.dinov2, exp"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_a_file_that_cannot_be_loaded(name: str, tmp_path: pathlib.Path, capfd: Capture) -> None:
    text, words = BROKEN[name]
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        load_plugin(str(path))
    assert str(error.value).startswith(f"plugin {path}: {words}")
    assert "\n" not in str(error.value)
    # Not half loaded: it is read again.
    fails(capfd, "info", "--plugin", path, words=(f"plugin {path}: {words}",))


@pytest.mark.parametrize(
    ("given", "kind"), [("none.py", "file"), ("none.none", "module"), ("a_folder", "module")]
)
def test_a_file_or_module_that_is_not_there(
    given: str, kind: str, tmp_path: pathlib.Path, capfd: Capture, monkeypatch
) -> None:
    (tmp_path / "a_folder").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    words = f"plugin {given}: found no such {kind}, expected FILE.py or MODULE"
    fails(capfd, "info", "--plugin", given, words=(words,))


STEPS = """
import dataclasses
import jax.numpy as jnp
import crisalad_jax as cj

@cj.register_step("short")
def short(problem, potentials):
    return potentials._replace(row=potentials.row[..., :2])

@cj.register_step("not-a-number")
def not_a_number(problem, potentials):
    return potentials._replace(row=jnp.log(potentials.row - 1))

@cj.register_step("nothing")
def nothing(problem, potentials):
    pass

@cj.register_step("wide-plan")
@dataclasses.dataclass(frozen=True)
class WidePlan(cj.sinkhorn.Step):
    def step(self, problem, potentials, state, iteration):
        return potentials, state

    def log_plan(self, problem, potentials):
        return jnp.zeros((7, 7))
"""
BAD_STEPS = {
    "short": ", step: found to return (Potentials(row=float32[2], column=float32[",
    "nothing": ", step: found to return (None, None), expected (Potentials(row=float32[",
    "wide-plan": ", log_plan: found to return float32[7,7], expected float32[",
}


def save_with_step(path: pathlib.Path, name: str) -> None:
    """Write a model whose transport has a step of this name."""
    salad = dataclasses.replace(MODEL.aggregator, sinkhorn=SinkhornConfig(step=name))
    config = dataclasses.replace(WITHOUT_ENCODER, aggregator=salad)
    save_weights(path, Model(random_params(config), config))


def solved(config: SinkhornConfig) -> Any:
    return solve(jnp.zeros((6, 3)), jnp.zeros(6), jnp.log(jnp.full(3, 2.0)), config=config)


def refused(words: str, call: Any, *arguments: Any) -> None:
    """The call raises an InputError of one line that begins with these words."""
    with pytest.raises(InputError, match=f"^{re.escape(words)}") as error:
        call(*arguments)
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("name", BAD_STEPS)
def test_a_step_that_returns_something_else(name: str, tmp_path: pathlib.Path) -> None:
    load(tmp_path, STEPS)
    refused(f"step {name}{BAD_STEPS[name]}", solved, SinkhornConfig(name))


def test_a_step_that_makes_nan(
    tmp_path: pathlib.Path, shared: pathlib.Path, capfd: Capture
) -> None:
    """The library's result says so, and an evaluation refuses the descriptors."""
    plugin, weights = load(tmp_path, STEPS), tmp_path / "w.safetensors"
    result = solved(SinkhornConfig("not-a-number"))
    assert not result.finite
    assert not result.converged
    save_with_step(weights, "not-a-number")
    more = ("--weights", weights, "--plugin", plugin, "--quiet")
    data = ("evaluate", "--data", shared / "town", "--batch-size", BATCH)
    fails(
        capfd, *data, *more, words=("queries: row 0 is not finite, expected finite unit vectors",)
    )


AGGREGATORS = """
import dataclasses
import jax.numpy as jnp
import crisalad_jax as cj

@cj.register_aggregator("bare-array")
@dataclasses.dataclass(frozen=True)
class BareArray(cj.Aggregator):
    def token_shape(self, dim):
        return cj.TokenShape(dim, 0, dim)

    def apply(self, params, features, grid, *, key):
        return features.patches.mean(axis=-2)

@cj.register_aggregator("by-patch")
def by_patch(features):
    return features.patches
"""
BAD_AGGREGATORS = {
    "bare-array": "found to return float32[2,32], "
    "expected Tokens(global_token=float32[2,32], local=float32[2,0,32])",
    "by-patch": "found to return Tokens(global_token=float32[2,0], local=float32[2,12,32]), "
    "expected Tokens(global_token=float32[2,0], local=float32[2,256,32])",
}


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("name", BAD_AGGREGATORS)
def test_an_aggregator_that_returns_something_else(name: str, tmp_path: pathlib.Path) -> None:
    load(tmp_path, AGGREGATORS)
    config = dataclasses.replace(WITHOUT_ENCODER, aggregator=name)
    pictures = np.zeros((2, *config.image_size, 3), np.uint8)
    words = f"aggregator {name}: {BAD_AGGREGATORS[name]}"
    refused(words, describe, random_params(config), pictures, config)


LOSSES = """
import crisalad_jax as cj

@cj.register_loss("each")
def each(batch):
    return batch.similarities.sum(axis=1)

@cj.register_loss("silent")
def silent(descriptors, labels):
    pass
"""
BAD_LOSSES = {
    "each": "found to return LossValue(loss=float32[6]), expected LossValue(loss=float32[])",
    "silent": "found to return LossValue(loss=None), expected LossValue(loss=float32[])",
}


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("name", BAD_LOSSES)
def test_a_loss_that_is_no_number(name: str, tmp_path: pathlib.Path) -> None:
    load(tmp_path, LOSSES)
    config = LossConfig(kind=name)
    words = f"loss {name}: {BAD_LOSSES[name]}"
    refused(words, metric_loss, jnp.eye(6), jnp.arange(6) // 2, config)


RAISES = """
import crisalad_jax as cj

@cj.register_step("raises")
def raises(problem, potentials):
    rows = problem.lse_rows(potentials.row)
    return helper(rows)

def helper(rows):
    raise ERROR
"""


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize(
    ("raised", "words"),
    [
        ('ValueError("no rows,\\nsome")', "ValueError: no rows, some"),
        ("SystemExit(0)", "SystemExit: 0"),
    ],
)
def test_a_plug_in_that_raises_while_it_runs_is_named_in_one_line(
    raised: str, words: str, tmp_path: pathlib.Path, shared: pathlib.Path, capfd: Capture
) -> None:
    plugin, weights = load(tmp_path, RAISES.replace("ERROR", raised)), tmp_path / "w.safetensors"
    save_with_step(weights, "raises")
    data = ("evaluate", "--data", shared / "town", "--weights", weights, "--batch-size", BATCH)
    words = f"crisalad: plugin {plugin}: line 10, in helper: {words} (from Python you see the"
    fails(capfd, *data, "--plugin", plugin, "--quiet", words=(words,))


def test_an_error_elsewhere_names_the_plug_ins_if_there_are_some(
    tmp_path: pathlib.Path, capfd: Capture, monkeypatch
) -> None:
    """What a plug-in returned may break other code; else it is an error of this package."""

    def broken(*_: Any, **__: Any) -> None:
        raise ValueError("not a plug-in's")

    monkeypatch.setattr("crisalad_jax.cli.info.run", broken)
    plugin = load(tmp_path, RAISES)
    words = f"crisalad: plugin {plugin}: ValueError: not a plug-in's (from Python"
    fails(capfd, "info", "--plugin", plugin, words=(words,))
    monkeypatch.setattr(plugins, "_LOADED", {})
    with pytest.raises(ValueError, match="not a plug-in's"):
        succeeds(capfd, "info")


def test_a_dustbin_that_returns_something_else_is_named() -> None:
    @cj.sinkhorn.register_dustbin("wrong")
    @dataclasses.dataclass(frozen=True)
    class Wrong(cj.sinkhorn.Dustbin):
        def marginals(self, params: Any, scores: Any, patches: Any) -> Any:
            return scores

    with pytest.raises(InputError, match=r"^dustbin wrong: found \w+, expected Marginals"):
        cj.sinkhorn.assign_with_dustbin(jnp.zeros((6, 3)), None, "wrong")


@pytest.mark.parametrize("returned", [None, "potentials", "short"])
def test_a_gradient_that_returns_something_else_is_named(returned: str | None) -> None:
    @cj.sinkhorn.register_gradient("wrong")
    @dataclasses.dataclass(frozen=True)
    class Wrong(cj.sinkhorn.Gradient):
        def solve(self, problem: Any, config: Any, params: Any, init: Any) -> Any:
            short = init._replace(row=init.row[1:])
            one = jnp.zeros((), jnp.int32)
            solution = cj.sinkhorn.Solution(short, one, one > 0)
            return {None: None, "potentials": init, "short": solution}[returned]

    found = {
        None: "None",
        "potentials": r"Potentials\(row=float32\[6\], column=float32\[3\]\)",
        "short": r"Solution\(potentials=Potentials\(row=float32\[5\], .*\)",
    }[returned]
    with pytest.raises(InputError, match=f"^gradient wrong: found to return {found}, expected S"):
        solved(SinkhornConfig(gradient="wrong"))


@pytest.mark.parametrize(
    ("returned", "words"),
    [(jnp.zeros((2, 3, 4)), r"\(2, 3, 4\)"), (None, "None"), (1.0, "1.0")],
)
def test_a_function_that_makes_no_tokens_is_named(returned: Any, words: str) -> None:
    @cj.register_aggregator("wrong-tokens")
    def wrong_tokens(features):
        return returned

    with pytest.raises(
        InputError, match=f"^aggregator wrong_tokens: found to return {words}, expected a vector"
    ):
        cj.ModelConfig(aggregator="wrong-tokens").descriptor_dim  # noqa: B018


def test_files_that_need_a_part_that_is_not_there_name_its_plug_in(
    tmp_path: pathlib.Path, shared: pathlib.Path, capfd: Capture, monkeypatch
) -> None:
    weights, steps = tmp_path / "w.safetensors", REGISTRIES["step"]
    built_in = dict(steps._parts)
    load_plugin(str(EXAMPLES / "plugins" / "momentum.py"))
    save_with_step(weights, "momentum")
    images, out = shared / "town" / "images" / "test" / "database", tmp_path / "map"
    succeeds(capfd, "index", "--images", images, "--weights", weights, "--out", out, "--quiet")
    run = tmp_path / "config.json"
    config = dataclasses.replace(RECIPE, model=load_weights(weights)[1])
    write_json(run, to_plain(config))
    monkeypatch.setattr(steps, "_parts", built_in)
    words = "step: found 'momentum', expected one of "
    hint = "(the plug-in momentum.py had it: --plugin momentum.py, or load_plugin)"
    with pytest.raises(InputError) as error:
        load_weights(weights)
    assert str(error.value).startswith(f"{weights} (metadata): {words}")
    assert hint in str(error.value)
    data = ("evaluate", "--data", shared / "town", "--weights", weights)
    fails(capfd, *data, words=(words, hint))
    fails(capfd, "query", next(images.iterdir()), "--map", out, words=(words, hint))
    with pytest.raises(InputError, match=re.escape(hint)):
        read_config(cj.TrainConfig, run)
    # As one writes it by hand: nobody knows which plug-in.
    with pytest.raises(InputError, match=r"is a plug-in missing.*FILE\.py or MODULE"):
        SinkhornConfig(step="momentum")


@pytest.mark.parametrize(
    ("module", "home"),
    [
        ("crisalad_jax.nn.transport.steps", None),
        ("vpr_parts.gem", "vpr_parts.gem"),
        ("crisalad_jax_more.gem", "crisalad_jax_more.gem"),
        ("__main__", "train_mine.py"),
    ],
)
def test_where_a_part_is_from(module: str, home: str | None, monkeypatch) -> None:
    main = sys.modules["__main__"]
    monkeypatch.setattr(main, "__file__", "/some/where/train_mine.py", raising=False)
    assert plugins.home_of(module) == home
    monkeypatch.delattr(main, "__file__")  # as in a notebook
    assert plugins.home_of("__main__") is None


# From training to the table


def copies(folder: pathlib.Path, *names: str) -> list[pathlib.Path]:
    """Examples in a folder where a test may change them."""
    return [
        pathlib.Path(shutil.copy(EXAMPLES / f"{name}.py", folder / f"{name.split('/')[-1]}.py"))
        for name in names
    ]


CHOSEN = (
    *("--model.aggregator.sinkhorn.step", "learnt-epsilon"),
    *("--model.aggregator.dustbin", "network", "--loss.kind", "soft-triplet"),
)
"""Three plug-ins in one model."""
NAMES = ("plugins/learnt_epsilon", "plugins/learnt_dustbin", "loss")


@pytest.mark.slow
def test_a_step_a_dustbin_and_a_loss_are_trained_saved_and_told(
    tmp_path: pathlib.Path, shared: pathlib.Path, capfd: Capture
) -> None:
    files = copies(tmp_path, *NAMES)
    run = ("train", "--data", shared / "city", "--out", tmp_path / "run", "--quiet")
    config = ("--config", shared / "recipe.json", "--epochs", 1, *CHOSEN)
    succeeds(capfd, *run, *config, "--plugin", *files)
    weights = tmp_path / "run" / "last.safetensors"
    params, model = cj.load(weights)
    salad: Any = model.aggregator
    assert salad.sinkhorn.step == REGISTRIES["step"].make("learnt-epsilon")
    assert salad.dustbin.part_name == "network"
    learnt = named_leaves(params.aggregator)
    # Two steps of AdamW at a rate of 1e-3 and of what a linear decay leaves of it.
    assert 1e-4 < abs(learnt["step.log_epsilon"]) < 3e-3
    assert 1e-4 < abs(learnt["dust_bin.out"]).max() < 3e-3
    told = json.loads((tmp_path / "run" / "config.json").read_text())
    kind = {"name": "soft-triplet", "scale": 10.0, "plugin": "loss.py"}
    assert told["loss"]["kind"] == kind
    # Another source behind the name is told, and nothing else is.
    data = ("evaluate", "--data", shared / "town", "--weights", weights, "--plugin", *files)
    rest = ("--batch-size", BATCH, "--grouping", "single", "--quiet")
    assert "R@1" in succeeds(capfd, *data, *rest)
    files[0].write_text(files[0].read_text().replace("jnp.exp(", "jnp.exp(0.5 * "))
    load_plugin(str(files[0]))  # nothing: it is there
    from crisalad_jax.cli import main

    assert main([str(each) for each in (*data, *rest)]) == 0
    assert capfd.readouterr().err == (
        f"crisalad: note: {weights}: found another source of aggregator.sinkhorn.step "
        "learnt-epsilon than these weights were written with; descriptors may differ\n"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("_unchecked")  # types are not checked for any number of images
def test_an_adapter_and_an_encoder_of_the_manual_are_trained_saved_and_exported(
    tmp_path: pathlib.Path, shared: pathlib.Path, capfd: Capture, scripts
) -> None:
    """Each is one file, a block of its page."""
    files = []
    for page, name in (("add-an-adapter", "my_lora"), ("add-a-cross-image-encoder", "gate")):
        text = (ROOT / "docs" / "how-to" / f"{page}.md").read_text()
        code = re.search(rf"<!-- run: {name}\.py -->\n```python\n(.*?)```", text, re.DOTALL)
        assert code is not None
        files.append(tmp_path / f"{name}.py")
        files[-1].write_text(code[1])
    plug = ("--plugin", *files)
    succeeds(
        *(capfd, "train", "--data", shared / "city", "--out", tmp_path / "run", "--quiet", *plug),
        *("--config", shared / "recipe.json", "--epochs", 1, "--trainable", "adapters,head"),
        *("--model.backbone.adapter", "my-lora", "--model.backbone.adapter.rank", 2),
        *("--model.cross-image", "gated-mean", "--loss.kind.base", 0.5),
    )
    weights = tmp_path / "run" / "last.safetensors"
    params, config = cj.load(weights)
    assert config.backbone.adapter.rank == 2
    start = cj.init_crisalad(run_keys(RECIPE.seed)[0], config).backbone.blocks
    blocks = params.backbone.blocks
    # Two steps of AdamW at 1e-3 and less; both start at 0. The layer is frozen.
    for learnt in (blocks.adapter["up"][0], blocks.adapter["up"][1], params.cross_image["gate"]):
        assert 1e-4 < abs(learnt).max() < 3e-3
    np.testing.assert_array_equal(blocks.attn.qkv.weight, start.attn.qkv.weight)
    town = ("--data", shared / "town", "--weights", weights, "--batch-size", BATCH, "--quiet")
    assert "sequential" in succeeds(capfd, "evaluate", *town, "--grouping", "sequential", *plug)
    images = cj.image_batches(
        sorted((shared / "town").rglob("*.jpg"))[:3], image_size=config.input_size, batch_size=3
    )
    (batch,) = images
    expected = cj.describe(params, batch.images, config)
    merged, plain = cj.merge_adapters(cj.Model(params, config))
    found = cj.describe(merged, batch.images, plain)
    np.testing.assert_allclose(found, expected, atol=1e-6)  # unit vectors in float32
    succeeds(
        *(capfd, "export", "--weights", weights, "--out", tmp_path / "program", *plug),
        *("--platforms", "cpu", "--grouping", "batch"),
    )
    manifest = json.loads((tmp_path / "program" / "manifest.json").read_text())
    program = scripts("run_exported").load(tmp_path / "program", manifest)
    np.testing.assert_allclose(program(batch.images), expected, atol=1e-5)


@pytest.mark.slow
def test_plug_ins_all_the_way_in_processes_of_their_own(tmp_path: pathlib.Path, scripts) -> None:
    """Trained, validated, evaluated, compared by two seeds, exported, and run from there."""
    city, town = write_city(tmp_path / "city"), write_town(tmp_path / "town")
    files = copies(tmp_path, *NAMES, "plugins/momentum", "aggregator")

    def crisalad(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "crisalad_jax", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stderr
        return done

    plug = ("--plugin", *files)
    trained = crisalad(
        *("train", "--data", city, "--val", town, "--out", tmp_path / "run", "--preset", "tiny"),
        *("--epochs", 4, "--validate-every", 2, "--places-per-batch", 4, "--quiet"),
        *(*CHOSEN, *plug),
    )
    assert "best R@5" in trained.stdout
    weights = tmp_path / "run" / "last.safetensors"
    data = ("--data", town, "--weights", weights, "--grouping", "single", "--quiet")
    crisalad("evaluate", *data, *plug, "--json", tmp_path / "table.json")
    assert "found 'network', expected one of" in crisalad("evaluate", *data, code=2).stderr

    methods = ["crisalad", "step:momentum", "attention-pool"]
    crisalad(
        *("compare", "--methods", ",".join(methods), "--preset", "tiny", "--seeds", 2),
        *("--epochs", 4, "--train", city, "--test", town, "--out", tmp_path / "compared"),
        *("--quiet", *plug),
    )
    rows = json.loads((tmp_path / "compared" / "results.json").read_text())["rows"]
    assert [row["name"] for row in rows] == methods

    crisalad(
        *("export", "--weights", weights, "--out", tmp_path / "program", "--platforms", "cpu"),
        *plug,
    )
    images = town / "images" / "test" / "database"
    exported = tmp_path / "exported.npy"
    run_exported = scripts("run_exported")
    script = [sys.executable, ROOT / "scripts" / "run_exported.py", tmp_path / "program"]
    subprocess.run([*script, "--images", images, "--out", exported], check=True)
    crisalad(
        *("extract", "--weights", weights, "--images", images, "--out", tmp_path / "own.npy"),
        *("--grouping", "single", "--quiet", *plug),
    )
    found, expected = np.load(exported), np.load(tmp_path / "own.npy")
    # The script's pictures are Pillow's, whose pixels differ from OpenCV's by a level at times.
    np.testing.assert_allclose(found, expected, atol=1e-3)
    # The program itself makes the same sums, in float32, in another order.
    manifest = json.loads((tmp_path / "program" / "manifest.json").read_text())
    program = run_exported.load(tmp_path / "program", manifest)
    (batch,) = cj.image_batches(sorted(images.iterdir()), image_size=(98, 98), batch_size=7)
    np.testing.assert_allclose(program(batch.images), expected, atol=1e-5)


@pytest.mark.usefixtures("_unchecked")
@pytest.mark.parametrize("dtype", ["bfloat16", "int32"])
def test_tokens_parameters_and_losses_of_another_type_are_named(dtype: str) -> None:
    @cj.register_aggregator("half")
    @dataclasses.dataclass(frozen=True)
    class Half(cj.Aggregator):
        draws: bool = False

        def token_shape(self, dim: int) -> cj.TokenShape:
            return cj.TokenShape(dim, 0, dim)

        def init(self, key: Any, backbone: Any, grid: Any) -> Any:
            return {"scale": jnp.ones(3, dtype)} if self.draws else None

        def apply(self, params: Any, features: Any, grid: Any, *, key: Any) -> cj.Tokens:
            return cj.Tokens.of_global(features.patches.mean(axis=-2).astype(dtype))

    config = dataclasses.replace(WITHOUT_ENCODER, aggregator=Half())
    pictures = np.zeros((2, *config.image_size, 3), np.uint8)
    words = f"^aggregator half: found to return Tokens.global_token={dtype}.*, expected .*float32"
    with pytest.raises(InputError, match=words):
        describe(random_params(config), pictures, config)
    config = dataclasses.replace(config, aggregator=Half(draws=True))
    words = f"^aggregator half: found parameter scale of type {dtype}, expected float32"
    with pytest.raises(InputError, match=words):
        cj.init_crisalad(jax.random.key(0), config)

    @cj.register_loss("half")
    def half(batch: Any) -> Any:
        return batch.similarities.sum().astype(dtype)

    with pytest.raises(
        InputError,
        match=f"^loss half: found to return .*loss={dtype}.*, expected .*float32",
    ):
        metric_loss(jnp.eye(6), jnp.arange(6) // 2, LossConfig(kind="half"))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (lambda a, b: b, "found <function .*, expected a name without .*: @r"),
        (3, "found 3, expected a name"),
        ("", "found '', expected a name without"),
        ("my:step", "found 'my:step', expected a name without"),
    ],
)
def test_a_registration_without_a_name_is_refused(name: Any, words: str) -> None:
    with pytest.raises(InputError, match=f"^register_step: {words}"):
        cj.register_step(name)


@pytest.mark.parametrize(
    ("kind", "default", "words"),
    [
        (int, "three", "found 'three', expected a whole number"),
        (tuple, (1, 2), r"found \[1, 2\], expected tuple"),
        (Any, print, "configuration: found <built-in function print>"),
    ],
)
def test_settings_that_no_file_can_keep_are_refused(kind: Any, default: Any, words: str) -> None:
    made = dataclasses.make_dataclass(
        "Odd", [("field", kind, default)], bases=(type(cj.LossConfig().kind),), frozen=True
    )
    with pytest.raises(InputError, match=words):
        cj.register_loss("odd")(made)
    assert "odd" not in REGISTRIES["loss"]


def test_a_preset_of_another_field_is_refused() -> None:
    base = type(cj.LossConfig().kind)
    made = dataclasses.make_dataclass("Odd", [("scale", int, 1)], bases=(base,), frozen=True)
    with pytest.raises(InputError, match=r"unexpected keyword argument 'scal'.*; expected all"):
        cj.register_loss("odd", tiny={"scal": 2})(made)


@pytest.mark.slow
def test_a_run_goes_on_with_the_source_that_it_began_with_alone(
    tmp_path: pathlib.Path, shared: pathlib.Path, capfd: Capture, monkeypatch
) -> None:
    plugin, out = tmp_path / "mine.py", tmp_path / "out"
    text = "import crisalad_jax as cj\n@cj.register_loss('close')\n"
    text += "def close(batch):\n    return 1 - batch.similarities.mean()\n"
    plugin.write_text(text)
    run = ("train", "--data", shared / "city", "--out", out, "--config", shared / "recipe.json")
    more = ("--weights", shared / "weights.safetensors", "--plugin", plugin, "--quiet")
    given = (*run, *more, "--loss.kind", "close", "--loss.miner", "none")
    succeeds(capfd, *given)
    succeeds(capfd, *given)  # the same command finds all done
    plugin.write_text(text.replace("1 -", "2 -"))
    words = f"{out}: the run started from another source of loss.kind close than are given now"
    fails(capfd, *given, words=(words,))


def test_settings_of_the_transport_are_unpickled_by_a_new_process(tmp_path: pathlib.Path):
    """The gradient's part is registered by a module that the configuration does not import."""
    config = cj.SinkhornConfig(iterations=7)
    (tmp_path / "config").write_bytes(pickle.dumps(config))
    program = f"import pickle; print(pickle.load(open({str(tmp_path / 'config')!r}, 'rb')))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.stdout.strip(), done.returncode) == (repr(config), 0)
