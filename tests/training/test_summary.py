"""Numbers of models: those of the costs and of what trains, together."""

import dataclasses
import json

import pytest

from crisalad_jax.cli.tables import summary_table
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.costs import part_costs
from crisalad_jax.training.summary import model_summary, summary_json, summary_lines
from crisalad_jax.training.trainable import count_trainable
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL

BARE = dataclasses.replace(
    MODEL, backbone=dataclasses.replace(MODEL.backbone, adapter=AdapterConfig(kind="none"))
)


@pytest.mark.parametrize(("config", "trainable"), [(MODEL, "adapters+head"), (BARE, "head")])
def test_what_trains_by_default(config, trainable):
    summary = model_summary(config, images=4)
    assert (summary.trainable, summary.image_size) == (trainable, (42, 56))
    assert summary.parts == part_costs(config, images=4)
    assert summary.trainable_parameters == count_trainable(config, trainable)
    total = sum(cost.parameters for cost in summary.parts)
    assert summary.frozen_parameters + summary.trainable_parameters == total
    assert (summary.one_adapter is None) == (config is BARE)
    assert model_summary(config, "all").frozen_parameters == 0


def test_as_json_and_for_the_terminal():
    summary = model_summary(MODEL)
    found = summary_json(summary, "mine")
    assert json.loads(json.dumps(found)) == found
    assert (found["model"], found["image_size"]) == ("mine", [42, 56])
    assert found["one_adapter"]["parameters"] == summary.one_adapter.parameters
    assert "one_adapter" not in summary_json(model_summary(BARE), "mine")
    assert summary_table(summary, "mine").row_count == len(summary.parts) + 1
    assert f"{summary.frozen_parameters:,} parameters" in "\n".join(summary_lines(summary))


def test_no_images_are_refused():
    with pytest.raises(InputError, match="batch size: found 0"):
        model_summary(MODEL, images=0)
