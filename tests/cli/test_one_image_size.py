"""A model whose parameters are for one image size, asked for another: one line, no work done."""

import dataclasses

from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.model import Model
from tests.cli.test_cli import fails
from tests.conftest import MODEL, random_params

CONFIG = dataclasses.replace(
    MODEL,
    aggregator=MixVprConfig(channels=8, rows=2, depth=1),
    cross_image="none",
)


def test_every_command_that_describes_refuses_it(shared, tmp_path, capfd, database):
    weights, out = tmp_path / "w.safetensors", tmp_path / "out.npy"
    save_weights(weights, Model(random_params(CONFIG), CONFIG))
    for command in (
        ("evaluate", "--data", shared / "town", "--out", out),
        ("extract", "--images", database, "--out", out),
        ("index", "--images", database, "--out", out),
        ("export", "--out", out),
        ("info",),
    ):
        fails(
            capfd,
            *(*command, "--weights", weights, "--image-size", "56", "42"),
            words=("image size: found 56 x 42, expected 42 x 56: aggregator mixvpr",),
        )
        assert not out.exists()
