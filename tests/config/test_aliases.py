"""Configurations that version 0.1 wrote load into those of today, every setting in its place.

`OLD` is what version 0.1 wrote of a configuration with no setting at its default; with another
aggregator or loss it wrote the same, but for the name.
"""

import copy
import dataclasses
import json
import pathlib
from typing import Any

import pytest

from crisalad_jax.config.aliases import is_of_an_earlier_version
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.config.io import from_plain, read_config, to_plain
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.data.augmentations import Augmentation, NoAugmentation
from crisalad_jax.data.augmentations.light import LightAugmentConfig
from crisalad_jax.data.augmentations.rand_augment import RandAugmentConfig
from crisalad_jax.losses import LOSSES, Loss, LossConfig
from crisalad_jax.losses.circle import CircleConfig
from crisalad_jax.losses.contrastive import ContrastiveConfig
from crisalad_jax.losses.fast_ap import FastAPConfig
from crisalad_jax.losses.large_margin_cosine import LargeMarginCosineConfig
from crisalad_jax.losses.multi_similarity import MultiSimilarityConfig
from crisalad_jax.losses.supcon import SupConConfig
from crisalad_jax.losses.triplet import TripletConfig
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators import AGGREGATORS, Aggregator
from crisalad_jax.nn.aggregators.anyloc import AnyLocConfig
from crisalad_jax.nn.aggregators.boq import BoqConfig
from crisalad_jax.nn.aggregators.class_token import ClassTokenConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.cosplace import CosPlaceConfig
from crisalad_jax.nn.aggregators.gem import GemConfig
from crisalad_jax.nn.aggregators.gem_pyramid import GemPyramidConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.netvlad import NetVladConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.sinkhorn import DUSTBINS, GRADIENTS, STEPS, SinkhornConfig, SinkhornStep
from crisalad_jax.training.config import OptimiserConfig, TrainConfig

OLD: dict[str, Any] = json.loads("""
{"model": {"image_size": [70, 98], "normalisation": "local-contrast",
  "backbone": {"dim": 64, "depth": 4, "heads": 2, "mlp_ratio": 2.0, "ffn": "swiglu",
    "registers": 4, "position_grid": 7, "position_start": "sincos", "layer_scale_start": 0.1,
    "adapter": {"kind": "mlp", "bottleneck": 0.25, "kernel_size": 5, "alpha": 0.3}},
  "aggregator": "salad",
  "salad": {"clusters": 8, "cluster_dim": 16, "token_dim": 32, "hidden": 24, "dropout": 0.2,
    "sinkhorn": {"method": "sinkhorn", "dustbin": "token", "epsilon": 0.5, "iterations": 40,
      "tolerance": 0.001, "must_converge": true, "domain": "log", "relaxation": 1.5, "anderson": 3,
      "row_tau": 0.9, "column_tau": 0.8, "gradient": "implicit"}},
  "gem_pyramid": {}, "class_token": {}, "gem": {}, "netvlad": {"clusters": 6},
  "conv_ap": {"channels": 96, "side": 3}, "cosplace": {"dim": 48},
  "mixvpr": {"channels": 80, "rows": 2, "depth": 3},
  "anyloc": {"clusters": 10, "layer": -2, "facet": "key"},
  "boq": {"channels": 128, "queries": 12, "layers": 3, "rows": 5},
  "transvpr": {"levels": 2, "dim": 40},
  "encoder": {"layers": 0, "heads": 4, "feedforward": 256, "dropout": 0.05, "global_token": false},
  "compute_dtype": "bfloat16", "keeps": "blocks"},
"loss": {"kind": "triplet", "miner": "none", "epsilon": 0.2, "library_quirk": true,
  "multi_similarity": {"alpha": 2.0, "beta": 40.0, "base": 0.5},
  "contrastive": {"positive_margin": 0.1, "negative_margin": 0.9},
  "triplet": {"margin": 0.2}, "circle": {"margin": 0.3, "scale": 60.0},
  "supcon": {"temperature": 0.1}, "fast_ap": {"bins": 20},
  "large_margin_cosine": {"scale": 100.0, "margin": 0.3, "learning_rate": 0.02,
    "classes": "viewpoints", "groups": 9, "steps": 500, "cell": 15.0, "sector": 60.0, "spacing": 3,
    "sector_spacing": 3, "focal_distance": 20.0, "view_angle": 30.0}},
"optimiser": {"kind": "adam", "learning_rate": 0.001, "schedule": "step", "final_fraction": 0.1,
  "decay_steps": 700, "drop_epochs": 2, "drop_factor": 0.4, "warmup_steps": 30,
  "weight_decay": 0.05, "b1": 0.8, "b2": 0.99, "clip_norm": 1.0},
"trains": "last-2-blocks+head", "augment": "light",
"rand_augment": {"operations": 2, "magnitude": 15},
"light_augment": {"crop": 0.2, "shift": 0.1, "rotation": 3.0, "flip": 0.5, "blur": 2.0,
  "colour": 0.3, "grey": 0.1, "gamma": 0.4, "illumination": 0.6},
"places_per_batch": 12, "images_per_place": 2, "micro_batch": 6, "min_images": 3,
"batch_order": "shuffled", "cities": ["Aston", "Brill"], "epochs": 5, "validate_every": 2,
"patience": 4, "keep_best": 3, "seed": 7}
""")
SALAD = SaladConfig(
    clusters=8,
    cluster_dim=16,
    token_dim=32,
    hidden=24,
    dropout=0.2,
    dustbin="token",
    epsilon=0.5,
    row_tau=0.9,
    column_tau=0.8,
    sinkhorn=SinkhornConfig(
        step=SinkhornStep(relaxation=1.5),
        iterations=40,
        tolerance=1e-3,
        throw=True,
        domain="log",
        anderson_memory=3,
        gradient="implicit",
    ),
)
MODEL = ModelConfig(
    image_size=(70, 98),
    preprocessing=PreprocessingConfig(normalisation="local-contrast"),
    backbone=ViTConfig(
        dim=64,
        depth=4,
        heads=2,
        mlp_ratio=2.0,
        ffn="swiglu",
        registers=4,
        position_grid=7,
        position_init="sincos",
        layer_scale_init=0.1,
        adapter=AdapterConfig(kind="mlp", bottleneck=0.25, kernel_size=5, alpha=0.3),
    ),
    aggregator=SALAD,
    cross_image=CrossImageConfig(
        layers=0, heads=4, feedforward=256, dropout=0.05, global_token=False
    ),
    compute_dtype="bfloat16",
    remat="full",
)
LIGHT = LightAugmentConfig(
    crop=0.2,
    shift=0.1,
    rotation=3.0,
    flip=0.5,
    blur=2.0,
    colour=0.3,
    grey=0.1,
    gamma=0.4,
    illumination=0.6,
)
TRAIN = TrainConfig(
    model=MODEL,
    loss=LossConfig(
        kind=TripletConfig(margin=0.2), miner="none", miner_margin=0.2, match_pml_zero=True
    ),
    optimiser=OptimiserConfig(
        kind="adam",
        learning_rate=1e-3,
        schedule="step",
        end_lr_fraction=0.1,
        decay_steps=700,
        step_epochs=2,
        step_gamma=0.4,
        warmup_steps=30,
        weight_decay=0.05,
        b1=0.8,
        b2=0.99,
        clip_norm=1.0,
    ),
    trainable="last-2-blocks+head",
    augmentation=LIGHT,
    places_per_batch=12,
    images_per_place=2,
    micro_batch=6,
    min_images=3,
    batch_order="shuffled",
    cities=("Aston", "Brill"),
    epochs=5,
    validate_every=2,
    patience=4,
    keep_best=3,
    seed=7,
)


def old(place: str, value: Any, **others: Any) -> dict[str, Any]:
    """Return what version 0.1 wrote, with other values at a place and beside it."""
    plain = copy.deepcopy(OLD)
    *way, last = place.split(".")
    there = plain
    for name in way:
        there = there[name]
    assert last in there
    assert others.keys() <= there.keys()
    there.update({last: value, **others})
    return plain


def test_a_whole_run_of_version_0_1(tmp_path: pathlib.Path):
    path = tmp_path / "config.json"
    path.write_text(json.dumps(OLD))
    found = read_config(TrainConfig, path)
    assert found == TRAIN
    assert hash(found) == hash(TRAIN)
    assert from_plain(ModelConfig, OLD["model"], source="here") == MODEL
    # Read again from today's names it is the same.
    assert from_plain(TrainConfig, to_plain(found), source="here") == TRAIN


def test_reading_leaves_the_plain_values_as_they_are():
    plain = copy.deepcopy(OLD)
    from_plain(TrainConfig, plain, source="here")
    assert plain == OLD


AGGREGATORS_OF_OLD: dict[str, Aggregator] = {
    "salad": SALAD,
    "gem-pyramid": GemPyramidConfig(),
    "class-token": ClassTokenConfig(),
    "gem": GemConfig(),
    "netvlad": NetVladConfig(clusters=6),
    "conv-ap": ConvApConfig(channels=96, side=3),
    "cosplace": CosPlaceConfig(dim=48),
    "mixvpr": MixVprConfig(channels=80, rows=2, depth=3),
    "anyloc": AnyLocConfig(clusters=10, layer=-2, facet="key", assignment="euclidean"),
    "boq": BoqConfig(channels=128, queries=12, layers=3, rows=5, last_norm=True),
    "transvpr": TransVprConfig(levels=2, dim=40),
}


@pytest.mark.parametrize("name", AGGREGATORS_OF_OLD)
def test_every_aggregator_of_version_0_1(name: str):
    model = dataclasses.replace(MODEL, aggregator=AGGREGATORS_OF_OLD[name])
    found = from_plain(TrainConfig, old("model.aggregator", name), source="here")
    assert found == dataclasses.replace(TRAIN, model=model)
    assert found.model.aggregator.part_name == name


def test_all_aggregators_and_losses_of_version_0_1_are_there():
    assert len(AGGREGATORS_OF_OLD) == 11
    assert set(AGGREGATORS_OF_OLD) <= set(AGGREGATORS)
    assert {name.replace("-", "_") for name in AGGREGATORS_OF_OLD} <= OLD["model"].keys()
    assert len(LOSSES_OF_OLD) == 7
    assert set(LOSSES_OF_OLD) <= set(LOSSES)
    assert {name.replace("-", "_") for name in LOSSES_OF_OLD} <= OLD["loss"].keys()


CLASSES = ClassesConfig(
    kind="viewpoints",
    groups=9,
    steps=500,
    cell=15.0,
    sector=60.0,
    spacing=3,
    sector_spacing=3,
    focal_distance=20.0,
    view_angle=30.0,
)
LOSSES_OF_OLD: dict[str, Loss] = {
    "multi-similarity": MultiSimilarityConfig(alpha=2.0, beta=40.0, base=0.5),
    "contrastive": ContrastiveConfig(positive_margin=0.1, negative_margin=0.9),
    "triplet": TripletConfig(margin=0.2),
    "circle": CircleConfig(margin=0.3, scale=60.0),
    "supcon": SupConConfig(temperature=0.1),
    "fast-ap": FastAPConfig(bins=20),
    "large-margin-cosine": LargeMarginCosineConfig(
        scale=100.0, margin=0.3, learning_rate=0.02, classes=CLASSES
    ),
}


@pytest.mark.parametrize("name", LOSSES_OF_OLD)
def test_every_loss_of_version_0_1(name: str):
    loss = dataclasses.replace(TRAIN.loss, kind=LOSSES_OF_OLD[name])
    found = from_plain(TrainConfig, old("loss.kind", name), source="here")
    assert found == dataclasses.replace(TRAIN, loss=loss)
    assert found.loss.kind.part_name == name


@pytest.mark.parametrize(
    ("name", "augmentation"),
    [
        ("rand-augment", RandAugmentConfig(operations=2, magnitude=15)),
        ("light", LIGHT),
        ("none", NoAugmentation()),
    ],
)
def test_every_augmentation_of_version_0_1(name: str, augmentation: Augmentation):
    found = from_plain(TrainConfig, old("augment", name), source="here")
    assert found == dataclasses.replace(TRAIN, augmentation=augmentation)


@pytest.mark.parametrize(
    ("keeps", "remat"), [("products", "dots"), ("blocks", "full"), ("everything", "none")]
)
def test_what_steps_of_version_0_1_kept_in_memory(keeps: str, remat: str):
    found = from_plain(TrainConfig, old("model.keeps", keeps), source="here")
    assert found.model == dataclasses.replace(MODEL, remat=remat)


@pytest.mark.parametrize("name", ["none", "column", "row and column", "token", "mass"])
def test_every_dustbin_of_version_0_1(name: str):
    found = from_plain(TrainConfig, old("model.salad.sinkhorn.dustbin", name), source="here")
    assert found.model.aggregator == dataclasses.replace(SALAD, dustbin=name)
    assert found.model.aggregator.dustbin == DUSTBINS.make(name)


# What version 0.1 let go together.
PLAIN = {"relaxation": 1.0, "anderson": 0, "row_tau": 1.0, "column_tau": 1.0}
AT_ONCE = {**PLAIN, "tolerance": None, "must_converge": False, "gradient": "unrolled"}
METHODS: dict[str, dict[str, Any]] = {
    "newton": {**PLAIN, "gradient": "stop"},
    "softmax": AT_ONCE,
    "dual-softmax": AT_ONCE,
}


@pytest.mark.parametrize("name", METHODS)
def test_every_other_method_of_version_0_1(name: str):
    plain = old("model.salad.sinkhorn.method", name, **METHODS[name])
    salad = from_plain(TrainConfig, plain, source="here").model.aggregator
    at_once = METHODS[name] is AT_ONCE
    sinkhorn = SinkhornConfig(
        step=name,
        iterations=40,
        tolerance=None if at_once else 1e-3,
        throw=not at_once,
        domain="log",
        anderson_memory=0,
        gradient="unrolled" if at_once else "stop",
    )
    assert salad == dataclasses.replace(SALAD, row_tau=1.0, column_tau=1.0, sinkhorn=sinkhorn)
    assert salad.sinkhorn.step == STEPS.make(name)


@pytest.mark.parametrize(
    ("name", "others", "changes"),
    [
        ("implicit", {}, {}),
        ("stop", {}, {}),
        ("optimistix", {"anderson": 0}, {"anderson_memory": 0}),
        (
            "unrolled",
            {"tolerance": None, "must_converge": False},
            {"tolerance": None, "throw": False},
        ),
    ],
)
def test_every_gradient_of_version_0_1(name: str, others: dict, changes: dict):
    plain = old("model.salad.sinkhorn.gradient", name, **others)
    salad = from_plain(TrainConfig, plain, source="here").model.aggregator
    sinkhorn = dataclasses.replace(SALAD.sinkhorn, gradient=name, **changes)
    assert salad == dataclasses.replace(SALAD, sinkhorn=sinkhorn)
    assert salad.sinkhorn.gradient == GRADIENTS.make(name)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ({"model": {"salad": {"clusters": 32}}}, {"aggregator": SaladConfig(clusters=32)}),
        (
            {"model": {"salad": {"sinkhorn": {"epsilon": 0.5}}}},
            {"aggregator": SaladConfig(epsilon=0.5)},
        ),
        # Settings of what was not chosen said nothing.
        ({"model": {"gem": {}, "boq": {"rows": 8}}}, {}),
        ({"loss": {"triplet": {"margin": 0.3}}}, {"loss": LossConfig()}),
        (
            {"loss": {"kind": "circle", "triplet": {"margin": 0.3}}},
            {"loss": LossConfig(kind="circle")},
        ),
        ({"augment": "light"}, {"augmentation": LightAugmentConfig()}),
        (
            {"rand_augment": {"operations": 2}},
            {"augmentation": RandAugmentConfig(operations=2)},
        ),
        ({"light_augment": {"crop": 0.2}}, {"augmentation": RandAugmentConfig()}),
    ],
)
def test_fields_that_version_0_1_left_out_take_their_defaults(value: Any, expected: Any):
    aggregator = expected.pop("aggregator", SaladConfig())
    model = ModelConfig(aggregator=aggregator)
    assert from_plain(TrainConfig, value, source="here") == TrainConfig(model=model, **expected)


def test_what_is_of_an_earlier_version():
    assert is_of_an_earlier_version(OLD)
    assert is_of_an_earlier_version(OLD["model"])
    for plain in (to_plain(TRAIN), to_plain(MODEL), {}, [], None, "keeps", {"model": 3}):
        assert not is_of_an_earlier_version(plain)
