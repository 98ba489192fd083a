"""Forms: conversions between a torch module's arrays and ours, and the tables that use them.

Every entry of a table permutes numbers. Gradients can therefore be converted like weights, and a
round trip gives the same bits.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np


class Form(NamedTuple):
    """Two functions, inverse to each other, between our arrays and theirs."""

    ours: Callable[..., tuple[np.ndarray, ...]]
    theirs: Callable[..., tuple[np.ndarray, ...]]


class Entry(NamedTuple):
    """One line of a table: our arrays and theirs that correspond. Blocks are numbered in both."""

    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    form: Form


SAME = Form(lambda x: (x,), lambda x: (x,))


class Extra(NamedTuple):
    """An array of theirs that no model of ours uses, stored so that a round trip is exact."""

    name: str
    theirs: str
    shape: tuple[int, ...]
    dtype: type
    value: float | tuple[float, ...] = 0.0
    """Its initial value, for a model that was not read from such a file."""
    form: Form = SAME

    def stored(self, extras: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the array as their files have it; an initial value takes no memory."""
        initial = np.broadcast_to(np.asarray(self.value, self.dtype), self.shape)
        return self.form.theirs(extras.get(self.name, initial))[0]


class Absent(NamedTuple):
    """An array of ours that no output needs and their files leave out: filled when read."""

    ours: str
    value: float


LINEAR = Form(lambda w: (w.T,), lambda w: (w.T,))
FIRST = Form(lambda x: (x[0],), lambda x: (x[None],))
CLASS_TOKEN = Form(lambda x: (x[0, 0],), lambda x: (x[None, None],))
POINTWISE = Form(lambda w: (w[:, :, 0, 0].T,), lambda w: (w.T[:, :, None, None],))
CONV = Form(lambda w: (w.transpose(2, 3, 1, 0),), lambda w: (w.transpose(3, 2, 0, 1),))
# Of a transposed convolution, whose torch weight begins with the channels that come in.
UPCONV = Form(lambda w: (w.transpose(2, 3, 0, 1),), lambda w: (w.transpose(2, 3, 0, 1),))
DEPTHWISE = Form(
    lambda w: (w[:, 0].transpose(1, 2, 0),), lambda w: (w.transpose(2, 0, 1)[:, None],)
)


def side(area: int) -> int:
    """Return the side of a square grid."""
    return math.isqrt(area)


PATCHES = Form(
    lambda w: (w.transpose(2, 3, 1, 0).reshape(-1, w.shape[0]),),
    lambda w: (w.reshape(side(len(w) // 3), side(len(w) // 3), 3, -1).transpose(3, 2, 0, 1),),
)
POSITIONS = Form(
    lambda x: (x[0, 0], x[0, 1:].reshape(side(x.shape[1]), side(x.shape[1]), -1)),
    lambda first, grid: (np.concatenate([first[None], grid.reshape(-1, grid.shape[-1])])[None],),
)
QKV = Form(lambda q, k, v: (np.concatenate([q, k, v]).T,), lambda w: tuple(np.split(w.T, 3)))
PAIR = Form(lambda a, b: (np.concatenate([a, b]).T,), lambda w: tuple(np.split(w.T, 2)))
PAIR_BIAS = Form(lambda a, b: (np.concatenate([a, b]),), lambda b: tuple(np.split(b, 2)))
QKV_BIAS = Form(lambda q, k, v: (np.concatenate([q, k, v]),), lambda b: tuple(np.split(b, 3)))


Lines = Iterator[Entry | Extra | Absent]
"""A table of names, in the public order."""


def affine(ours: str, theirs: str, form: Form, *, bias: bool = True) -> Iterator[Entry]:
    """Yield the lines of a weight and, if it has one, a bias."""
    yield Entry((f"{ours}.weight",), (f"{theirs}.weight",), form)
    if bias:
        yield Entry((f"{ours}.bias",), (f"{theirs}.bias",), SAME)


def affines(ours: str, theirs: str, layers: Mapping[str, Form]) -> Iterator[Entry]:
    """Yield the lines of layers that have the same names in both, after a prefix each."""
    for name, form in layers.items():
        yield from affine(f"{ours}{name}", f"{theirs}{name}", form)


def batch_norm_lines(ours: str, theirs: str) -> Lines:
    """Yield the lines of a batch norm: gain, shift, statistics, and the count of batches."""
    yield from affine(ours, theirs, SAME)
    for name in ("running_mean", "running_var"):
        yield Entry((f"{ours}.{name}",), (f"{theirs}.{name}",), SAME)
    count = "num_batches_tracked"
    yield Extra(f"{ours}.{count}", f"{theirs}.{count}", (), np.int64)


def transformer_layer(ours: str, theirs: str) -> Iterator[Entry]:
    """Yield the lines of one layer, under torch.nn.TransformerEncoderLayer's names."""
    yield from torch_attention(f"{ours}.attn", f"{theirs}.self_attn")
    layers = {"linear1": LINEAR, "linear2": LINEAR, "norm1": SAME, "norm2": SAME}
    yield from affines(f"{ours}.", f"{theirs}.", layers)


def torch_attention(ours: str, theirs: str) -> Iterator[Entry]:
    """Yield the lines of one attention, under torch.nn.MultiheadAttention's names."""
    for leaf, form in (("weight", LINEAR), ("bias", SAME)):
        yield Entry((f"{ours}.qkv.{leaf}",), (f"{theirs}.in_proj_{leaf}",), form)
    yield from affine(f"{ours}.proj", f"{theirs}.out_proj", LINEAR)
