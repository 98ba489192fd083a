"""Make the packaged model from a run's weights: whiten its channels, and store it in float16.

    python scripts/starter.py RUN/last.safetensors WORLD/train

It writes crisalad_jax/checkpoints/starter.safetensors, and parity/goldens/starter.npz with the
model's output for two pictures, for comparison on other machines. Commit both.
"""

import argparse
import dataclasses
import pathlib

import jax.numpy as jnp
import numpy as np

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.weights import load_weights, save_weights
from crisalad_jax.data.images import list_images
from crisalad_jax.nn.aggregators.conv_ap import ConvAp, ConvApConfig
from crisalad_jax.nn.layers import Linear
from crisalad_jax.nn.model import Model, describe
from crisalad_jax.retrieval.describe import describe_files, prepare_image
from crisalad_jax.synthetic import View, render
from crisalad_jax.utils.files import atomic_path

GOLDEN = pathlib.Path(__file__).parents[1] / "parity" / "goldens" / "starter.npz"
SIZE = (192, 256)
"""Image size; docs/starter.md has the recalls at other sizes."""
SAMPLES = 2000


def whitened(model: Model, descriptors: np.ndarray) -> Model:
    """Whiten the channels of Conv-AP without a mean, by changing its linear layer.

    Afterwards, the second moments of the channels, over all regions of all images, are the identity
    matrix. No mean is subtracted, because it would have to be that of unit descriptors.
    """
    assert isinstance(model.config.aggregator, ConvApConfig)
    assert isinstance(model.params.aggregator, ConvAp)
    channels = model.config.aggregator.channels
    rows = descriptors.astype(np.float64).reshape(len(descriptors), channels, -1)
    rows = rows.transpose(0, 2, 1).reshape(-1, channels)
    values, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    turn = vectors * np.sqrt(values.mean() / values)  # the mean keeps weights in float16's range
    old = model.params.aggregator.channel_pool
    assert old.bias is not None
    weight, bias = (jnp.asarray(np.asarray(x) @ turn, "float32") for x in (old.weight, old.bias))
    params = dataclasses.replace(model.params, aggregator=ConvAp(Linear(weight, bias)))
    return Model(params, model.config)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("weights", type=pathlib.Path)
    parser.add_argument("images", type=pathlib.Path, help="rendered places, for the whitening")
    given = parser.parse_args()
    params, config = load_weights(given.weights)
    model = Model(params, dataclasses.replace(config, image_size=SIZE))
    files = list_images(given.images)
    drawn = np.random.default_rng(0).choice(len(files), SAMPLES, replace=False)
    descriptors = describe_files(model, [files[index] for index in sorted(drawn)])
    save_weights(starter.FILE, whitened(model, np.asarray(descriptors)), half=True)
    images = [render(7, View(), (60, 80), scenery) for scenery in ("street", "corridor")]
    params, config = load_weights(starter.FILE)
    prepared = np.stack([prepare_image(image, config) for image in images])
    descriptors = np.asarray(describe(params, prepared, config))
    with atomic_path(GOLDEN) as path:
        np.savez_compressed(path, images=np.stack(images), descriptors=descriptors)
    print(f"{starter.FILE}, and {GOLDEN}: {' x '.join(map(str, descriptors.shape))} dimensions")


if __name__ == "__main__":
    main()
