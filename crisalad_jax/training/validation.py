"""Evaluate the current model of a run: recalls, transport on a few queries, descriptors."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.reading import Reading
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.model import Crisalad, Model, extract_tokens
from crisalad_jax.retrieval.describe import described
from crisalad_jax.retrieval.describer import describer_of
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.step import named_scalars

WATCHED_QUERIES = 16
"""Number of queries whose mean transport statistics every validation logs."""
MONITORED = {"R@1": (1,), "R@5": (5,), "R@1+R@5": (1, 5)}
"""Values of K whose R@K are added, for each value of `TrainConfig.monitor`."""
DESCRIBED_AT_ONCE = 16
"""Number of images in a batch while tuples are mined."""


class Validation(NamedTuple):
    """Result of a validation."""

    monitored: float
    """The recall, or sum of recalls, that `TrainConfig.monitor` names."""
    metrics: dict[str, float]
    """Recalls, mean transport statistics, and scalars of the aggregator and cross-image encoder."""
    words: str
    """The recalls as text."""


class Validator:
    """Evaluates the model of a run between its steps."""

    def __init__(self, config: TrainConfig, benchmark: Benchmark | None, reading: Reading) -> None:
        """Check the benchmark's ground truth; without a benchmark, no validation is ever due.

        Raises:
            InputError: the benchmark has no ground truth.
        """
        if benchmark is not None:
            benchmark.ground_truth()
        self._config, self._benchmark, self._reading = config, benchmark, reading
        self.name = "" if benchmark is None else benchmark.name
        """Name of the benchmark."""
        size = config.validation_size or config.model.image_size
        self._model = dataclasses.replace(config.model, image_size=size)

    def is_due(self, step: int, steps_per_epoch: int, *, last: int) -> bool:
        """Return whether the epoch that ends with this step needs a validation.

        Args:
            step: number of steps taken so far.
            steps_per_epoch: number of steps of an epoch.
            last: the step of the last validation.
        """
        epoch, rest = divmod(step, steps_per_epoch)
        asked = epoch % self._config.validate_every == 0 or epoch == self._config.epochs
        return self._benchmark is not None and rest == 0 and step > last and asked

    def validate(self, params: Crisalad) -> Validation:
        """Evaluate the model with grouping `single`, and compute its transport statistics."""
        assert self._benchmark is not None
        (result,) = evaluate(
            Model(params, self._model),
            self._benchmark,
            groupings=("single",),
            reading=self._reading,
        )
        recalls = {f"R@{k}": recall for k, recall in result.recalls.items()}
        words = "  ".join(f"{name} {100 * recall:.1f}" for name, recall in recalls.items())
        skipped = sum(map(len, result.skipped))
        if skipped:
            words += f"; {skipped} unreadable images left out"
        watched = self._watch_transport(params, result.skipped.rest_of(self._benchmark))
        own = {
            **self._model.aggregator.numbers(params.aggregator),
            **self._model.cross_image.numbers(params.cross_image),
        }
        watched |= {name: float(value) for name, value in own.items()}
        monitored = sum(result.recalls[k] for k in MONITORED[self._config.monitor])
        return Validation(monitored, recalls | watched, words)

    def describe(self, params: Crisalad, paths: Sequence[pathlib.Path]) -> np.ndarray:
        """Compute single-image descriptors of files; rows of unreadable files are NaN."""
        model = self._config.model
        rows = np.full((len(paths), model.descriptor_dim), np.nan, np.float32)
        reading = dataclasses.replace(self._reading, batch_size=DESCRIBED_AT_ONCE)
        for part in described(describer_of(Model(params, model)), paths, reading):
            rows[part.indices] = part.descriptors
        return rows

    def _watch_transport(self, params: Crisalad, benchmark: Benchmark) -> dict[str, float]:
        """Compute statistics of the transport on the first queries, without dropout."""
        paths = benchmark.queries[:WATCHED_QUERIES]
        reading = Reading(batch_size=len(paths), cache=self._reading.cache)
        batches = reading.batches(paths, Preparation.of(self._model))
        batch = next(iter(batches))  # of the size of the first image, if sizes differ
        transport = extract_tokens(params, batch.images[batch.valid], self._model).transport
        means = jax.device_get(jax.tree.map(jnp.mean, transport))
        return {} if means is None else named_scalars(means)
