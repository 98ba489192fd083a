"""Time ResNet's max pooling, forward and backward: ours, XLA's own gradient, and torch.

python scripts/bench/bench_pooling.py
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from tables import Study, Table, count, flags, leave, read
from timing import measured, race, ratio, times

# After timing, which says how many devices there are.
import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import torch  # isort: skip

from crisalad_jax.nn.convolutions import max_pool

MAPS = {"96 of 48 x 64 x 32": (96, 48, 64, 32), "16 of 112 x 112 x 64": (16, 112, 112, 64)}
"""Images x rows x columns x channels: `starter`'s first training, and a ResNet at 224 x 224."""
OURS, XLAS, TORCHS = "ours", "XLA's own gradient", "torch eager"


def by_xla(x: jax.Array) -> jax.Array:
    """Pool like `max_pool`, and leave the gradient to JAX."""
    margins = ((0, 0), (1, 1), (1, 1), (0, 0))
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), margins)


def contenders(shape: tuple[int, ...]) -> dict[str, Callable[[], Any]]:
    """Make calls that pool and take the gradient, and check that all three gradients agree."""
    generator = np.random.default_rng(0)
    images = np.maximum(generator.standard_normal(shape, np.float32), 0)  # as after a ReLU
    pooled = (shape[0], shape[1] // 2, shape[2] // 2, shape[3])
    change = generator.standard_normal(pooled, np.float32)

    def by(pool: Callable[[jax.Array], jax.Array]) -> Callable[[], jax.Array]:
        x, y = jnp.asarray(images), jnp.asarray(change)

        @jax.jit
        def both(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
            pooled, back = jax.vjp(pool, x)
            return pooled, back(y)[0]

        return lambda: jax.block_until_ready(both(x, y))[1]

    # Channels are last in memory, which torch's convolutions on a CPU also prefer.
    theirs = torch.from_numpy(images).permute(0, 3, 1, 2).requires_grad_()
    theirs_change = torch.from_numpy(change).permute(0, 3, 1, 2)

    def by_torch() -> torch.Tensor:
        pooled = torch.nn.functional.max_pool2d(theirs, 3, 2, 1)
        (gradient,) = torch.autograd.grad(pooled, theirs, theirs_change)
        return gradient

    calls = {OURS: by(lambda x: max_pool(x, 3, padding=1)), XLAS: by(by_xla), TORCHS: by_torch}
    expected = by_torch().permute(0, 2, 3, 1).numpy()
    for name in (OURS, XLAS):
        # Sums of up to four numbers, in different orders.
        np.testing.assert_allclose(calls[name](), expected, rtol=0, atol=1e-5, err_msg=name)
    return calls


def main() -> None:
    parser = flags((__doc__ or "").splitlines()[0], "docs/performance")
    parser.add_argument("--rounds", type=count, default=5)
    arguments = read(parser, "bench_pooling")
    values, rows = [], []
    for name, shape in MAPS.items():
        timed = race(contenders(shape), arguments.rounds, 3)
        for contender, one in timed.items():
            slower = times(ratio(one, timed[OURS]))
            values.append({"maps": name, "contender": contender, "ms": one.rounds})
            rows.append((name, contender, slower))
    caption = (
        "Max pooling, 3 x 3 with stride 2, forward and backward, float32, "
        f"{measured(arguments.rounds)}."
    )
    table = Table(("maps", "implementation", "time relative to ours"), rows, caption, 2)
    leave("bench_pooling", Study(table, values), arguments)


if __name__ == "__main__":
    main()
