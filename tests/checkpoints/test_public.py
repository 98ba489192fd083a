"""Public checkpoint files to ours and back, and files that are none."""

import collections
import dataclasses
import io
import json
import os
import pathlib
import zipfile
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.numpy
import safetensors.torch
import torch

from crisalad_jax.checkpoints.formats import public_shapes, to_state
from crisalad_jax.checkpoints.public import (
    Checkpoint,
    convert,
    read_backbone,
    read_checkpoint,
    write_checkpoint,
)
from crisalad_jax.checkpoints.safetensors_io import write_safetensors
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Model, describe, init_crisalad, self_mask
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from tests.checkpoints.test_weights import put
from tests.conftest import MODEL, assert_equal, random_params
from tests.random_checkpoints import (
    UNDER,
    bare_vit,
    fewer_blocks,
    narrow,
    nested,
    public_layout,
    random_state,
    same_bits,
    save,
)

SMALL = {
    name: fewer_blocks(narrow(public_layout(source), by), 2)
    for name, source, by in (
        ("dinov2", "dinov2_vitb14", 12),
        ("registers", "dinov2_vitb14_reg4", 12),
        ("dino-salad", "dino_salad", 12),
        ("cricavpr", "CricaVPR", 4),
    )
}
SUFFIX = {"dino-salad": ".ckpt"}
WIDTHS = {"dinov2": 64, "registers": 64, "dino-salad": 256 + 64 * 128, "cricavpr": 14 * 192}
HUGGING_FACE = bare_vit()


def written(folder: pathlib.Path, name: str) -> pathlib.Path:
    return save(folder / f"public{SUFFIX.get(name, '.pth')}", nested(random_state(SMALL[name])))


def hugging_face(path: pathlib.Path) -> pathlib.Path:
    return save(path, random_state(public_shapes(HUGGING_FACE, "huggingface")))


def state_of(found: Checkpoint) -> dict[str, torch.Tensor]:
    """The tensors of a model by the names of its file."""
    state = to_state(found.params, found.config, found.format, found.extras)
    return {name: torch.tensor(array) for name, array in state.items()}


def files(folder: pathlib.Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def with_values(config: ModelConfig, values: dict[str, Any]) -> ModelConfig:
    for name, value in values.items():
        config = put(config, name, value)
    return config


def pictures(config: ModelConfig, count: int = 2) -> np.ndarray:
    generator = np.random.default_rng(0)
    return generator.integers(0, 256, (count, *config.image_size, 3), dtype=np.uint8)


def there_and_back(folder: pathlib.Path, source: pathlib.Path, width: int) -> None:
    """To our file, describe, and to a public file of the very bytes."""
    ours, back = folder / "ours.safetensors", folder / f"back{source.suffix}"
    convert(source, ours)
    params, config = load_weights(ours)
    descriptors = describe(params, pictures(config), config, mask=self_mask(2))
    assert descriptors.shape == (2, width)
    # float32 rounding of a sum of thousands of squares.
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-5)
    convert(ours, back)
    assert same_bits(torch.load(back), torch.load(source))
    assert back.read_bytes() == source.read_bytes()


@pytest.mark.parametrize("name", SMALL)
def test_there_and_back_are_the_same_bytes(tmp_path: pathlib.Path, name: str) -> None:
    there_and_back(tmp_path, written(tmp_path, name), WIDTHS[name])


def test_indoor_vprs_file_is_the_same_network_within_a_module(tmp_path: pathlib.Path) -> None:
    state, format = random_state(SMALL["dino-salad"]), "salad-indoor"
    outside = read_checkpoint(save(tmp_path / "plain.pth", state))
    within = save(tmp_path / "within.pth", {f"model.{name}": x for name, x in state.items()})
    inside = read_checkpoint(within)
    assert inside.format == format
    assert_equal(inside.params, outside.params)
    convert(within, tmp_path / "ours.safetensors")
    convert(tmp_path / "ours.safetensors", tmp_path / "back.pth", format)
    assert (tmp_path / "back.pth").read_bytes() == within.read_bytes()


@pytest.mark.parametrize(("registers", "ffn"), [(0, "mlp"), (4, "swiglu")])
def test_hugging_face_there_and_back(tmp_path: pathlib.Path, registers: int, ffn) -> None:
    backbone = dataclasses.replace(HUGGING_FACE.backbone, registers=registers, ffn=ffn)
    config = dataclasses.replace(HUGGING_FACE, backbone=backbone)
    state = random_state(public_shapes(config, "huggingface"))
    source = save(tmp_path / "model.safetensors", state)
    ours, back = tmp_path / "ours.safetensors", tmp_path / "back.safetensors"
    assert convert(source, ours).config == config
    convert(ours, back)
    assert back.read_bytes() == source.read_bytes()
    assert back.stat().st_mode & 0o777 == 0o644  # the library's own would be 0600
    # By way of the other layout for the same model.
    convert(ours, tmp_path / "dinov2.pth", "dinov2")
    again = read_checkpoint(tmp_path / "dinov2.pth")
    assert again.format == "dinov2"
    theirs = to_state(again.params, again.config, "huggingface", again.extras)
    assert all(theirs[name].tobytes() == array.numpy().tobytes() for name, array in state.items())


def test_weights_have_the_rights_of_any_new_file(tmp_path: pathlib.Path) -> None:
    before = os.umask(0o077)
    try:
        write_safetensors(tmp_path / "a.safetensors", {"a": np.zeros(3)}, {})
        (tmp_path / "other").touch()
    finally:
        os.umask(before)
    assert [path.stat().st_mode & 0o777 for path in tmp_path.iterdir()] == [0o600, 0o600]


@pytest.mark.parametrize(
    ("layout", "changed", "words"),
    [
        ("dino-salad", {"aggregator.sinkhorn.iterations": 10}, "iterations: found 3, expected 10"),
        ("dinov2", {"backbone.heads": 2}, "backbone.heads: found 1, expected 2"),
        ("cricavpr", {"backbone.adapter.alpha": 0.5}, "alpha: found 0.2, expected 0.5"),
    ],
)
def test_what_a_layout_cannot_tell_goes_to_the_reference(
    tmp_path: pathlib.Path, layout: str, changed: dict, words: str
) -> None:
    """Else the way back would give another model, with other descriptors."""
    public = read_checkpoint(written(tmp_path, layout))
    config = with_values(public.config, changed)
    ours, back = tmp_path / "ours.safetensors", tmp_path / "back.pth"
    save_weights(ours, Model(public.params, config), extras=public.extras)
    with pytest.raises(InputError, match=f"^format {layout}: cannot store settings .*{words}"):
        convert(ours, back, layout)
    assert not back.exists()
    assert convert(ours, back).target == "reference"
    assert read_checkpoint(back).config == config


@pytest.mark.parametrize("layout", ["dino-salad", "cricavpr", "huggingface", "reference"])
def test_what_no_description_depends_on_comes_back(tmp_path: pathlib.Path, layout: str) -> None:
    """In the metadata of the state, which no other program minds: names are as published."""
    suffix = {"dino-salad": ".ckpt", "huggingface": ".safetensors"}.get(layout, ".pth")
    source = tmp_path / f"public{suffix}"
    if layout == "huggingface":
        hugging_face(source)
    elif layout == "reference":
        write_checkpoint(source, random_params(MODEL), MODEL, layout, {})
    else:
        source = written(tmp_path, layout)
    public = read_checkpoint(source)
    changes = {
        "image_size": (126, 140),
        "compute_dtype": "bfloat16",
        "precision": "high",
        "remat": "none",
        "backbone.layer_scale_init": 1e-5,
        "preprocessing.filter": "bicubic",
        **({"cross_image.dropout": 0.2} if public.config.cross_image.attends else {}),
        **({"aggregator.dropout": 0.1} if layout == "dino-salad" else {}),
    }
    config = with_values(public.config, changes)
    ours, back = tmp_path / "ours.safetensors", tmp_path / f"back{suffix}"
    save_weights(ours, Model(public.params, config), extras=public.extras)
    assert convert(ours, back, layout).target == layout
    convert(back, tmp_path / "again.safetensors")
    params, again = load_weights(tmp_path / "again.safetensors")
    assert again == config
    assert_equal(params, public.params)
    if suffix == ".safetensors":
        content, whole = map(safetensors.numpy.load_file, (back, source))
        assert all(content[name].tobytes() == array.tobytes() for name, array in whole.items())
    else:
        assert same_bits(torch.load(back), torch.load(source))


def test_the_source_is_never_written_over(tmp_path: pathlib.Path) -> None:
    source = hugging_face(tmp_path / "model.safetensors")
    before = source.read_bytes()
    (tmp_path / "link.safetensors").symlink_to(source)
    for target in (source, tmp_path / "link.safetensors"):
        with pytest.raises(InputError, match=f"^{target}: found the source itself"):
            convert(source, target)
    assert source.read_bytes() == before


@pytest.mark.parametrize("core", ["numpy._core", "numpy.core"])
def test_numpys_records_beside_the_weights_are_not_read(tmp_path: pathlib.Path, core: str) -> None:
    """As CricaVPR's code and those that began from it save them; NumPy 1 has the second name."""
    content = nested(random_state(SMALL["cricavpr"]))
    content |= {"recalls": np.array([90.5, 97.1]), "best_r5": np.float64(97.1), "n": np.int64(3)}
    path = tmp_path / "file.pth"
    path.write_bytes(whole(content, new=False).replace(b"numpy._core", core.encode()))
    state = {key.removeprefix("module."): x for key, x in content[UNDER[:-1]].items()}
    assert same_bits(state_of(read_checkpoint(path)), state)


@pytest.mark.parametrize(
    ("dtype", "suffix"), [(torch.float16, ".pth"), (torch.bfloat16, ".safetensors")]
)
def test_half_precision_is_widened_exactly(tmp_path: pathlib.Path, dtype, suffix: str) -> None:
    shapes = SMALL["dinov2"] if suffix == ".pth" else public_shapes(HUGGING_FACE, "huggingface")
    state = {name: tensor.to(dtype) for name, tensor in random_state(shapes).items()}
    found = state_of(read_checkpoint(save(tmp_path / f"half{suffix}", state)))
    assert same_bits(found, {name: tensor.float() for name, tensor in state.items()})


# A backbone to start from


def fresh(adapter: str, **fields) -> tuple[ModelConfig, object]:
    backbone = dataclasses.replace(HUGGING_FACE.backbone, adapter=adapter, **fields)
    config = ModelConfig(backbone=backbone)
    return config, init_crisalad(jax.random.key(1), config).backbone


@pytest.mark.parametrize("kind", ["huggingface", "dino-salad", "ours"])
def test_a_backbone_of_any_file(tmp_path: pathlib.Path, kind: str) -> None:
    if kind == "huggingface":
        source = hugging_face(tmp_path / "model.safetensors")
    else:
        source = written(tmp_path, "dinov2" if kind == "ours" else kind)
    theirs = read_checkpoint(source)
    if kind == "ours":
        source = tmp_path / "ours.safetensors"
        save_weights(source, theirs.model, extras=theirs.extras)
    config, start = fresh("depthwise")
    wanted = named_leaves(theirs.params.backbone)
    for name, leaf in named_leaves(read_backbone(source, config.backbone, start)).items():
        adapter = ".adapter." in name
        np.testing.assert_array_equal(leaf, named_leaves(start)[name] if adapter else wanted[name])


@pytest.mark.parametrize("kind", ["multi-resolution", "depthwise"])
def test_adapters_come_along_where_they_are_the_same(tmp_path: pathlib.Path, kind: str) -> None:
    source = written(tmp_path, "cricavpr")
    config, start = fresh(kind, dim=192, heads=3)
    found = named_leaves(read_backbone(source, config.backbone, start))
    wanted = named_leaves(read_checkpoint(source).params.backbone)
    name = "blocks.adapter.down.weight"
    same = kind == "multi-resolution"
    np.testing.assert_array_equal(found[name], wanted[name] if same else named_leaves(start)[name])


def test_another_backbone_is_refused(tmp_path: pathlib.Path) -> None:
    source = written(tmp_path, "dinov2")
    model, start = fresh("depthwise", depth=3, registers=4)
    words = "the model.s: backbone.depth: found 2, exp.* backbone.registers: found 0"
    with pytest.raises(InputError, match=f"{source}: this backbone differs from {words}"):
        read_backbone(source, model.backbone, start)


# Bad files


class Opens:
    """What an attacker puts into a pickle: loading it runs a call."""

    def __init__(self, path: pathlib.Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def declaring(state: dict, text: str) -> dict:
    """A state that says what it is, as we write it."""
    state = collections.OrderedDict(state)
    state._metadata = {"crisalad-jax": text}  # type: ignore[attr-defined]
    return state


def small(**changes: Any) -> dict[str, Any]:
    """A DINOv2 of two blocks with other values under some names, whose dots are underscores."""
    state = random_state(SMALL["dinov2"])
    return state | {name.replace("norm_", "norm."): value for name, value in changes.items()}


def whole(state: Any, *, new: bool = True) -> bytes:
    data = io.BytesIO()
    torch.save(state, data, _use_new_zipfile_serialization=new)
    return data.getvalue()


BIAS = random_state(SMALL["dinov2"])["norm.bias"]
DEEP = {"backbone": {"name": "vit", "depth": 10**9}}
DECLARED = json.dumps({"format": "reference", "config": DEEP, "aggregator": {}})
COUNT = next(name for name in SMALL["cricavpr"] if name.endswith("num_batches_tracked"))
BAD: dict[str, tuple[Callable[[], Any], str]] = {
    "cut": (lambda: whole(small())[:9999], "not a whole torch checkpoint: "),
    "old, cut": (lambda: whole(small(), new=False)[:338], "not a whole torch checkpoint"),
    "a number for a name": (lambda: {**small(), 3: BIAS}, "found 3, expected nothing but"),
    "double": (
        lambda: small(norm_bias=BIAS.double()),
        "norm.bias found float64, expected float32 or float16 or bfloat16",
    ),
    "nan": (lambda: small(norm_bias=BIAS * float("nan")), "norm.bias holds NaN or inf"),
    "sparse": (
        lambda: small(norm_bias=BIAS.to_sparse()),
        "norm.bias is not a plain tensor: .*Sparse",
    ),
    "a float count": (
        lambda: nested(random_state(SMALL["cricavpr"]) | {COUNT: torch.zeros(())}),
        "num_batches_tracked found float32, expected int64",
    ),
    "a depth for an age": (
        lambda: {"state_dict": declaring(small(), DECLARED)},
        "found 35 arrays, far from the sizes .* up to 1000000000$",
    ),
    "a deep configuration": (
        lambda: {"state_dict": declaring(small(), "[" * 10**5)},
        "found no JSON .nested too deep",
    ),
    "code": (
        lambda: small(norm_weight=Opens(pathlib.Path("made"))),
        "refused: it asks for [a-z]+.mkdir, expected nothing but tenso",
    ),
    "old, code": (
        lambda: whole(Opens(pathlib.Path("made")), new=False),
        "refused: it asks for [a-z]+.mkdir, expected nothing but tenso",
    ),
    "safetensors: eight bits": (
        lambda: safetensors.torch.save({"layernorm.bias": BIAS.to(torch.float8_e4m3fn)}),
        "found a type that numpy does not know: .*float8",
    ),
}


def refused(source: pathlib.Path, words: str) -> None:
    """One clear line; nothing is written, nor has any code of the file made its folder."""
    before = files(source.parent)
    with pytest.raises(InputError, match=words) as caught:
        convert(source, source.parent / "new" / "ours.safetensors")
    assert str(caught.value).startswith(str(source))
    assert "\n" not in str(caught.value)
    assert files(source.parent) == before


@pytest.mark.parametrize("kind", BAD)
def test_a_file_that_is_no_model(tmp_path: pathlib.Path, monkeypatch, kind: str) -> None:
    monkeypatch.chdir(tmp_path)  # where an attack would make its folder
    make, words = BAD[kind]
    suffix = ".safetensors" if kind.startswith("safetensors") else ".pth"
    content, path = make(), tmp_path / f"file{suffix}"
    path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
    refused(path, words)


def test_targets_and_layouts_that_do_not_fit(tmp_path: pathlib.Path) -> None:
    public, ours = written(tmp_path, "dino-salad"), tmp_path / "ours.safetensors"
    convert(public, ours)
    for target, layout, words in (
        ("x.onnx", None, "x.onnx: found suffix '.onnx', expected .pth or .pt or .ckpt$"),
        ("x" * 300 + ".pth", None, "too long"),
        ("x.pth", "huggingface", "x.pth: found suffix '.pth', expected .safetensors$"),
    ):
        with pytest.raises(InputError, match=words):
            convert(ours, tmp_path / target, layout)
    assert files(tmp_path) == {"public.ckpt", "ours.safetensors"}
    long = tmp_path / f"{'x' * 245}.ckpt"  # the temporary name beside it must not be longer
    convert(ours, long)
    assert long.read_bytes() == public.read_bytes()


def test_an_archive_that_unpacks_to_more_than_its_size_is_not_read(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "bomb.pth"
    torch.save({"cls_token": torch.zeros(2**20)}, tmp_path / "whole.pth")
    with (
        zipfile.ZipFile(tmp_path / "whole.pth") as whole,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bomb,
    ):
        for each in whole.infolist():
            bomb.writestr(each.filename, whole.read(each))
    words = r"bomb\.pth: found an archive of \d+ bytes that unpacks to 419\d+, expected a torch"
    with pytest.raises(InputError, match=words):
        read_checkpoint(path)
