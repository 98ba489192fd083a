"""Weights there and back bit for bit, and files that are none of ours."""

import dataclasses
import json
import os
import pathlib
import struct

import jax
import numpy as np
import pytest
import safetensors.numpy

import crisalad_jax
from crisalad_jax.checkpoint import load_weights, model_hash, save_weights
from crisalad_jax.config import PRESETS, BoqConfig, MixVprConfig
from crisalad_jax.errors import InputError
from crisalad_jax.pytree import named_leaves
from crisalad_jax.serial import to_plain
from tests.conftest import MODEL, assert_equal, random_params

WITHOUT_ENCODER = dataclasses.replace(MODEL, encoder=dataclasses.replace(MODEL.encoder, layers=0))
REGISTERS = dataclasses.replace(
    MODEL, backbone=dataclasses.replace(MODEL.backbone, registers=4, ffn="swiglu")
)


@pytest.mark.parametrize("config", [MODEL, WITHOUT_ENCODER, REGISTERS])
def test_weights_survive_a_file_bit_for_bit(tmp_path, config):
    params = random_params(config)
    save_weights(tmp_path / "new" / "w.safetensors", params, config)
    assert os.listdir(tmp_path / "new") == ["w.safetensors"]
    found, found_config = load_weights(tmp_path / "new" / "w.safetensors")
    assert found_config == config
    assert_equal(found, params)


def test_the_package_offers_both(tmp_path, params):
    crisalad_jax.save(tmp_path / "w.safetensors", params, MODEL)
    found, config = crisalad_jax.load(str(tmp_path / "w.safetensors"))
    assert config == MODEL
    assert_equal(found, params)


def test_the_file_is_plain_safetensors_with_dotted_names(shared, params):
    """Read by the format's own description: a length, a JSON header, the bytes."""
    data = (shared / "weights.safetensors").read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    metadata = header.pop("__metadata__")
    assert json.loads(metadata["crisalad-jax 1"]) == to_plain(MODEL)
    assert header.keys() == named_leaves(params).keys()
    entry = header["aggregator.score.fc1.weight"]
    assert (entry["dtype"], entry["shape"]) == ("F32", [32, 16])
    start, end = entry["data_offsets"]
    values = np.frombuffer(data[8 + length + start : 8 + length + end], "<f4").reshape(32, 16)
    np.testing.assert_array_equal(values, params.aggregator.score.fc1.weight)


def test_the_same_weights_give_the_same_bytes(tmp_path, params):
    for name in ("a", "b", "c", "d"):
        save_weights(tmp_path / f"{name}.safetensors", params, MODEL)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


def test_only_what_parameters_do_not_depend_on_is_free(shared):
    path = shared / "weights.safetensors"
    other = dataclasses.replace(
        MODEL,
        image_size=(56, 70),
        compute_dtype="bfloat16",
        salad=dataclasses.replace(MODEL.salad, dropout=0.5),
        encoder=dataclasses.replace(MODEL.encoder, dropout=0.5),
    )
    load_weights(path, expected=other)
    with pytest.raises(InputError, match=f"^{path}: these weights are of another model: ") as error:
        load_weights(path, expected=PRESETS["tiny"])
    assert "backbone.dim: found 32, expected 128" in str(error.value)
    assert "salad.clusters: found 4, expected 16" in str(error.value)
    assert "image_size" not in str(error.value)


def test_parameters_of_one_image_size_keep_it(tmp_path):
    config = dataclasses.replace(
        WITHOUT_ENCODER, aggregator="mixvpr", mixvpr=MixVprConfig(channels=8, rows=2, depth=1)
    )
    params, path = random_params(config), tmp_path / "w.safetensors"
    save_weights(path, params, config)
    found, _ = load_weights(path, expected=dataclasses.replace(config, compute_dtype="bfloat16"))
    assert_equal(found, params)
    # As many patches, in another grid: every array would fit.
    turned = dataclasses.replace(config, image_size=(56, 42))
    with pytest.raises(InputError, match=r"another model: image_size: found .*42, 56.*56, 42"):
        load_weights(path, expected=turned)
    assert model_hash(params, turned) != model_hash(params, config)


def test_aggregators_that_a_model_does_not_have_are_free(shared):
    other = dataclasses.replace(MODEL, boq=BoqConfig(queries=8))
    params, config = load_weights(shared / "weights.safetensors", expected=other)
    assert model_hash(params, other) == model_hash(params, config)


def rewrite(shared: pathlib.Path, path: pathlib.Path, change, metadata=None) -> None:
    """The shared weights with changed arrays, or other metadata."""
    arrays = safetensors.numpy.load_file(shared / "weights.safetensors")
    change(arrays)
    ours = {"crisalad-jax 1": json.dumps(to_plain(MODEL))}
    safetensors.numpy.save_file(arrays, path, metadata=ours if metadata is None else metadata)


SCORE, DUST = "aggregator.score.fc1.weight", "aggregator.dust_bin"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop(SCORE), [f"{SCORE} missing"]),
        (lambda a: a.update(extra=np.zeros(2)), ["extra unknown"]),
        (lambda a: a.update({SCORE: a[SCORE].T.copy()}), [SCORE, "(16, 32), expected", "(32, 16)"]),
        (lambda a: a.update({SCORE: a[SCORE].astype("f8")}), ["float64", "expected float32"]),
        (lambda a: a.update({DUST: np.float32(np.nan)[...]}), [f"{DUST} holds NaN or infinity"]),
        (lambda a: (a.pop(SCORE), a.pop(DUST)), [f"{SCORE} missing", f"{DUST} missing"]),
        (lambda a: a.clear(), ["backbone.norm.bias missing"]),
    ],
)
def test_weights_that_do_not_fit_are_all_listed(tmp_path, shared, change, words):
    path = tmp_path / "w.safetensors"
    rewrite(shared, path, change)
    with pytest.raises(InputError, match=f"^{path}: weights do not fit: ") as error:
        load_weights(path)
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({}, r"found metadata \[\]"),
        ({"format": "pt"}, r"found metadata \['format'\]"),
        ({"crisalad-jax 1": ""}, "found no configuration in its metadata"),
        ({"crisalad-jax 1": "{"}, "found no configuration in its metadata"),
        ({"crisalad-jax 1": "[]"}, "found list"),
        ({"crisalad-jax 1": '{"clusters": 3}'}, "clusters"),
        ({"crisalad-jax 1": "[" * 10**5}, "found no configuration in its metadata"),
        ({"crisalad-jax 1": '{"encoder": {"layers": 99999999999}}'}, "of up to 99999999999"),
        ({"crisalad-jax 1": '{"encoder": {"layers": 900}}'}, "far from the sizes"),
        (
            {"crisalad-jax 1": '{"aggregator": "boq", "boq": {"layers": 900}}'},
            "far from the sizes",
        ),
        ({"crisalad-jax 1": '{"backbone": {"dim": 9000000000000}}'}, "of up to 9000000000000"),
    ],
)
def test_foreign_metadata_are_refused(tmp_path, shared, metadata, words):
    path = tmp_path / "w.safetensors"
    rewrite(shared, path, lambda arrays: None, metadata)
    with pytest.raises(InputError, match=words) as error:
        load_weights(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("length", [0, 5, 40, 5000, -1])
def test_a_file_cut_short_is_refused(tmp_path, shared, length):
    path = tmp_path / "w.safetensors"
    path.write_bytes((shared / "weights.safetensors").read_bytes()[:length])
    with pytest.raises(InputError, match=f"^{path}: not a whole safetensors file") as error:
        load_weights(path)
    assert "\n" not in str(error.value)


def test_no_file_or_another_one_is_refused(tmp_path):
    for path, what in ((tmp_path, "a folder"), (tmp_path / "none.safetensors", "no such file")):
        with pytest.raises(InputError, match=f"^{path}: found {what}, expected a .safetensors"):
            load_weights(path)
    (tmp_path / "w.safetensors").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(1000))
    with pytest.raises(InputError, match=r"w\.safetensors: not a whole safetensors file"):
        load_weights(tmp_path / "w.safetensors")


def test_the_hash_is_of_what_descriptors_are_a_function_of(shared):
    params, config = load_weights(shared / "weights.safetensors")
    found = model_hash(params, config)
    assert len(found) == 64
    assert model_hash(random_params(MODEL), MODEL) == found
    free = dataclasses.replace(
        config, image_size=(56, 56), compute_dtype="bfloat16", keeps="blocks"
    )
    free = dataclasses.replace(free, salad=dataclasses.replace(free.salad, dropout=0.0))
    assert model_hash(params, free) == found
    leaves, structure = jax.tree.flatten(params)
    for number in (0, len(leaves) // 2, len(leaves) - 1):
        changed = np.array(leaves[number])
        changed.flat[-1] = np.nextafter(changed.flat[-1], 2)
        others = jax.tree.unflatten(structure, [*leaves[:number], changed, *leaves[number + 1 :]])
        assert model_hash(others, config) != found
    sinkhorn = dataclasses.replace(config.salad.sinkhorn, iterations=4)
    salad = dataclasses.replace(config.salad, sinkhorn=sinkhorn)
    assert model_hash(params, dataclasses.replace(config, salad=salad)) != found
