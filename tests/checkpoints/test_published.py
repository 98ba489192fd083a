"""The table of published models against the layouts of their files."""

import json
import pathlib
import re
from urllib.parse import urlsplit

import jax
import numpy as np
import pytest

from crisalad_jax.checkpoints.layouts import LAYOUTS, infer
from crisalad_jax.checkpoints.published import PUBLISHED, published_model
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.utils.errors import InputError

PARITY = pathlib.Path(__file__).parents[2] / "parity"
# The stored names and shapes of published files, by the models that have them.
STORED = {
    **{name: f"layouts/{name.replace('-', '_')}" for name in PUBLISHED if "dinov2-vit" in name},
    "salad": "layouts/dino_salad",
    "cricavpr": "layouts/CricaVPR",
    "salad-cm": "zoo/layouts/salad_cm",
    "megaloc": "zoo/layouts/megaloc",
    "megaloc-v1": "zoo/layouts/megaloc_v1_torch",
    "boq-dinov2": "zoo/layouts/boq_dinov2_12288",
    "dino-mix": "zoo/layouts/dinomix_vitb14",
    "supervlad": "zoo/layouts/supervlad",
    "supervlad-crossimage": "zoo/layouts/supervlad_crossimage",
    "supervlad-1-cluster": "zoo/layouts/supervlad",
}
CHANGED = {"supervlad-1-cluster": {"aggregation.conv.weight": (3, 768, 1, 1)}}
"""Shapes that differ from the stored ones: the README's one cluster and two ghosts."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_models_facts_are_those_of_its_file(name):
    model = published_model(name)
    shapes = json.loads((PARITY / f"{STORED[name]}.json").read_text(encoding="utf-8"))
    plain = {key.rpartition("/")[2].removeprefix("module."): shapes[key] for key in shapes}
    plain |= CHANGED.get(name, {})
    blank = {key: np.broadcast_to(np.float32(0), tuple(shape)) for key, shape in plain.items()}
    layout, config = infer(blank, source=name)
    count = sum(leaf.size for leaf in jax.tree.leaves(parameter_shapes(config)))
    assert (model.layout, model.descriptor, model.parameters) == (
        layout,
        config.descriptor_dim,
        count,
    )


def test_the_table_is_sound():
    for name, model in PUBLISHED.items():
        assert model.name == name
        assert re.fullmatch("[a-z0-9][a-z0-9-]*", name)
        assert model.layout in LAYOUTS
        assert urlsplit(model.repository).scheme == "https"
        assert model.url is None or urlsplit(model.url).scheme == "https"
        assert model.url is not None or model.note
        # In a model's folder of the cache stand both this file and the weights made of it.
        assert pathlib.PurePath(model.file).name == model.file != f"{name}.safetensors"
        assert model.images
        assert model.paper
    files = [model.file for model in PUBLISHED.values()]
    assert len(set(files)) == len(files)  # a mirror has them in one folder
    urls = [model.url for model in PUBLISHED.values() if model.url is not None]
    assert len(set(urls)) == len(urls)


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("megalok", "megaloc, megaloc-v1"),
        ("MegaLoc", "megaloc, megaloc-v1"),
        ("dinov2_vitb14", "dinov2-vitb14, "),
        ("supervlad-cross-image", "supervlad-crossimage, "),
    ],
)
def test_an_unknown_name_is_told_with_the_nearest(name, nearest):
    with pytest.raises(InputError, match=f"^{name}: found no published model .*nearest: {nearest}"):
        published_model(name)


def test_a_name_like_no_other_has_no_nearest():
    with pytest.raises(InputError, match=r"expected one of `crisalad models`$"):
        published_model("zzz")
