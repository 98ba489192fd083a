"""The projection of descriptors against torch's linear layer, and its place in a model."""

import dataclasses

import jax
import numpy as np
import pytest
import torch
from torch.nn import functional as F

from crisalad_jax import describe, init_crisalad
from crisalad_jax.checkpoints.formats import check_holds
from crisalad_jax.nn.config import PRESETS
from crisalad_jax.nn.costs import part_costs
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.training.trainable import split_params
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves

PLAIN = PRESETS["tiny"]
CONFIG = dataclasses.replace(PLAIN, projection=ProjectionConfig(dim=24))
PARAMS = init_crisalad(jax.random.key(0), CONFIG)
IMAGES = np.random.default_rng(0).integers(0, 256, (3, 98, 98, 3), np.uint8)


@pytest.mark.parametrize("renormalise", [True, False])
def test_it_is_torchs_linear_layer_of_the_descriptor(renormalise: bool) -> None:
    how = ProjectionConfig(24, renormalise)
    found = describe(PARAMS, IMAGES, dataclasses.replace(CONFIG, projection=how))
    before = describe(dataclasses.replace(PARAMS, projection=None), IMAGES, PLAIN)
    layer = PARAMS.projection
    assert layer is not None
    weight, bias, x = (torch.tensor(np.asarray(a)) for a in (layer.weight.T, layer.bias, before))
    expected = F.linear(x, weight, bias)
    if renormalise:
        expected = F.normalize(expected, dim=1)
    # Sums of 576 products of float32.
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


def test_other_parts_are_drawn_as_without_it() -> None:
    drawn = named_leaves(init_crisalad(jax.random.key(0), PLAIN))
    for name, leaf in named_leaves(PARAMS).items():
        if not name.startswith("projection."):
            np.testing.assert_array_equal(leaf, drawn.pop(name))
    assert not drawn


def test_it_counts_and_trains_with_the_head() -> None:
    assert CONFIG.descriptor_dim == 24
    assert CONFIG.unprojected_dim == PLAIN.descriptor_dim == 576
    (row,) = (row for row in part_costs(CONFIG) if row.part == "projection")
    assert (row.parameters, row.macs) == (576 * 24 + 24, 576 * 24)
    assert part_costs(CONFIG)[:-1] == part_costs(PLAIN)
    trainable, _ = split_params(PARAMS, CONFIG, "head,-adapters")
    assert trainable.projection.weight is not None


def test_layouts_without_a_place_for_it_refuse_it() -> None:
    backbone = dataclasses.replace(CONFIG.backbone, adapter="none")
    config = dataclasses.replace(CONFIG, backbone=backbone, cross_image="none")
    with pytest.raises(InputError, match="found a model of projection yes, expected no"):
        check_holds(config, "dino-salad")


def test_a_width_below_zero_is_refused() -> None:
    with pytest.raises(InputError, match=r"ProjectionConfig\.dim: found -1, expected a whole"):
        ProjectionConfig(dim=-1)
