"""A custom Sinkhorn step: columns take at most their mass, and may take less.

A registered function can be used by name: in Python, in a configuration file, or in a flag.

    python examples/sinkhorn_step.py
    crisalad train --plugin examples/sinkhorn_step.py --model.aggregator.sinkhorn.step capped ...
"""

import jax
import jax.numpy as jnp

import crisalad_jax as cj


@cj.register_step("capped")
def capped(problem, potentials):
    """Lower the columns that are too full, then meet the rows' marginals.

    Potentials are dual variables over epsilon: the plan is exp(kernel + row + column).
    """
    column = jnp.minimum(problem.log_nu - problem.lse_rows(potentials.row), 0)
    row = problem.log_mu - problem.lse_columns(column)
    return cj.sinkhorn.Potentials(row, column)


def main():
    """Send eight rows of mass 1 to four columns that can take 3 each."""
    scores = jax.random.normal(jax.random.key(0), (8, 4)) + jnp.array([2.0, 0.0, 0.0, 0.0])
    log_mu, log_nu = jnp.zeros(8), jnp.log(jnp.full(4, 3.0))
    config = cj.SinkhornConfig(step="capped", iterations=100)

    def score(scores):
        result = cj.sinkhorn.solve(scores, log_mu, log_nu, config=config)
        return (jnp.exp(result.log_plan) * scores).sum(), result

    (value, result), gradient = jax.value_and_grad(score, has_aux=True)(scores)
    masses = jnp.exp(result.log_plan).sum(axis=0)
    print("masses of the columns:", ", ".join(f"{mass:.3f}" for mass in masses))
    print(f"score of the plan: {value:.3f}, norm of its gradient: {jnp.linalg.norm(gradient):.3f}")
    return result, gradient


if __name__ == "__main__":
    main()
