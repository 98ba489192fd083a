"""Presets, recipes, and what a configuration refuses."""

import dataclasses
import pathlib
import re

import numpy as np
import pytest

from crisalad_jax.checkpoints.export import ExportConfig
from crisalad_jax.checkpoints.load import load
from crisalad_jax.config.checks import choose
from crisalad_jax.config.classes import ClassesConfig
from crisalad_jax.config.io import read_config
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.data.augmentations.colour_crop import ColourCropConfig
from crisalad_jax.data.augmentations.light import LightAugmentConfig
from crisalad_jax.data.augmentations.rand_augment import RandAugmentConfig
from crisalad_jax.nn.adapters.bottleneck import (
    DepthwiseConfig,
    MultiResolutionConfig,
    NoAdapter,
)
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.aggregators.backbone_tokens import AggregationTokensConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.aggregators.vlad import AnyLocConfig, VladBuffConfig
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig, NoCrossImage
from crisalad_jax.sinkhorn import SinkhornConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.large_margin_cosine import LargeMarginCosineConfig
from crisalad_jax.training.losses.pairwise import (
    ContrastiveConfig,
)
from crisalad_jax.training.optimisers import Adam, AdamW, Sgd
from crisalad_jax.training.recipes import recipe
from crisalad_jax.training.schedules import (
    ConstantSchedule,
    LinearSchedule,
    MilestonesSchedule,
    StepSchedule,
)
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import Note

ROOT = pathlib.Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("preset", "sizes"),
    # Oquab et al. 2023, table 17, and the public checkpoints' shapes: w12 of g14 is 2 x 4096.
    [
        ("s14", (384, 12, 6, 1536)),
        ("b14", (768, 12, 12, 3072)),
        ("l14", (1024, 24, 16, 4096)),
        ("g14", (1536, 40, 24, 4096)),
    ],
)
def test_presets_are_the_four_sizes_of_dinov2(preset, sizes):
    backbone = PRESETS[preset].backbone
    assert (backbone.dim, backbone.depth, backbone.heads, backbone.hidden) == sizes
    assert PRESETS[preset].descriptor_dim == 8448


def test_the_recipe_is_the_papers():
    config = recipe("b14")  # section 4.2
    assert config.optimiser.learning_rate == 6e-5
    # "Linear, as adopted in SALAD", whose code decays to a fifth in 4,000 steps.
    for name in ("crisalad", "crisalad-1e-4"):
        optimiser = recipe("b14", name).optimiser
        assert optimiser.kind == AdamW(b1=0.9, b2=0.999)
        assert optimiser.schedule == LinearSchedule(end_fraction=0.2, decay_steps=4000)
    assert (config.places_per_batch, config.images_per_place) == (48, 4)
    assert config.trainable == "adapters,head"
    assert config.model.image_size == (224, 224)
    loss, similar = config.loss, "multi-similarity"
    assert (loss.kind.part_name, loss.miner, loss.miner_margin) == (similar, similar, 0.1)
    assert (loss.kind.alpha, loss.kind.beta) == (1.0, 50.0)
    assert config.augmentation == RandAugmentConfig(operations=3)


def test_the_recipes_are_their_papers():
    """serizba/salad and Lu-Feng/CricaVPR as published; Table 2's rows."""
    salad = recipe("b14", "salad")
    assert (salad.places_per_batch, salad.images_per_place, salad.epochs) == (60, 4, 4)
    assert (salad.trainable, salad.monitor) == ("last-4-blocks,norm,head", "R@1")
    assert (salad.model.backbone.adapter, salad.model.cross_image) == (NoAdapter(), NoCrossImage())
    optimiser = salad.optimiser
    assert optimiser == OptimiserConfig(
        kind="adamw",
        learning_rate=6e-5,
        schedule=LinearSchedule(end_fraction=0.2, decay_steps=4000),
        weight_decay=9.5e-9,
    )
    cricavpr = recipe("b14", "cricavpr")
    assert (cricavpr.places_per_batch, cricavpr.images_per_place) == (72, 4)
    assert cricavpr.model.descriptor_dim == 10_752
    assert cricavpr.model.backbone.adapter.part_name == "multi-resolution"
    optimiser = cricavpr.optimiser
    assert (optimiser.kind, optimiser.learning_rate, optimiser.weight_decay) == (Adam(), 1e-4, 0.0)
    assert optimiser.schedule == StepSchedule(epochs=3, gamma=0.5)
    assert (cricavpr.epochs, cricavpr.patience, cricavpr.monitor) == (10, 10, "R@5")
    paper = recipe("b14")
    for name, change in (
        ("crisalad-1e-4", {"learning_rate": 1e-4}),
        ("crisalad-step", {"schedule": StepSchedule(epochs=3, gamma=0.5)}),
    ):
        varied = dataclasses.replace(paper.optimiser, **change)
        assert recipe("b14", name) == dataclasses.replace(paper, optimiser=varied)
    assert recipe("b14", "crisalad") == paper
    assert recipe("tiny", "scratch") == recipe("tiny")


def test_validations_are_of_the_codes_sizes():
    """Of amaralibey/Bag-of-Queries, Tong-Jin01/EDTformer, Lu-Feng/ImAge and Lu-Feng/SuperVLAD."""
    for name in ("boq", "edtformer", "image", "supervlad"):
        config = recipe("b14", name)
        assert config.model.image_size == (224, 224)
        assert config.validation_size == (322, 322)
        assert recipe("tiny", name).validation_size is None
    assert recipe("b14", "boq-resnet50").validation_size == (384, 384)
    assert recipe("b14", "salad").validation_size is None
    # Another head, or other patches, may not fit the size.
    assert recipe("b14", "boq+mixvpr").validation_size is None
    assert recipe("b14", "boq+dinov3").validation_size is None


def test_classification_is_as_published():
    """gmberton/CosPlace and gmberton/EigenPlaces: their papers' constants and their code's."""
    cosplace = recipe("b14", "cosplace-vit")
    assert cosplace.model.aggregator.part_name == "cosplace"
    assert cosplace.model.cross_image == NoCrossImage()
    assert cosplace.model.descriptor_dim == 512
    optimiser = cosplace.optimiser
    assert (optimiser.kind, optimiser.learning_rate, optimiser.weight_decay) == (Adam(), 1e-5, 0.0)
    assert optimiser.schedule == ConstantSchedule()
    assert (cosplace.places_per_batch, cosplace.images_per_place) == (32, 1)
    assert (cosplace.epochs, cosplace.patience) == (50, None)
    loss = cosplace.loss.kind
    assert loss.part_name == "large-margin-cosine"
    assert (loss.scale, loss.margin, loss.learning_rate) == (30.0, 0.4, 0.01)
    classes = loss.classes
    assert (classes.kind, classes.groups, classes.steps) == ("places", 8, 10_000)
    assert (classes.cell, classes.sector) == (10.0, 30.0)
    assert (classes.spacing, classes.sector_spacing) == (5, 2)
    assert cosplace.min_images_of_place == cosplace.min_images == 4
    eigenplaces = recipe("b14", "eigenplaces-vit")
    assert eigenplaces.model.descriptor_dim == 2048
    assert eigenplaces.optimiser == optimiser
    assert (eigenplaces.min_images, eigenplaces.min_images_of_place) == (5, 1)
    loss = eigenplaces.loss.kind
    assert (loss.scale, loss.margin, loss.learning_rate) == (100.0, 0.4, 0.01)
    classes = loss.classes
    assert (classes.kind, classes.groups, classes.steps) == ("viewpoints", 9, 5000)
    assert (classes.cell, classes.spacing, classes.focal_distance) == (15.0, 3, 10.0)


def test_the_recipes_of_other_heads_over_dinov2_are_as_published():
    """Of amaralibey/Bag-of-Queries, GaoShuang98/DINO-Mix, Lu-Feng/SuperVLAD, Lu-Feng/ImAge and
    Ahmedest61/VLAD-BuFF."""
    boq = recipe("b14", "boq")
    assert boq.model.descriptor_dim == 12_288
    assert boq.model.preprocessing.filter == "bicubic"
    assert (boq.trainable, boq.places_per_batch, boq.epochs) == ("last-2-blocks,norm,head", 128, 40)
    assert (boq.augmentation, boq.monitor) == (RandAugmentConfig(3, 15), "R@1")
    assert boq.optimiser == OptimiserConfig(
        kind="adamw",
        learning_rate=1e-4,
        schedule=MilestonesSchedule(epochs=(10, 20), gamma=0.1),
        warmup_epochs=10,
        weight_decay=1e-4,
    )
    mix = recipe("b14", "dino-mix")
    assert mix.model.aggregator == MixVprConfig(channels=1024, rows=4, depth=2, last_norm=False)
    assert (mix.places_per_batch, mix.epochs, mix.monitor) == (80, 60, "R@1")
    assert mix.trainable == "last-4-blocks,norm,positions,head"
    assert mix.optimiser == OptimiserConfig(
        kind=Sgd(momentum=0.9),
        learning_rate=0.005,
        schedule=MilestonesSchedule(epochs=(5, 10, 15, 25, 45), gamma=0.3),
        warmup_steps=650,
        weight_decay=1e-3,
        clip_value=0.5,
        accumulate=4,
    )
    vlad = recipe("b14", "supervlad")
    assert vlad.model.descriptor_dim == 4 * 768
    assert vlad.trainable == "last-4-blocks,head"
    assert (vlad.places_per_batch, vlad.epochs, vlad.patience) == (120, 20, 3)
    assert vlad.monitor == "R@1+R@5"
    assert vlad.optimiser == OptimiserConfig(
        kind="adam",
        learning_rate=5e-5,
        schedule=StepSchedule(epochs=3, gamma=0.5),
        weight_decay=0.0,
    )
    image = recipe("b14", "image")
    assert image.model.aggregator == AggregationTokensConfig(tokens=8, insertion=-4)
    assert (image.model.backbone.registers, image.model.backbone.position_resize) == (4, "plain")
    assert (image.trainable, image.optimiser) == (vlad.trainable, vlad.optimiser)
    assert (image.places_per_batch, image.epochs, image.patience) == (120, 20, 20)
    assert (image.model.descriptor_dim, image.monitor) == (6144, "R@1+R@5")
    buff, salad = recipe("b14", "vlad-buff"), recipe("b14", "salad")
    assert buff.model.aggregator == VladBuffConfig(clusters=64, reduced=192)
    assert dataclasses.replace(buff, model=salad.model) == salad
    for config in (mix, image, buff):
        assert config.model.compute_dtype == "bfloat16"
    for config in (boq, mix, vlad, image, buff):
        assert config.model.image_size == (224, 224)
        assert config.model.backbone.adapter == NoAdapter()
        assert config.model.cross_image == NoCrossImage()
        assert config.images_per_place == 4


def test_the_recipes_over_resnet_are_as_published():
    """amaralibey/MixVPR, amaralibey/gsv-cities, amaralibey/Bag-of-Queries, gmberton/CosPlace."""
    mix = recipe("b14", "mixvpr")
    assert mix.model.backbone == ResNetConfig(layers=50, stages=3)
    assert mix.model.aggregator == MixVprConfig(channels=1024, rows=4, depth=4)
    assert (mix.model.image_size, mix.model.descriptor_dim) == ((320, 320), 4096)
    assert (mix.trainable, mix.places_per_batch, mix.epochs) == ("last-1-blocks,head", 120, 80)
    assert mix.optimiser == dataclasses.replace(
        recipe("b14", "dino-mix").optimiser, learning_rate=0.05, accumulate=1, clip_value=None
    )
    conv = recipe("b14", "conv-ap")
    assert conv.model.backbone == ResNetConfig(layers=50, stages=4)
    assert (conv.model.image_size, conv.model.descriptor_dim) == ((320, 320), 4096)
    assert (conv.trainable, conv.places_per_batch, conv.epochs) == (
        "last-2-blocks,head",
        100,
        30,
    )
    assert conv.optimiser == OptimiserConfig(
        kind="adamw",
        learning_rate=2e-4,
        schedule=MilestonesSchedule(epochs=(5, 10, 15, 25), gamma=0.3),
        warmup_steps=600,
        weight_decay=0.0,
    )
    boq = recipe("b14", "boq-resnet50")
    assert boq.model.backbone == ResNetConfig(layers=50, stages=3)
    assert (boq.model.image_size, boq.model.descriptor_dim) == ((320, 320), 16_384)
    assert boq.trainable == "last-2-blocks,norm,head"
    assert boq.optimiser == recipe("b14", "boq").optimiser
    for config in (mix, conv, boq):
        assert (config.batch_norm, config.monitor) == ("batch", "R@1")
    cosplace = recipe("b14", "cosplace")
    assert cosplace.model.backbone == ResNetConfig(layers=18, stages=4)
    assert (cosplace.model.image_size, cosplace.model.descriptor_dim) == ((512, 512), 512)
    assert (cosplace.trainable, cosplace.monitor) == ("last-2-blocks,head", "R@1")
    assert cosplace.augmentation == ColourCropConfig(0.7, 0.7, 0.7, 0.5, 0.5)
    classes = cosplace.loss.kind.classes
    assert (classes.kind, classes.groups, cosplace.min_images) == ("cells", 8, 10)
    eigenplaces = recipe("b14", "eigenplaces-turns")
    # Its code trains in mixed precision, CosPlace's only where --use_amp16 asks for it.
    assert cosplace.model.compute_dtype == "float32"
    assert eigenplaces.model.compute_dtype == "bfloat16"
    edtformer = recipe("b14", "edtformer")
    assert edtformer.model.descriptor_dim == 4096
    backbone = edtformer.model.backbone
    assert backbone.adapter.width(backbone.dim) == 4
    assert (edtformer.epochs, edtformer.patience, edtformer.monitor) == (15, 15, "R@5")
    assert edtformer.optimiser.schedule == StepSchedule(epochs=3, gamma=0.7)


def test_a_part_alone_is_told():
    with pytest.warns(Note, match=r"^recipe: found part gem; using crisalad\+gem, CriS"):
        assert recipe("tiny", "gem") == recipe("tiny", "crisalad+gem")
    swapped = recipe("b14", "salad+step:newton")
    assert swapped.model.aggregator.sinkhorn.step.part_name == "newton"
    assert swapped.optimiser == recipe("b14", "salad").optimiser
    for name in ("crisalad+crisalad", "gem+salad", "crisalad+", "eigenplaces"):
        with pytest.raises(InputError, match=r"^recipe: found '.*', expected one of adapt"):
            recipe("tiny", name)


def test_a_classification_needs_no_second_image_of_a_place():
    classified = recipe("b14", "cosplace-vit")
    assert TrainConfig(loss=classified.loss, images_per_place=1).images_per_place == 1
    with pytest.raises(InputError, match=r"TrainConfig\.images_per_place: found 0"):
        TrainConfig(loss=classified.loss, images_per_place=0)


@pytest.mark.parametrize(
    ("name", "width"),
    # The published descriptors of b14: BoQ's, and 4,096 of MixVPR and Conv-AP.
    [("gem", 768), ("conv-ap", 4096), ("mixvpr", 4096), ("boq", 12_288), ("netvlad", 64 * 768)],
)
def test_methods_to_compare_differ_in_the_aggregator_alone(name, width):
    found, paper = recipe("b14", f"crisalad+{name}"), recipe("b14")
    assert found.model.aggregator == AGGREGATORS.find(name)()
    assert found.model.descriptor_dim == width
    assert found.model.cross_image == NoCrossImage()
    as_paper = dataclasses.replace(
        found.model, aggregator="salad", cross_image=paper.model.cross_image
    )
    assert dataclasses.replace(found, model=as_paper) == paper


def test_the_recipe_of_starter_is_that_of_its_second_run():
    """But for an encoder of no layers, whose fields say nothing."""
    run = read_config(TrainConfig, ROOT / "docs" / "starter" / "config.json")
    found = recipe("b14", "starter")
    assert found.model.cross_image == run.model.cross_image == NoCrossImage()
    model = dataclasses.replace(found.model, cross_image=run.model.cross_image)
    assert dataclasses.replace(found, model=model) == run
    # The file in the package is for larger images than it was trained on.
    shipped = load("starter").config
    assert dataclasses.replace(shipped, image_size=run.model.image_size) == run.model


def test_the_run_without_the_cameras_faults_is_an_epoch_of_starters_but_for_them():
    docs = ROOT / "docs"
    run = read_config(TrainConfig, docs / "small" / "first.json")
    without = read_config(TrainConfig, docs / "small" / "no_faults.json")
    names = [field.name for field in dataclasses.fields(LightAugmentConfig)]
    light = LightAugmentConfig(**{name: getattr(run.augmentation, name) for name in names})
    assert without == dataclasses.replace(run, augmentation=light, epochs=1)


def test_an_unknown_name_lists_the_known():
    with pytest.raises(InputError, match=r"^colour: found '', expected one of blue, red$"):
        choose("colour", "", {"red": 1, "blue": 2})


MULTI_RESOLUTION = MultiResolutionConfig(bottleneck=0.25)
NARROW = {"dim": 96, "heads": 2, "adapter": MULTI_RESOLUTION}
LOCAL_FLOATS = {"normalisation": "local-contrast", "pixels": "floats"}


def of_clusters(clusters: int) -> ModelConfig:
    return ModelConfig(aggregator=SaladConfig(clusters=clusters))


@pytest.mark.parametrize(("clusters", "side"), [(3, 28), (4, 42), (64, 126), (63, 112)])
def test_more_patches_than_clusters(clusters, side):
    """The message's smallest square works, and the next smaller one does not."""
    of_clusters(clusters).check_image_size((side, side))
    smaller = side - 14
    words = rf"{(smaller // 14) ** 2} patches for {clusters} clusters.*: {side} x {side}\)"
    with pytest.raises(InputError, match=words):
        of_clusters(clusters).check_image_size((smaller, smaller))


@pytest.mark.parametrize(
    ("kind", "fields", "words"),
    [
        (ViTConfig, {"adapter": "linear"}, "ViTConfig.adapter: found 'linear', expected one of"),
        (DepthwiseConfig, {"kernel_size": 4}, "DepthwiseConfig.kernel_size: found 4, expected an"),
        (ViTConfig, {"heads": 7}, "ViTConfig.dim: found 768, expected a multiple of the 7 heads"),
        (ViTConfig, {"registers": -1}, "ViTConfig.registers: found -1, expected .* of at least 0"),
        (ViTConfig, {"dim": 6, "heads": 1, "position_init": "sincos"}, "dim: found 6, .* of 4"),
        (ViTConfig, NARROW, "found 0.25, expected a width for dim 96, 24, .* of 16"),
        (ModelConfig, {"aggregator": "gem-pyramid", "image_size": (28, 56)}, "at least 42 x 42, a"),
        (ModelConfig, {"aggregator": "anyloc"}, "for aggregator anyloc, which cannot be trained"),
        (ModelConfig, {"aggregator": ConvApConfig(side=3), "image_size": (28, 56)}, "42 x 42, a p"),
        (ModelConfig, {"aggregator": SaladConfig(token_dim=200)}, "token: found True, expected F"),
        (BoqConfig, {"channels": 200}, "found 200, expected a multiple of its 3 heads, one for"),
        (SaladConfig, {"dropout": 1.0}, "SaladConfig.dropout: found 1.0, expected .* less than 1"),
        (PreprocessingConfig, {"deviation": (1.0, 0.0, 1.0)}, "found mean .* deviations above"),
        (PreprocessingConfig, LOCAL_FLOATS, "pixels: found floats with normalisation local-contr"),
        (LossConfig, {"miner_margin": -0.1}, "LossConfig.miner_margin: found -0.1"),
        (LossConfig, {"kind": "fast-ap"}, "expected 'none' for loss fast-ap, which ranks all"),
        (ContrastiveConfig, {"negative_margin": 2.1}, "margin: found 2.1, expected 0 to 2"),
        (LargeMarginCosineConfig, {"margin": 1.0}, "LargeMarginCosineConfig.margin: found 1.0"),
        (ClassesConfig, {"groups": 0}, "ClassesConfig.groups: found 0"),
        (ClassesConfig, {"sector": 50.0}, "found 2 sectors of 50 degrees, expected a divisor of"),
        (AdamW, {"b2": 1.0}, "AdamW.b2: found 1.0"),
        (TrainConfig, {"images_per_place": 1}, "TrainConfig.images_per_place: found 1"),
        (TrainConfig, {"min_images": 3}, "TrainConfig.min_images: found 3, expected at least 4"),
        (
            TrainConfig,
            {"trainable": "head,"},
            "TrainConfig.trainable: found 'head,', expected words and pat",
        ),
        (TrainConfig, {"validation_size": (320, 322)}, "image size: found 320 x 322, expected"),
    ],
)
@pytest.mark.usefixtures("_unchecked")
def test_what_does_not_fit_is_refused_in_one_line(kind, fields, words):
    with pytest.raises(InputError, match=words) as caught:
        kind(**fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "fields", "found", "expected"),
    [
        (CrossImageConfig, {"layers": 1.5}, "1.5", "a whole number"),
        (CrossImageConfig, {"layers": True}, "True", "a whole number"),
        (CrossImageConfig, {"global_token": 1}, "1", "True or False"),
        (ViTConfig, {"adapter": 0.5}, "0.5", "an adapter or its name"),
        (SinkhornConfig, {"tolerance": "1e-3"}, "'1e-3'", "a finite number above 0, or None"),
        (ModelConfig, {"image_size": [224, 224]}, "[224, 224]", "a tuple of 2, each a whole num"),
        (ModelConfig, {"image_size": (224, 2.5)}, "(224, 2.5)", "a tuple of 2, each a whole num"),
        (TrainConfig, {"cities": "Bath"}, "'Bath'", "a tuple, each text, or None"),
        (ExportConfig, {"platforms": "cpu"}, "'cpu'", "a tuple, each one of cpu"),
    ],
)
@pytest.mark.usefixtures("_unchecked")
def test_a_field_of_another_type_is_refused_by_its_name(kind, fields, found, expected):
    (field,) = fields
    words = rf"^{kind.__name__}\.{field}: found {re.escape(found)}, expected {re.escape(expected)}"
    with pytest.raises(InputError, match=words) as caught:
        kind(**fields)
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("_unchecked")
def test_numpys_numbers_and_whole_numbers_for_floats_are_taken():
    assert CrossImageConfig(layers=np.int64(1)) == CrossImageConfig(layers=1)
    assert OptimiserConfig(learning_rate=1) == OptimiserConfig(learning_rate=1.0)
    assert LossConfig(miner_margin=np.float32(0.5)) == LossConfig(miner_margin=0.5)
    assert ModelConfig(image_size=(np.int32(224), 224)) == ModelConfig()


def test_anylocs_layer_is_its_papers_of_vit_g():
    """31 of 40 blocks, by Keetha et al., whether from the front or from the end."""
    for part in (AnyLocConfig(), AnyLocConfig(layer=31)):
        assert part.features(40).levels == (32,)  # counted from 1
    assert recipe("g14", "anyloc").model.descriptor_dim == 32 * 1536  # 49,152, as published


def test_a_model_without_adapters_cannot_train_them():
    bare = ModelConfig(backbone=ViTConfig(adapter="none"))
    with pytest.raises(InputError, match=r"found 'adapters,head', expected .* without adapters"):
        TrainConfig(model=bare)
    assert TrainConfig(model=bare, trainable="last-4-blocks,norm,head").model is bare


def test_without_an_encoder_its_widths_need_not_fit():
    assert ModelConfig(aggregator=SaladConfig(cluster_dim=100), cross_image="none").descriptor_dim
    with pytest.raises(InputError, match=r"CrossImageConfig\.heads: found 7"):
        ModelConfig(cross_image=CrossImageConfig(heads=7))
