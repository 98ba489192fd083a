"""Research with the core alone: run in an environment, or a simulation of one, without extras."""

import pathlib
import sys
import tempfile

import jax
import jax.numpy as jnp
import numpy as np

import crisalad_jax as cj


def main() -> None:
    """Make a model, train it by a step of one's own, save it, load it, and describe pictures."""
    import cv2

    folder = pathlib.Path(tempfile.mkdtemp())
    generator = np.random.default_rng(0)
    for number in range(4):
        picture = generator.integers(0, 256, (60, 80, 3), np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), picture)

    config = cj.recipe("tiny").model
    params = cj.init_crisalad(jax.random.key(0), config)
    trainable, frozen = cj.split_params(params, config, "head,-adapters")
    images = jnp.asarray(generator.integers(0, 256, (4, *config.image_size, 3), np.uint8))
    labels = jnp.array([0, 0, 1, 1])

    @jax.jit
    def step(trainable):
        def loss(trainable):
            model = cj.merge_params(trainable, frozen, config)
            descriptors = cj.describe(model, images, config)
            return cj.metric_loss(descriptors, labels).loss

        value, gradient = jax.value_and_grad(loss)(trainable)
        return jax.tree.map(lambda leaf, change: leaf - 0.01 * change, trainable, gradient), value

    losses = []
    for _ in range(3):
        trainable, value = step(trainable)
        losses.append(float(value))
    assert losses[-1] < losses[0], losses

    cj.save_weights(
        folder / "weights.safetensors", cj.Model(cj.merge_params(trainable, frozen, config), config)
    )
    loaded, config = cj.load(folder / "weights.safetensors")
    found = cj.extract(cj.Model(loaded, config), folder, folder / "descriptors.npy")
    names, descriptors = found.names, found.descriptors
    assert names == [f"{number}.png" for number in range(4)]
    assert descriptors.shape == (4, config.descriptor_dim)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, rtol=1e-5)
    nearest = cj.search(descriptors, descriptors, 1).indices[:, 0]
    assert nearest.tolist() == [0, 1, 2, 3]

    log_mass = jnp.log(jnp.full(3, 1 / 3))
    result = cj.sinkhorn.solve(jnp.eye(3), log_mass, log_mass, epsilon=0.1)
    assert bool(result.finite)
    extras = {"optax", "orbax", "numba", "matplotlib", "rich", "tyro", "torch", "h5py", "faiss"}
    assert not extras & sys.modules.keys(), extras & sys.modules.keys()


if __name__ == "__main__":
    main()
