"""How MixVPR starts; parity/ compares it with torch."""

import jax
import jax.numpy as jnp
import numpy as np

from crisalad_jax.nn.aggregators.mixvpr import MixVpr, MixVprConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import parameter_shapes


def test_it_starts_as_published() -> None:
    config = ModelConfig(aggregator="mixvpr", cross_image="none")
    assert config.descriptor_dim == 4096
    params = parameter_shapes(config).aggregator
    assert len(params.mix) == 4
    backbone = ViTConfig(dim=12, heads=1)
    params = MixVprConfig(channels=5, rows=3, depth=2).init(jax.random.key(0), backbone, (16, 16))
    assert isinstance(params, MixVpr)
    for mixer in params.mix:
        for layer in (mixer.fc1, mixer.fc2):
            assert layer.weight.shape == (256, 256)
            # The deviation of 65,536 draws is known to 0.3 %.
            np.testing.assert_allclose(jnp.std(layer.weight), 0.02, rtol=0.01)
            assert layer.bias is not None
            assert not layer.bias.any()
