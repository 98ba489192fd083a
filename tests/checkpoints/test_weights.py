"""Weights there and back bit for bit, and files that are none of ours."""

import dataclasses
import json
import os
import pathlib
import struct
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.numpy

from crisalad_jax.checkpoints import weights
from crisalad_jax.checkpoints.safetensors_io import write_sealed
from crisalad_jax.checkpoints.weights import load_weights, model_hash, save_weights
from crisalad_jax.config.io import to_plain
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.model import Model, parameter_shapes
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import MODEL, assert_equal, random_params


def put(config: Any, name: str, value: Any) -> Any:
    """Replace a field by its dotted name."""
    head, _, rest = name.partition(".")
    inner = put(getattr(config, head), rest, value) if rest else value
    return dataclasses.replace(config, **{head: inner})


WITHOUT_ENCODER = put(MODEL, "cross_image", "none")
REGISTERS = dataclasses.replace(
    MODEL, backbone=dataclasses.replace(MODEL.backbone, registers=4, ffn="swiglu")
)


@pytest.mark.parametrize("config", [MODEL, WITHOUT_ENCODER, REGISTERS])
def test_weights_survive_a_file_bit_for_bit(tmp_path, config):
    params = random_params(config)
    first, again = tmp_path / "new" / "w.safetensors", tmp_path / "again.safetensors"
    save_weights(first, Model(params, config))
    assert os.listdir(tmp_path / "new") == ["w.safetensors"]
    found, found_config = load_weights(first)
    assert found_config == config
    assert_equal(found, params)
    save_weights(again, Model(params, config))
    assert again.read_bytes() == first.read_bytes()


def test_the_file_is_plain_safetensors_with_dotted_names(shared, params):
    """Read by the format's own description: a length, a JSON header, the bytes."""
    data = (shared / "weights.safetensors").read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    metadata = header.pop("__metadata__")
    assert metadata.keys() == {"crisalad-jax 4"}
    told = json.loads(metadata["crisalad-jax 4"])
    assert list(told) == [*("checksum", "config", "version", "parts", "model_sha256")]
    assert told["config"] == to_plain(MODEL)
    assert {field: name for field, (name, _) in told["parts"].items()} == {
        "backbone": "vit",
        "backbone.adapter": "depthwise",
        "cross_image": "transformer",
        "aggregator": "salad",
        "aggregator.dustbin": "column",
        "aggregator.sinkhorn.step": "sinkhorn",
        "aggregator.sinkhorn.start": "zeros",
        "aggregator.sinkhorn.gradient": "unrolled",
    }
    # Only a part from a user's file has a digest.
    assert {digest for _, digest in told["parts"].values()} == {None}
    assert header.keys() == named_leaves(params).keys()
    entry = header["aggregator.score.fc1.weight"]
    assert (entry["dtype"], entry["shape"]) == ("F32", [32, 16])
    start, end = entry["data_offsets"]
    values = np.frombuffer(data[8 + length + start : 8 + length + end], "<f4").reshape(32, 16)
    np.testing.assert_array_equal(values, params.aggregator.score.fc1.weight)


def test_a_changed_number_is_refused_unless_asked_for(tmp_path, shared):
    data = bytearray((shared / "weights.safetensors").read_bytes())
    data[-1] ^= 1
    changed = tmp_path / "changed.safetensors"
    changed.write_bytes(data)
    with pytest.raises(InputError, match=r"changed\.safetensors: found other bytes than were"):
        weights.load_weights(changed)
    assert weights.load_weights(changed, verify=False).config == MODEL


def test_half_precision_is_half_the_room_and_every_number_rounded(tmp_path, shared, params):
    """Read again they are float32, and of these the digest is."""
    save_weights(tmp_path / "half.safetensors", Model(params, MODEL), half=True)
    with safetensors.safe_open(tmp_path / "half.safetensors", framework="numpy") as file:
        stored = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    assert {array.dtype for array in stored.values()} == {np.dtype(np.float16)}
    read = weights.read_weights(tmp_path / "half.safetensors")
    found, digest = read.params, read.digest
    assert read.config == MODEL
    for name, leaf in named_leaves(found).items():
        expected = np.asarray(named_leaves(params)[name])
        assert leaf.dtype == np.float32
        np.testing.assert_array_equal(leaf, expected.astype(np.float16).astype(np.float32))
    assert digest == model_hash(found, MODEL) != model_hash(params, MODEL)
    save_weights(tmp_path / "again.safetensors", Model(found, MODEL), half=True)
    assert weights.read_weights(tmp_path / "again.safetensors").digest == digest
    assert (tmp_path / "half.safetensors").stat().st_size < 0.6 * (
        shared / "weights.safetensors"
    ).stat().st_size


def test_what_half_precision_cannot_hold_is_named(tmp_path, params):
    large = params.aggregator.score.fc1.weight.at[0, 0].set(1e5)
    wrong = put(params, "aggregator.score.fc1.weight", large)
    with pytest.raises(InputError, match=r"aggregator\.score\.fc1\.weight"):
        save_weights(tmp_path / "half.safetensors", Model(wrong, MODEL), half=True)
    assert not list(tmp_path.iterdir())


def test_only_what_parameters_do_not_depend_on_is_free(shared):
    path = shared / "weights.safetensors"
    other = dataclasses.replace(
        MODEL,
        image_size=(56, 70),
        compute_dtype="bfloat16",
        aggregator=dataclasses.replace(MODEL.aggregator, dropout=0.5),
        cross_image=dataclasses.replace(MODEL.cross_image, dropout=0.5),
    )
    load_weights(path, expected=other)
    with pytest.raises(InputError, match=f"^{path}: these weights are of another model: ") as error:
        load_weights(path, expected=PRESETS["tiny"])
    for words in ("backbone.dim: found 32, expected 128", "clusters: found 4, expected 16"):
        assert words in str(error.value)
    assert "image_size" not in str(error.value)


def test_parameters_of_one_image_size_keep_it(tmp_path):
    config = dataclasses.replace(
        WITHOUT_ENCODER, aggregator=MixVprConfig(channels=8, rows=2, depth=1)
    )
    params, path = random_params(config), tmp_path / "w.safetensors"
    save_weights(path, Model(params, config))
    found, _ = load_weights(path, expected=dataclasses.replace(config, compute_dtype="bfloat16"))
    assert_equal(found, params)
    # As many patches, in another grid: every array would fit.
    turned = dataclasses.replace(config, image_size=(56, 42))
    with pytest.raises(InputError, match=r"another model: image_size: found .*42, 56.*56, 42"):
        load_weights(path, expected=turned)
    assert model_hash(params, turned) != model_hash(params, config)


def reseal(shared: pathlib.Path, path: pathlib.Path, value, change=None, form=weights.FORMAT):
    """The shared weights with other values in the metadata, where None leaves one out, and with
    changed arrays, and the checksum of all."""
    arrays = safetensors.numpy.load_file(shared / "weights.safetensors")
    if change is not None:
        change(arrays)
    with safetensors.safe_open(shared / "weights.safetensors", framework="numpy") as file:
        told = json.loads(file.metadata()[weights.FORMAT]) | value
    del told["checksum"]
    write_sealed(path, arrays, form, {k: each for k, each in told.items() if each is not None})


def test_a_file_of_another_format_is_refused(tmp_path, shared):
    """With a right checksum, too."""
    path = tmp_path / "w.safetensors"
    for form in ("crisalad-jax 3", "crisalad-jax 5", "crisalad-jax pca 2"):
        reseal(shared, path, {}, form=form)
        words = rf"found metadata \['{form}'\], expected .*'crisalad-jax 4'.*`crisalad convert`"
        with pytest.raises(InputError, match=f"^{path}: {words}"):
            load_weights(path)


SCORE, DUST = "aggregator.score.fc1.weight", "aggregator.dust_bin"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop(SCORE), [f"{SCORE} missing"]),
        (lambda a: a.update(extra=np.zeros(2)), ["extra unknown"]),
        (lambda a: a.update({SCORE: a[SCORE].T.copy()}), [SCORE, "(16, 32), expected", "(32, 16)"]),
        (lambda a: a.update({SCORE: a[SCORE].astype("f8")}), ["float64", "expected float32"]),
        (lambda a: a.update({DUST: np.float32(np.nan)[...]}), [f"{DUST} holds NaN or infinity"]),
    ],
)
def test_weights_that_do_not_fit_are_listed(tmp_path, shared, change, words):
    path = tmp_path / "w.safetensors"
    reseal(shared, path, {}, change)
    with pytest.raises(InputError, match=f"^{path}: weights do not fit: ") as error:
        load_weights(path)
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"config": None}, "found no config, expected config, version"),
        ({"parts": []}, r"found \[\], expected dict @ config.parts"),
        ({"model_sha256": 7}, "found 7, expected text @ config.model_sha256"),
        ({"config": {"cross_image": {"layers": 900}}}, "far from the sizes"),
        ({"config": {"backbone": {"name": "vit", "dim": 9 * 10**12}}}, "up to 9000000000000"),
    ],
)
def test_foreign_metadata_with_a_right_checksum_are_refused(tmp_path, shared, value, words):
    path = tmp_path / "w.safetensors"
    reseal(shared, path, value)
    with pytest.raises(InputError, match=words) as error:
        load_weights(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_no_file_or_another_one_is_refused(tmp_path):
    for path, what in ((tmp_path, "a folder"), (tmp_path / "none.safetensors", "no such file")):
        with pytest.raises(InputError, match=f"^{path}: found {what}, expected a .safetensors"):
            load_weights(path)


def test_the_hash_is_of_every_number(params):
    leaves, structure = jax.tree.flatten(params)
    for number in (0, len(leaves) - 1):
        changed = np.array(leaves[number])
        changed.flat[-1] = np.nextafter(changed.flat[-1], 2)
        others = jax.tree.unflatten(structure, [*leaves[:number], changed, *leaves[number + 1 :]])
        assert model_hash(others, MODEL) != model_hash(params, MODEL)


SINKHORN = dataclasses.replace(MODEL.aggregator.sinkhorn, tolerance=1e-3, gradient="stop")
CONVERGING = put(MODEL, "aggregator.sinkhorn", SINKHORN)
FREE = {
    "image_size": (84, 112),
    "compute_dtype": "bfloat16",
    "precision": "high",
    "remat": "full",
    "aggregator.dropout": 0.5,
    "cross_image.dropout": 0.5,
    "backbone.position_init": "sincos",
    "backbone.layer_scale_init": 0.5,
    "preprocessing.size_rule": "native",
    "preprocessing.filter": "bicubic",
    "preprocessing.antialias": False,
    "preprocessing.pixels": "floats",
    "preprocessing.round_to_patch": True,
    "preprocessing.bit_depth": "contrast-stretch",
}
"""How parameters start, dropout, rounding, and what a step keeps in memory do not matter."""
MATTERS = {
    "preprocessing.normalisation": "local-contrast",
    "preprocessing.mean": (0.5, 0.5, 0.5),
    "backbone.heads": 4,
    "backbone.adapter.alpha": 0.5,
    "aggregator.dustbin": "token",
    "aggregator.epsilon": 0.5,
    "aggregator.sinkhorn.step": "newton",
    "aggregator.sinkhorn.iterations": 4,
    "aggregator.sinkhorn.tolerance": 1e-4,
    "cross_image.heads": 4,
    "cross_image.global_token": False,
}


@pytest.mark.parametrize(("name", "value"), [*FREE.items(), *MATTERS.items()])
def test_the_hash_changes_with_every_field_that_matters(params, name, value):
    same = model_hash(params, put(CONVERGING, name, value)) == model_hash(params, CONVERGING)
    assert same == (name in FREE)


def test_the_hash_is_read_with_the_weights(shared, monkeypatch):
    """Nothing is digested."""
    path = shared / "weights.safetensors"
    expected = model_hash(*load_weights(path))
    monkeypatch.setattr(weights, "model_hash", None)
    assert weights.read_weights(path).digest == expected


@pytest.mark.parametrize(
    ("preset", "digest"),
    [
        ("tiny", "14c2411e0508572055d96423a7a372d4cfbc3094175e1118977eaab5b582673c"),
        ("s14", "56b7d28d5af7a2a29714aca2b61959ab116651154c39e5a4b9cd75168e572ca4"),
    ],
)
def test_digests_do_not_change_by_accident(preset, digest):
    """Over zeros; maps record them. They did change when encoders got names."""
    shapes = parameter_shapes(PRESETS[preset])
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    assert model_hash(zeros, PRESETS[preset]) == digest
