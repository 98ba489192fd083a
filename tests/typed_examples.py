# pyright: strict, reportUnnecessaryTypeIgnoreComment=true
"""What a type checker knows of the public names; `test_types.py` runs pyright on it."""

import dataclasses
import pathlib
from collections.abc import Iterator
from typing import assert_type

import jax
import numpy as np

import crisalad_jax as cj
from crisalad_jax.data.loader import ImageBatch
from crisalad_jax.data.places import Places
from crisalad_jax.evaluation.results import GroupingResult
from crisalad_jax.experiments.comparison import ComparisonConfig, Summary, compare
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.retrieval.maps.map import Answer
from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.sinkhorn import Gradient, Potentials, SinkhornResult, Step


def parts_by_name(preset: cj.ModelConfig) -> None:
    """A field takes a part or its name, and has the part."""
    sinkhorn = cj.SinkhornConfig(step="newton", tolerance=1e-5, gradient="implicit")
    assert_type(sinkhorn.step, Step)
    assert_type(sinkhorn.gradient, Gradient)
    model = cj.ModelConfig(backbone=ResNetConfig(), aggregator="gem")
    assert_type(model.backbone, cj.Backbone)
    assert_type(model.aggregator, cj.Aggregator)
    assert_type(cj.LossConfig(kind="triplet", miner="none").kind, cj.Loss)
    training = cj.TrainConfig(model=preset, augmentation="none", trainable="head")
    assert_type(training.augmentation, cj.Augmentation)
    assert_type(training.sampler, cj.Sampler)
    assert_type(dataclasses.replace(training, augmentation="light"), cj.TrainConfig)
    encoder = "none"
    assert_type(cj.with_aggregator(preset, "gem", "tiny", cross_image=encoder), cj.ModelConfig)
    assert_type(cj.recipe("tiny", "crisalad+gem"), cj.TrainConfig)
    assert_type(cj.from_scratch(training), cj.TrainConfig)
    assert_type(cj.PRESETS["b14"], cj.ModelConfig)


def refused(preset: cj.ModelConfig, places: cj.Map) -> None:
    """Each line is an error: pyright complains of an `ignore` that is not needed."""
    cj.SinkhornConfig(step=3)  # pyright: ignore[reportArgumentType]
    cj.ModelConfig(aggregator=ResNetConfig())  # pyright: ignore[reportArgumentType]
    cj.ModelConfig(aggregater="gem")  # pyright: ignore[reportCallIssue]
    cj.TrainConfig(sampler=3)  # pyright: ignore[reportArgumentType]
    cj.describe(preset, np.zeros((1, 28, 28, 3)), preset)  # pyright: ignore[reportArgumentType]
    cj.query(places, "frames", model=cj.Model(preset, places.config))  # pyright: ignore[reportArgumentType]


def models(images: np.ndarray, file: pathlib.Path) -> None:
    """A model's parameters, configuration and descriptors."""
    params, config = cj.load("starter")
    assert_type(params, cj.Crisalad)
    assert_type(config, cj.ModelConfig)
    assert_type(cj.load(file), cj.Model)
    assert_type(cj.init_crisalad(jax.random.key(0), config), cj.Crisalad)
    assert_type(cj.describe(params, images, config, mask=cj.self_mask(2)), jax.Array)
    assert_type(cj.describe.lower(params, images, config), jax.stages.Lowered)
    tokens = cj.extract_tokens(params, images, config)
    assert_type(tokens, cj.Tokens)
    assert_type(cj.attend_across_images(params, tokens, config), jax.Array)
    assert_type(cj.extract_features(params, images, config), cj.Features)
    picture = cj.prepare_image(cj.read_image("photo.jpg"), config)
    assert picture.dtype == np.uint8
    assert cj.describe_files(cj.Model(params, config), ["photo.jpg"]).dtype == np.float32
    assert cj.describe_images(cj.Model(params, config), [picture]).dtype == np.float32
    assert_type(cj.save_weights(file, cj.Model(params, config)), None)


def transport(scores: jax.Array) -> None:
    """Both forms of the solver, and a step of one's own."""
    config = cj.SinkhornConfig(step="newton")
    assert_type(cj.sinkhorn.assign_with_dustbin(scores, 1.0, config=config), SinkhornResult)
    assert_type(cj.sinkhorn.solve(scores, scores[:, 0], scores[0]), SinkhornResult)
    assert_type(cj.sinkhorn.solve(scores, scores[:, 0], scores[0]).potentials, Potentials)


def losses(descriptors: jax.Array, labels: jax.Array) -> None:
    """A loss by name."""
    found = cj.metric_loss(descriptors, labels, cj.LossConfig(kind="triplet"))
    assert_type(found.loss, jax.Array)


def training(folder: pathlib.Path, config: cj.TrainConfig) -> None:
    """A run, and its parts."""
    result = cj.train(config, folder, "run", validation=folder)
    assert_type(result, cj.FitResult)
    assert_type(result.params, cj.Crisalad)
    assert_type(result.best_recall, float | None)
    places = cj.read_places(folder)
    assert_type(places, Places)
    assert_type(cj.fit(config, places, "run"), cj.FitResult)


def maps(folder: pathlib.Path, descriptors: np.ndarray) -> None:
    """A map and its answers; a search without a map; an evaluation."""
    with cj.Map.open(folder) as places:
        assert_type(places, cj.Map)
        assert_type(places.locate("frame.jpg", k=5), list[Answer])
        assert_type(cj.query(places, "frames"), Answers)
    assert_type(cj.search(descriptors, descriptors[:3], k=5), Neighbours)
    params, config = cj.load("starter")
    benchmark = cj.open_benchmark(folder)
    assert_type(benchmark, cj.Benchmark)
    results = cj.evaluate(cj.Model(params, config), benchmark)
    assert_type(results, list[GroupingResult])
    rows = ("gem: model.aggregator=gem", "slow: optimiser.learning-rate=1e-4")
    compared = ComparisonConfig("ablate", ("crisalad",), test=("SET",), train="DIR", rows=rows)
    assert_type(compare(compared, "OUT", jobs=2), Summary)


def batches(places: Places) -> Iterator[np.ndarray]:
    """Batches of images."""
    for batch in cj.image_batches([places.path(0)], batch_size=2, image_size=(28, 28)):
        assert_type(batch, ImageBatch)
        yield batch.images


@cj.register_loss("typed-margin")
@dataclasses.dataclass(frozen=True)
class Margin(cj.Loss):
    """A part keeps its class under its decorators."""

    margin: float = 0.5

    def apply(self, params: None, batch: cj.LossBatch) -> cj.LossValue:
        """Push all images apart."""
        return cj.LossValue(batch.similarities.sum() - self.margin)


assert_type(Margin(margin=0.4), Margin)
assert_type(cj.LossConfig(kind=Margin()).kind, cj.Loss)
