"""What trains, by words and patterns: the names that it chooses, its cuts, and what is refused."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import crisalad_jax as cj
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.model import describe, parameter_shapes
from crisalad_jax.training.trainable import count_trainable, merge_params, split_params
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from tests.conftest import MODEL

DEEP = dataclasses.replace(
    MODEL, backbone=ViTConfig(dim=32, depth=12, heads=2, position_grid=3, registers=2)
)
BARE = dataclasses.replace(DEEP.backbone, adapter="none")
BARE = dataclasses.replace(DEEP, backbone=BARE)


def numbered(tree, whole) -> set[str]:
    """The names of a cut tree, with the number of the block in those of blocks, of a whole one."""
    leaves, names, starts = named_leaves(tree), set(), {}
    for name, leaf in named_leaves(whole).items():
        if match := re.fullmatch(r"backbone.blocks.(\d+).(.*)", name):
            starts.setdefault(int(match[1]), len(leaf))
    for name, leaf in leaves.items():
        if match := re.fullmatch(r"backbone.blocks.(?:(\d+)[.])?(.*)", name):
            begin = sum(starts.get(part, 0) for part in range(int(match[1] or 0)))
            names |= {f"backbone.blocks.{begin + i}.{match[2]}" for i in range(len(leaf))}
        else:
            names.add(name)
    return names


def split(config, trainable: str):
    return jax.eval_shape(lambda p: split_params(p, config, trainable), parameter_shapes(config))


EVERY = r"backbone[.]blocks[.]\d+[.]"
HEAD = "aggregator|cross_image"


@pytest.mark.parametrize(
    ("trainable", "expected", "parts"),
    [
        ("adapters,head", rf"{HEAD}|{EVERY}adapter", [1, 11]),
        ("adapters,head,backbone.blocks.1[01].*", rf"{HEAD}|{EVERY}adapter|.*s[.]1[01][.]", None),
        ("head,backbone.blocks.1[01]", rf"{HEAD}|.*blocks[.]1[01][.]", [10, 2]),
        ("head,backbone.blocks.1[01].adapter", rf"{HEAD}|.*s[.]1[01][.]adapter", [10, 1, 1]),
        ("head,-adapters,backbone.blocks.attn.qkv", rf"{HEAD}|{EVERY}attn[.]qkv", [1, 11]),
        ("head,adapters,backbone.blocks.3,", None, None),
        ("last-4-blocks,head", rf"{HEAD}|.*blocks[.]([89]|1[01])[.]", [8, 4]),
        ("last-12-blocks,head", rf"{HEAD}|{EVERY}", [12]),
        ("aggregator, cross_image ,-adapters", HEAD, [12]),
        ("all,-backbone.patch_embed", r"(?!backbone[.]patch_embed)", [12]),
        ("all,-backbone.blocks.[0-5]", r"(?!backbone[.]blocks[.][0-5][.])", [6, 6]),
        ("head,-adapters,norm,positions", rf"{HEAD}|backbone[.](norm|cls_|pos_)", [12]),
        ("backbone.*,head,-*.bias", r"(?!.*[.]bias$)", [1, 11]),
    ],
)
def test_patterns_choose_names_and_cut_blocks(trainable, expected, parts) -> None:
    """Expected is a regular expression over all names, each block's own."""
    if expected is None:
        with pytest.raises(InputError, match="trainable: found '', which matches no parameter"):
            split(DEEP, trainable)
        return
    chosen, frozen = split(DEEP, trainable)
    shapes, both = parameter_shapes(DEEP), eqx.combine(chosen, frozen)
    every = numbered(shapes, shapes)
    wanted = {name for name in every if re.match(expected, name)}
    assert numbered(chosen, both) == wanted
    assert wanted
    # The two trees are cut alike.
    assert numbered(chosen, both) | numbered(frozen, both) == every
    if parts is None:
        # The first block, for its adapter's gradient ends there; and the last ones.
        parts = [1, 9, 2]
    if parts != [12]:
        found = named_leaves((chosen, frozen))
        sizes = [
            next(len(x) for n, x in found.items() if f".blocks.{part}.mlp.fc1.weight" in n)
            for part in range(len(parts))
        ]
        assert sizes == parts
    else:
        assert not any(re.search(r"blocks[.]\d", name) for name in named_leaves(frozen))


def test_a_model_in_three_parts_is_the_same(params) -> None:
    backbone = ViTConfig(dim=32, depth=3, heads=2, position_grid=3)
    model = dataclasses.replace(MODEL, backbone=backbone)
    params = cj.init_crisalad(jax.random.key(0), model)
    pair = split_params(params, model, "head,-adapters,backbone.blocks.1.mlp")
    assert len(pair[1].backbone.blocks) == 3
    whole = merge_params(*pair, model)
    jax.tree.map(np.testing.assert_array_equal, whole, params)
    images = np.random.default_rng(0).integers(0, 256, (2, 42, 56, 3), dtype=np.uint8)
    cut = describe(eqx.combine(*pair), images, model)
    # The same sums of unit vectors, compiled in three loops and in one.
    np.testing.assert_allclose(cut, describe(params, images, model), atol=1e-6)


def test_batch_statistics_and_vocabularies_never_train() -> None:
    backbone = dataclasses.replace(DEEP.backbone, adapter="multi-resolution")
    chosen, frozen = split(dataclasses.replace(DEEP, backbone=backbone), "all")
    assert not [name for name in named_leaves(chosen) if "running" in name]
    assert all("running" in name for name in named_leaves(frozen))


@pytest.mark.parametrize(
    ("config", "trainable", "words"),
    [
        (DEEP, "tail", r"'tail', which matches no parameter of .*, expected all, head, .* pattern"),
        (DEEP, "adapter,head", r"'adapter', .* \(near: adapters"),
        (DEEP, "all,-backbone.block.3", r"near: backbone.blocks.3"),
        (DEEP, "adapters,head,backbone.blocks.12", "'backbone.blocks.12', which matches no"),
        (DEEP, "last-0-blocks,head", "found last-0-blocks, expected 1 to the backbone's 12 blocks"),
        (
            DEEP,
            "head",
            r"leaves backbone.blocks.\*.adapter as it was.*expected adapters too",
        ),
        (DEEP, "adapters", "leaves aggregator as it was at the start, expected aggregator too"),
        (DEEP, "adapters,aggregator", "leaves cross_image .* expected cross_image too, or -cross_"),
        (BARE, "adapters,head", "'adapters', which matches no parameter of backbone vit"),
    ],
)
def test_what_matches_nothing_or_leaves_a_part_out_is_refused(config, trainable, words) -> None:
    with pytest.raises(InputError, match=words) as caught:
        split(config, trainable)
    assert "\n" not in str(caught.value)


@cj.register_backbone("test-lora")
@dataclasses.dataclass(frozen=True)
class LowRank(cj.Backbone):
    """A frozen matrix with a low-rank update beside it."""

    depth: int = 1

    @property
    def trains(self):
        return ("lora",)

    def init(self, key):
        pixels = 3 * self.patch_size**2
        kernel = jax.random.normal(key, (pixels, self.dim))
        lora = {"a": jnp.ones((pixels, 2)), "b": jnp.zeros((2, self.dim))}
        return {"kernel": kernel, "lora": lora}

    def apply(self, params, images, request, *, remat, valid=None):
        raise NotImplementedError


def test_what_a_users_backbone_says_is_trained_or_refused() -> None:
    config = cj.recipe("b14", "crisalad+test-lora")
    assert config.trainable == "adapters,head"
    chosen, frozen = split(config.model, config.trainable)
    names = [name for name in named_leaves(chosen) if name.startswith("backbone")]
    assert names == ["backbone.lora.a", "backbone.lora.b"]
    assert list(named_leaves(frozen)) == ["backbone.kernel"]
    with pytest.raises(InputError, match=r"leaves backbone.lora as it was .* expected adapters"):
        split(config.model, "head")
    whole = count_trainable(config.model, "all")
    assert count_trainable(config.model, "all,-adapters") == whole - 2 * (3 * 14**2 + 768)
