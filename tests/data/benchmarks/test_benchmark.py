"""Positives by distance, where rounding could decide."""

from fractions import Fraction

import numpy as np
import pytest

from crisalad_jax.data.benchmarks.benchmark import within


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("radius", [25.0, 20.1])
def test_the_edge_of_the_radius_is_exact_among_utm_coordinates(axis, radius):
    """Against rational numbers: the points nearest to both edges, of which some lie just beyond."""
    generator = np.random.default_rng(0)
    # Centimetres, as names have them.
    centres = np.append(generator.integers(20_000_000, 80_000_000, 40) / 100, 500000.1)
    edges = np.concatenate([centres - radius, centres + radius])
    line = np.concatenate([edges, np.nextafter(edges, 0), np.nextafter(edges, np.inf)])
    database, queries = np.full((len(line), 2), 4.5e6), np.full((len(centres), 2), 4.5e6)
    database[:, axis], queries[:, axis] = line, centres
    reached = 0
    for centre, found in zip(centres, within(database, queries, radius), strict=True):
        away = [abs(Fraction(place) - Fraction(centre)) for place in line]
        assert found.tolist() == [i for i, each in enumerate(away) if each <= Fraction(radius)]
        reached += len(found)
    # Both edges of each, and neither all nor none of the points about them.
    assert 2 * len(centres) <= reached < len(line)
