"""A custom training loop with any optax optimiser, on pictures made in memory.

    python examples/training_loop.py

`cj.fit` is the complete loop, with batches, validation, early stopping and resumable files.
"""

import dataclasses

import jax
import numpy as np
import optax

import crisalad_jax as cj

PLACES, VIEWS, STEPS = 8, 2, 12


def main():
    """Train the whole of a small model for a few steps on one batch."""
    config = cj.recipe("tiny")
    model = dataclasses.replace(
        config.model,
        image_size=(70, 70),
        backbone=dataclasses.replace(config.model.backbone, dim=32, depth=1, heads=2),
    )
    config = dataclasses.replace(config, model=model, trainable="all")

    generator = np.random.default_rng(0)
    places = generator.normal(128, 30, (PLACES, 1, *model.image_size, 3))
    noise = generator.normal(0, 50, (PLACES, VIEWS, *model.image_size, 3))
    pictures = np.clip(places + noise, 0, 255).astype(np.uint8).reshape(-1, *model.image_size, 3)
    labels = np.repeat(np.arange(PLACES), VIEWS)

    optimiser = optax.adamw(optax.cosine_decay_schedule(5e-4, STEPS))
    static = cj.step_config(config, steps=STEPS, optimiser=optimiser)
    params = cj.init_crisalad(jax.random.key(0), model)
    state, frozen = cj.init_train_state(params, "all", static)
    step = cj.make_train_step(static)

    losses = []
    for number in range(STEPS):
        state, metrics = step(state, frozen, pictures, labels, jax.random.key(1))
        losses.append(float(metrics.loss))
        print(f"step {number + 1}: loss {losses[-1]:.4f}")
    trained = cj.merge_params(state.trainable, frozen, model)
    return losses, trained, model


if __name__ == "__main__":
    main()
