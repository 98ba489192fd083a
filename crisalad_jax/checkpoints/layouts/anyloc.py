"""The layout of AnyLoc's vocabularies (Keetha et al., RA-L 2023): the words alone."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from crisalad_jax.checkpoints.layouts.base import Layout, Lines, register_layout
from crisalad_jax.checkpoints.layouts.forms import SAME, Entry
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators.vlad import AnyLocConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.utils.errors import InputError

VOCABULARY = "anyloc-words"
"""Name of the layout."""


def vocabulary_model(
    words: np.ndarray, model: ModelConfig, fields: Mapping[str, Any]
) -> ModelConfig:
    """Return AnyLoc over the backbone of a model, with the words of a published vocabulary.

    Args:
        words: the vocabulary, (word, dim).
        model: whose backbone the words are features of.
        fields: settings of `AnyLocConfig` that no shape tells, where they are not those published.

    Returns:
        The configuration. Images keep their sizes, but for sides that are multiples of the patch
        size.

    Raises:
        InputError: words of another width, or fields out of range.
    """
    width = model.backbone.dim
    if words.ndim != 2 or words.shape[1] != width or not len(words):
        raise InputError(
            f"found a tensor of shape {words.shape}, expected (words, {width}): the backbone's "
            f"features have {width} numbers"
        )
    return dataclasses.replace(
        model,
        preprocessing=PreprocessingConfig(size_rule="native", pixels="floats"),
        aggregator=AnyLocConfig(clusters=len(words), **fields),
        cross_image=CrossImageConfig(layers=0),
        projection=ProjectionConfig(),
    )


def _accepts(config: ModelConfig) -> str | None:
    fits = isinstance(config.aggregator, AnyLocConfig) and not config.projection.dim
    return None if fits else "aggregator anyloc, no projection"


def _lines(config: ModelConfig) -> Lines:
    yield Entry(("aggregator.words",), ("words",), SAME)


register_layout(Layout(VOCABULARY, "AnyLoc c_centers.pt", _accepts, _lines, bare=True))
