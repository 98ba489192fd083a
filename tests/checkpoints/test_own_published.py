"""A published model of one's own, in one file: read by name, and refused where it is wrong."""

import dataclasses
import pathlib
import re

import jax
import numpy as np
import pytest
import safetensors.numpy

import crisalad_jax as cj
from crisalad_jax.checkpoints.formats import FORMATS
from crisalad_jax.checkpoints.published import PUBLISHED
from crisalad_jax.cli import main
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.utils.errors import InputError

pytestmark = pytest.mark.usefixtures("own_parts")

PAGE = pathlib.Path(__file__).parents[2] / "docs" / "how-to" / "add-a-published-model.md"


def plugin(folder: pathlib.Path) -> pathlib.Path:
    """The page's file, with weights in a folder."""
    code = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    path = folder / "town.py"
    path.write_text(code.replace("https://town.example/weights/", f"{folder.as_uri()}/"))
    return path


def layers(prefix: str, name: str, array: np.ndarray) -> dict[str, np.ndarray]:
    """Torch's names and axes, written out by hand."""
    stage, layer, rest = re.fullmatch(r"blocks\.(\d)\.layers\.(\d)\.(.*)", name).groups()
    number = re.fullmatch(r"convs\.(\d)\.(conv|norm)\.(.*)", rest)
    if number:
        kind = "conv" if number[2] == "conv" else "bn"
        there = f"{kind}{int(number[1]) + 1}.{number[3]}"
    else:
        there = rest.replace("shortcut.conv", "downsample.0").replace(
            "shortcut.norm", "downsample.1"
        )
    axes = array.transpose(3, 2, 0, 1) if array.ndim == 4 else array
    return {f"{prefix}layer{int(stage) + 1}.{layer}.{there}": axes}


def stored(params: cj.Crisalad) -> dict[str, np.ndarray]:
    found = {}
    for name, leaf in cj.named_leaves(params).items():
        array = np.asarray(leaf)
        if name == "aggregator.centroids":
            found["vlad.centres"] = array
        elif name.startswith("aggregator.conv."):
            axes = array.T[:, :, None, None] if array.ndim == 2 else array
            found[name.replace("aggregator.conv", "vlad.scores")] = axes
        elif name.startswith("backbone.stem."):
            there = name.replace("backbone.stem.conv", "net.conv1")
            there = there.replace("backbone.stem.norm", "net.bn1")
            found[there] = array.transpose(3, 2, 0, 1) if array.ndim == 4 else array
        else:
            found |= layers("net.", name.removeprefix("backbone."), array)
    counts = [n.removesuffix("running_var") for n in found if n.endswith("running_var")]
    found |= {f"{name}num_batches_tracked": np.zeros((), np.int64) for name in counts}
    return {name: np.array(array, order="C") for name, array in found.items()}


@pytest.fixture
def town(tmp_path, monkeypatch) -> cj.Model:
    """Random weights in the file that the plug-in names, and the plug-in loaded."""
    monkeypatch.setenv("CRISALAD_CACHE", str(tmp_path / "cache"))
    config = cj.ModelConfig(
        image_size=(96, 128),
        backbone=ResNetConfig(layers=18, stages=3),
        aggregator=cj.make_part("aggregator", "netvlad", clusters=4),
        cross_image="none",
    )
    params = cj.init_crisalad(jax.random.key(3), config)
    safetensors.numpy.save_file(stored(params), tmp_path / "town.safetensors")
    cj.load_plugin(str(plugin(tmp_path)))
    return cj.Model(params, config)


def test_the_page_s_model_is_read_by_name_and_written_back(town, tmp_path):
    found = cj.load("town-vlad", quiet=True)
    assert dataclasses.replace(found.config, preprocessing=town.config.preprocessing) == town.config
    for name, leaf in cj.named_leaves(found.params).items():
        np.testing.assert_array_equal(leaf, cj.named_leaves(town.params)[name], name)
    leaves = jax.tree.leaves(found.params)
    facts = PUBLISHED["town-vlad"]
    assert (facts.parameters, facts.descriptor) == (
        sum(leaf.size for leaf in leaves),
        found.config.descriptor_dim,
    )
    ours, back = tmp_path / "ours.safetensors", tmp_path / "back.safetensors"
    cj.convert(tmp_path / "town.safetensors", ours)
    cj.convert(ours, back)
    before, after = (
        safetensors.numpy.load_file(path) for path in (tmp_path / "town.safetensors", back)
    )
    assert before.keys() == after.keys()
    for name in before:
        np.testing.assert_array_equal(before[name], after[name], name)


FAMILY = """
[[family]]
format = "FORMAT"
licence = "MIT"
repository = "town/vlad"
paper = "Town"
images = "any"
models = [{ name = "NAME", descriptor = 1, parameters = 1, file = "town.pth" }]
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("town", "found no TOML: "),
        ("[[family]]", "cannot be read: 'models'"),
        (FAMILY.replace("FORMAT", "cosplace").replace("NAME", "megaloc"), "found megaloc, a name"),
        (FAMILY.replace("FORMAT", "vlad"), "NAME: found format 'vlad', expected one that the text"),
        (FAMILY.replace("paper", "papers"), "cannot be read: .*'papers'"),
        (FAMILY.replace("MIT", "Town"), "licence: found 'Town', expected one of Apache-2.0, "),
        (FAMILY.replace("descriptor = 1", "descriptor = 'x'"), "Published.descriptor: found 'x'"),
        (
            "[[licence]]\nname = 'MIT'\ncommercial = false" + FAMILY,
            "found licence MIT, a name that is taken",
        ),
        ("[formats.cosplace]", "found formats.cosplace, a name that is taken"),
        (
            "[layers.cosplace]",
            r"found \[layers\], expected chains, tables, backbones",
        ),
        ("[heads.town]\naggregator = 'towns'", "aggregator: found 'towns', exp"),
        (
            "[formats.town]\nholds = 'x'\nbackbone = 'nets'\nhead = 'boq'",
            "backbone: found 'nets', exp",
        ),
        (
            "[heads.town]\naggregator = 'boq'\nrows = 'a b c'",
            "rows, form: found 'c', expected one of absent-exponent, ",
        ),
        (
            "[formats.town]\nholds = 'x'\nbackbone = 'vit'\nhead = 'boq'\nimages = 'pillow 96'",
            "images: found 'pillow 96', expected CHAIN HEIGHT WIDTH",
        ),
        (
            "[heads.town]\naggregator = 'boq'\nrows = 'a b'",
            "cannot be read: not enough values to unpack",
        ),
    ],
)
def test_what_is_wrong_registers_nothing(text, words):
    before = dict(FORMATS), dict(PUBLISHED)
    licence = "[[licence]]\nname = 'Town licence'\n" if text != "town" else ""
    with pytest.raises(InputError, match=f"^register_published: {words}"):
        cj.register_published(licence + text)
    assert before == (FORMATS, PUBLISHED)
    # Nor is the licence, which was right.
    with pytest.raises(InputError, match="licence: found 'Town licence'"):
        cj.register_published(FAMILY.replace("MIT", "Town licence"))


def test_the_command_line_lists_it(tmp_path, capsys):
    assert main(["models", "town-vlad", "--plugin", str(plugin(tmp_path))]) == 0
    assert "Town et al. 2026" in capsys.readouterr().out
