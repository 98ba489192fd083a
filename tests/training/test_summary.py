"""Numbers of models: those of the costs and of what trains, together."""

import dataclasses

import pytest

from crisalad_jax.nn.costs import part_costs
from crisalad_jax.training.summary import model_summary
from crisalad_jax.training.trainable import count_trainable
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL

BARE = dataclasses.replace(MODEL, backbone=dataclasses.replace(MODEL.backbone, adapter="none"))


@pytest.mark.parametrize(("config", "trainable"), [(MODEL, "adapters,head"), (BARE, "head")])
def test_what_trains_by_default(config, trainable):
    summary = model_summary(config, images=4)
    assert (summary.trainable, summary.image_size) == (trainable, (42, 56))
    assert summary.parts == part_costs(config, images=4)
    assert summary.trainable_parameters == count_trainable(config, trainable)
    total = sum(cost.parameters for cost in summary.parts)
    assert summary.frozen_parameters + summary.trainable_parameters == total
    assert (summary.one_adapter is None) == (config is BARE)
    assert model_summary(config, "all").frozen_parameters == 0


def test_no_images_are_refused():
    with pytest.raises(InputError, match="batch size: found 0"):
        model_summary(MODEL, images=0)
