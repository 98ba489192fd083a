"""Sizes of models, and the ways in which they are trained."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from crisalad_jax.config.aggregators import (
    AnyLocConfig,
    BoqConfig,
    ConvApConfig,
    CosPlaceConfig,
    CrossImageConfig,
    MixVprConfig,
    NetVladConfig,
    SaladConfig,
    TransVprConfig,
)
from crisalad_jax.config.backbone import AdapterConfig, ViTConfig
from crisalad_jax.config.checks import choose
from crisalad_jax.config.losses import (
    LargeMarginCosineConfig,
    LossConfig,
    MultiSimilarityConfig,
)
from crisalad_jax.config.model import ModelConfig
from crisalad_jax.config.training import LightAugmentConfig, OptimiserConfig, TrainConfig


def _preset(dim: int, depth: int, heads: int, **backbone: Any) -> ModelConfig:
    return ModelConfig(backbone=ViTConfig(dim=dim, depth=depth, heads=heads, **backbone))


# The widths of DINOv2's four sizes; b14 is the paper's model. tiny is for training from nothing.
PRESETS: Mapping[str, ModelConfig] = {
    "tiny": ModelConfig(
        image_size=(98, 98),
        normalisation="local-contrast",
        backbone=ViTConfig(
            dim=128,
            depth=4,
            heads=4,
            position_grid=7,
            position_start="sincos",
        ),
        salad=SaladConfig(clusters=16, cluster_dim=32, token_dim=64, hidden=128, dropout=0.0),
        netvlad=NetVladConfig(clusters=16),
        conv_ap=ConvApConfig(channels=128),
        cosplace=CosPlaceConfig(dim=256),
        mixvpr=MixVprConfig(channels=128),
        anyloc=AnyLocConfig(clusters=16, layer=-1),
        boq=BoqConfig(channels=64, queries=16, rows=8),
        transvpr=TransVprConfig(levels=2, dim=128),
        encoder=CrossImageConfig(heads=4, feedforward=128, dropout=0.0),
    ),
    "s14": _preset(384, 12, 6),
    "b14": _preset(768, 12, 12),
    "l14": _preset(1024, 24, 16),
    "g14": _preset(1536, 40, 24, ffn="swiglu"),
}


def recipe(preset: str, name: str | None = None) -> TrainConfig:
    """How a model is trained, and which parts it has for that.

    Args:
        preset: the size of the model (PRESETS).
        name: what to reproduce (RECIPES); None is the paper's way, except for `tiny`, which starts
            from nothing.

    Raises:
        InputError: no such preset or recipe, or one that does not fit the preset.
    """
    model = choose("preset", preset, PRESETS)
    default = "scratch" if preset == "tiny" else "crisalad"
    return choose("recipe", default if name is None else name, RECIPES)(model)


def _crisalad(model: ModelConfig) -> TrainConfig:
    """The paper's section 4.2."""
    return TrainConfig(model=model)


def _varied(**optimiser: Any) -> Callable[[ModelConfig], TrainConfig]:
    """A row of the paper's Table 2 with another optimiser."""
    return lambda model: TrainConfig(model=model, optimiser=OptimiserConfig(**optimiser))


def _salad(model: ModelConfig) -> TrainConfig:
    """serizba/salad: no adapter and no encoder, the last four blocks train, mixed precision."""
    backbone = dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="none"))
    return TrainConfig(
        model=dataclasses.replace(
            model,
            backbone=backbone,
            encoder=dataclasses.replace(model.encoder, layers=0),
            compute_dtype="bfloat16",
        ),
        optimiser=OptimiserConfig(weight_decay=9.5e-9, final_fraction=0.2, decay_steps=4000),
        trains="last-4-blocks+head",
        places_per_batch=60,
        epochs=4,
        patience=None,
    )


def _cricavpr(model: ModelConfig) -> TrainConfig:
    """Lu-Feng/CricaVPR: multi-resolution adapters, a GeM pyramid, Adam that steps down."""
    adapter = AdapterConfig(kind="multi-resolution")
    return TrainConfig(
        model=dataclasses.replace(
            model,
            backbone=dataclasses.replace(model.backbone, adapter=adapter),
            aggregator="gem-pyramid",
        ),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-4, schedule="step", weight_decay=0.0
        ),
        places_per_batch=72,
    )


def _anyloc(model: ModelConfig) -> TrainConfig:
    """AnyLoc over DINOv2 as it is: of use for its model alone, for nothing of it trains."""
    return TrainConfig(
        model=dataclasses.replace(
            model,
            backbone=dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="none")),
            aggregator="anyloc",
            encoder=dataclasses.replace(model.encoder, layers=0),
        ),
        trains="head",
    )


def _cosplace(model: ModelConfig) -> TrainConfig:
    """gmberton/CosPlace: classification; Adam at 1e-5, a batch of 32 classes, an image of each.

    GSV-Cities' places are one spot and one direction each: they are the classes.
    """
    return _classified(model, LargeMarginCosineConfig(steps=10_000), epochs=50)


def _eigenplaces(model: ModelConfig) -> TrainConfig:
    """gmberton/EigenPlaces: classes of viewpoints, and a descriptor four times as long.

    Each of its steps was one on lateral and one on frontal classes, which have epochs of their own
    here, of twice the number.
    """
    head = dataclasses.replace(model.cosplace, dim=4 * model.cosplace.dim)
    classes = LargeMarginCosineConfig(
        scale=100.0, classes="viewpoints", groups=9, steps=5000, cell=15.0, spacing=3
    )
    config = _classified(dataclasses.replace(model, cosplace=head), classes, epochs=80)
    return dataclasses.replace(config, min_images=5)


def _classified(model: ModelConfig, loss: LargeMarginCosineConfig, *, epochs: int) -> TrainConfig:
    return TrainConfig(
        model=dataclasses.replace(
            model, aggregator="cosplace", encoder=dataclasses.replace(model.encoder, layers=0)
        ),
        loss=LossConfig(kind="large-margin-cosine", large_margin_cosine=loss),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-5, final_fraction=1.0, weight_decay=0.0
        ),
        places_per_batch=32,
        images_per_place=1,
        batch_order="shuffled",
        epochs=epochs,
        patience=None,
    )


def _comparable(aggregator: Any) -> Callable[[ModelConfig], TrainConfig]:
    """Another aggregator in the place of CriSALAD's head, and all else as the paper trains.

    The backbone stays frozen, with the adapters beside it, so that methods differ in nothing but
    what they make of its features. An image's descriptor owes nothing to others.
    """

    def train(model: ModelConfig) -> TrainConfig:
        encoder = dataclasses.replace(model.encoder, layers=0)
        return TrainConfig(model=dataclasses.replace(model, aggregator=aggregator, encoder=encoder))

    return train


def _scratch(model: ModelConfig) -> TrainConfig:
    """From random weights, all of the model: ours, for `tiny`."""
    return from_scratch(TrainConfig(model=model))


def from_scratch(config: TrainConfig) -> TrainConfig:
    """Another recipe's model and kind of loss, trained from random weights as `scratch` trains.

    What is kept of the recipe is what makes its method: the parts of the model, and what is
    learnt. The optimiser, the losses' constants, the augmentation and the batches are ours, in
    float32, and all of the model trains.
    """
    # base 0.5: from a cold start base 0 drives all similarities to 0 together.
    loss = dataclasses.replace(config.loss, multi_similarity=MultiSimilarityConfig(base=0.5))
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, compute_dtype="float32"),
        loss=loss,
        optimiser=OptimiserConfig(
            learning_rate=1e-3,
            final_fraction=0.02,
            warmup_steps=30,
            weight_decay=0.05,
            b2=0.99,
            clip_norm=1.0,
        ),
        trains="all",
        augment="light",
        light_augment=LightAugmentConfig(colour=0.4, gamma=0.5, illumination=0.6),
        places_per_batch=TrainConfig.places_per_batch,
        images_per_place=2,
        min_images=2,
        batch_order="shuffled",
        epochs=150,
        validate_every=10,
        patience=None,
    )


RECIPES: Mapping[str, Callable[[ModelConfig], TrainConfig]] = {
    "crisalad": _crisalad,
    "crisalad-1e-4": _varied(learning_rate=1e-4),
    "crisalad-step": _varied(schedule="step"),
    "salad": _salad,
    "cricavpr": _cricavpr,
    "transvpr": _comparable("transvpr"),
    "netvlad": _comparable("netvlad"),
    "anyloc": _anyloc,
    "cosplace": _cosplace,
    "eigenplaces": _eigenplaces,
    "gem": _comparable("gem"),
    "conv-ap": _comparable("conv-ap"),
    "mixvpr": _comparable("mixvpr"),
    "boq": _comparable("boq"),
    "scratch": _scratch,
}
"""Named by what they reproduce. Table 2's other rows are one flag of `crisalad` each."""
