"""What holds for every method of docs/methods.md, as a whole model."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from crisalad_jax.config.registry import make_part
from crisalad_jax.nn.aggregators import AGGREGATORS, Aggregator
from crisalad_jax.nn.aggregators.backbone_tokens import AggregationTokensConfig, ClassTokenConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.gem import ApGemConfig, CosPlaceConfig, GemConfig, GemPyramidConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.pair_vpr import PairVprConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig, EdtFormerConfig
from crisalad_jax.nn.aggregators.sage import SageConfig
from crisalad_jax.nn.aggregators.salad import FolConfig
from crisalad_jax.nn.aggregators.selavpr import SelaVprConfig
from crisalad_jax.nn.aggregators.selavprpp import SelaVprPpConfig, SelaVprPpHashConfig
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from crisalad_jax.nn.aggregators.vlad import (
    AnyLocConfig,
    NetVladConfig,
    SuperVladConfig,
    VladBuffConfig,
)
from crisalad_jax.nn.aggregators.words import BowConfig, HardVladConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.model import (
    Crisalad,
    attend_across_images,
    describe,
    extract_tokens,
    parameter_shapes,
    self_mask,
)
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, random_params
from tests.nn.conftest import slow_unless

SMALL = dataclasses.replace(
    MODEL,
    backbone=dataclasses.replace(MODEL.backbone, adapter="none"),
    cross_image="none",
)
PARTS: dict[str, Aggregator] = {
    "salad": MODEL.aggregator,
    "gem-pyramid": GemPyramidConfig(),
    "class-token": ClassTokenConfig(),
    "gem": GemConfig(),
    "netvlad": NetVladConfig(clusters=4),
    "conv-ap": ConvApConfig(channels=16),
    "cosplace": CosPlaceConfig(dim=16),
    "ap-gem": ApGemConfig(dim=16),
    "vlad": HardVladConfig(clusters=4),
    "bow": BowConfig(clusters=12),
    "mixvpr": MixVprConfig(channels=16, rows=2, depth=2),
    "anyloc": AnyLocConfig(clusters=4, layer=-1),
    "boq": BoqConfig(channels=16, queries=3, rows=2),
    "supervlad": SuperVladConfig(clusters=3),
    "transvpr": TransVprConfig(levels=2, dim=16),
    "edtformer": EdtFormerConfig(width=16, heads=2, queries=3, channels=16, rows=2),
    "aggregation-tokens": AggregationTokensConfig(tokens=3, insertion=1),
    "vlad-buff": VladBuffConfig(clusters=4, reduced=12),
    "selavpr": SelaVprConfig(hidden=8, local=4),
    "selavprpp": SelaVprPpConfig(dim=16),
    "selavprpp-hash": SelaVprPpHashConfig(dim=16, bits=24),
    "sage": SageConfig(clusters=4, cluster_dim=8, token_dim=16, hidden=16, weighting_hidden=8),
    "pair-vpr": PairVprConfig(dim=16, width=16, layers=2, hidden=8, positions=16),
    "fol": FolConfig(clusters=4, cluster_dim=8, token_dim=16, hidden=16, local_hidden=8, local=4),
}
RELATED = CrossImageConfig(layers=1, heads=2, feedforward=16, dropout=0.0)
# Float32 sums of one program, in another place of the batch.
TOLERANCE = 2e-6


def pictures(*seeds: int) -> np.ndarray:
    draws = [np.random.default_rng(seed).integers(0, 256, (42, 56, 3)) for seed in seeds]
    return np.stack(draws).astype(np.uint8)


def model(aggregator: str) -> tuple[Crisalad, ModelConfig]:
    backbone = SMALL.backbone
    if PARTS[aggregator].features(backbone.depth).path:
        adapter = make_part("adapter", "side-multi-resolution", paths=2)
        backbone = dataclasses.replace(backbone, adapter=adapter)
    config = dataclasses.replace(SMALL, backbone=backbone, aggregator=PARTS[aggregator])
    return random_params(config), config


def test_every_method_is_here() -> None:
    """But for those that tests register."""
    built_in = {n for n in AGGREGATORS if AGGREGATORS.find(n).__module__.startswith("crisalad")}
    assert built_in == PARTS.keys()
    assert all(PARTS[name].part_name == name for name in PARTS)


@pytest.mark.parametrize("aggregator", slow_unless(PARTS.keys() - {"gem-pyramid"}, PARTS))
def test_descriptors_of_every_method(aggregator: str) -> None:
    """Unit vectors that owe nothing to the batch; near the same in bfloat16."""
    params, config = model(aggregator)
    described = describe(params, pictures(0, 1, 2), config)
    assert described.shape == (3, config.descriptor_dim)
    assert described.dtype == jnp.float32
    np.testing.assert_allclose(jnp.linalg.norm(described, axis=1), 1, atol=1e-6)
    moved = describe(params, pictures(3, 4, 0), config)
    np.testing.assert_allclose(moved[2], described[0], atol=TOLERANCE)
    assert np.abs(described[1] - described[0]).max() > 100 * TOLERANCE

    half = describe(
        params, pictures(0, 1, 2), dataclasses.replace(config, compute_dtype="bfloat16")
    )
    assert half.dtype == jnp.float32
    np.testing.assert_allclose(jnp.linalg.norm(half, axis=1), 1, atol=1e-6)
    # 8 bits of mantissa through two blocks and a head: each rounding turns a vector by 2^-9.
    # Of a bag, one of 12 patches may move to another word.
    assert (half * described).sum(axis=1).min() > (0.9 if aggregator == "bow" else 0.999)
    assert np.abs(half - described).max() > 1e-5  # it did compute in bfloat16


# A method with a global token alone, and one without.
@pytest.mark.parametrize(
    "aggregator", slow_unless({"gem", "boq"}, sorted(PARTS.keys() - {"anyloc", "bow", "vlad"}))
)
def test_with_the_encoder_images_look_at_each_other(aggregator: str) -> None:
    """Tokens of every method that trains fit it; under `self_mask` it leaves them to themselves."""
    params, config = model(aggregator)
    config = dataclasses.replace(config, cross_image=RELATED)
    generator = np.random.default_rng(0)
    shape = config.token_shape
    encoder = RELATED.init(jax.random.key(0), shape.token_dim)
    params = dataclasses.replace(params, cross_image=encoder)
    tokens = jax.tree.map(
        lambda leaf: jnp.asarray(generator.normal(size=(3, *leaf.shape[1:])), jnp.float32),
        jax.eval_shape(functools.partial(extract_tokens, config=config), params, pictures(0)),
    )._replace(transport=None)
    assert tokens.global_token.shape == (3, shape.global_dim)
    assert tokens.local.shape == (3, shape.tokens, shape.token_dim)
    other = jax.tree.map(lambda leaf: leaf.at[2].add(1.0), tokens)

    among, changed = (attend_across_images(params, each, config) for each in (tokens, other))
    assert np.abs(among[0] - changed[0]).max() > 100 * TOLERANCE
    lonely, same = (
        attend_across_images(params, each, config, mask=self_mask(3)) for each in (tokens, other)
    )
    np.testing.assert_array_equal(lonely[0], same[0])
    np.testing.assert_allclose(jnp.linalg.norm(among, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("part", "width"), [(ConvApConfig(channels=100), 100), (BoqConfig(channels=72), 72)]
)
def test_tokens_that_do_not_fit_the_encoder(part: Aggregator, width: int) -> None:
    words = f"^CrossImageConfig.heads: found 16, expected a divisor of the {width} dimensions"
    with pytest.raises(InputError, match=words):
        ModelConfig(aggregator=part)
    bare = ModelConfig(aggregator=part, cross_image="none")
    assert bare.aggregator is part


def test_a_global_token_alone_cannot_stay_out_of_the_encoder() -> None:
    for aggregator in ("gem", "cosplace", "class-token"):
        with pytest.raises(InputError, match="global_token: found False, expected True, or"):
            ModelConfig(aggregator=aggregator, cross_image=CrossImageConfig(global_token=False))


def test_mixvpr_describes_images_of_its_own_size_alone() -> None:
    config = dataclasses.replace(SMALL, aggregator=PARTS["mixvpr"])
    params = parameter_shapes(config)
    # As many patches, and others.
    for size in ((56, 42), (84, 84)):
        words = (
            f"^image size: found {size[0]} x {size[1]}, expected 42 x 56: aggregator mixvpr has "
            "parameters for every patch, and was made for images of this size only"
        )
        with pytest.raises(InputError, match=words):
            config.check_image_size(size)
        images = jax.ShapeDtypeStruct((2, *size, 3), jnp.uint8)
        with pytest.raises(InputError, match=words):
            jax.eval_shape(lambda p, x: describe(p, x, config), params, images)
    for found in (43, 57), (42, 57):
        with pytest.raises(InputError, match="multiples of 14"):
            dataclasses.replace(config, image_size=found)
