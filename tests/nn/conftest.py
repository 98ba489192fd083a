"""Kernels of accelerators, computed by JAX on any machine, and what several tests share."""

from collections.abc import Collection, Iterable
from typing import Any

import jax
import pytest

from crisalad_jax.nn import attention_pallas


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Runs a TPU's kernels without a TPU, and lists the shapes that they return."""
    called = []

    def call(*args: Any, **options: Any) -> Any:
        called.append(options["out_shape"])
        return original(*args, **options, interpret=True)

    original = attention_pallas.pl.pallas_call
    monkeypatch.setattr(attention_pallas.pl, "pallas_call", call)
    return called


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Puts XLA in cuDNN's place, which takes the same arguments; lists shapes and lengths."""
    asked = []

    def attend(q: jax.Array, *others: jax.Array, implementation: str, **options: Any) -> jax.Array:
        assert implementation == "cudnn"
        asked.append((q.shape, options["key_value_seq_lengths"] is not None))
        return original(q, *others, implementation="xla", **options)

    original = jax.nn.dot_product_attention
    monkeypatch.setattr(jax.nn, "dot_product_attention", attend)
    return asked


def slow_unless(quick: Collection[str], names: Iterable[str]) -> list[Any]:
    """Parameters of a test: all names, of which the quick ones alone run everywhere."""
    return [pytest.param(x, marks=() if x in quick else pytest.mark.slow) for x in names]
