"""Tables that match arrays of this package ("ours") with those of public files ("theirs").

A `Form` converts arrays by permuting values, so gradients convert like weights, and a round trip
is exact, except for the bias of attention keys: no output depends on it, and some forms drop it.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from crisalad_jax.config.checks import choose
from crisalad_jax.nn.aggregators.gem import START
from crisalad_jax.nn.backbones.dinov3 import rotary_periods
from crisalad_jax.nn.backbones.vgg import VggConfig


class Form(NamedTuple):
    """Two inverse functions: `ours` makes our arrays from those of a file, `theirs` the reverse."""

    ours: Callable[..., Sequence[np.ndarray]]
    theirs: Callable[..., Sequence[np.ndarray]]


SAME = Form(lambda x: (x,), lambda x: (x,))
FIRST = Form(lambda x: (x[0],), lambda x: (x[None],))


class Extra(NamedTuple):
    """An array of public files that no model here uses, stored so that a round trip is exact."""

    initial: Callable[[Any], np.ndarray]
    """Function of the model's configuration that makes the array if no file provided it."""
    form: Form = SAME
    optional: bool = False
    """Whether files may lack it, so that it is written only if it was read."""


class Absent(NamedTuple):
    """An array of this package that public files lack; reading fills it with `value`."""

    value: float


class Row(NamedTuple):
    """Corresponding arrays, or layers whose arrays are in a table; "#" stands for 0, 1, 2, ..."""

    ours: tuple[str, ...]
    theirs: tuple[str, ...]
    form: "Form | Extra | Absent | Rows"


Rows = tuple[Row, ...]
"""A table, whose rows are in the order of the arrays in public files."""


def side(area: int) -> int:
    """Return the side of a square grid of `area` cells, rounded down."""
    return math.isqrt(area)


def _mask_of(bias: np.ndarray) -> np.ndarray:
    """Make `bias_mask`: 0 for keys, and for all if every bias is 0, as published."""
    mask = np.full_like(bias, float(bias.any()))
    mask[len(mask) // 3 : 2 * len(mask) // 3] = 0
    return mask


def _by_cluster(rows: np.ndarray) -> np.ndarray:
    """Reorder rows of (channel, cluster) to rows of (cluster, channel)."""
    return rows.reshape(VggConfig().dim, -1, rows.shape[1]).swapaxes(0, 1).reshape(rows.shape)


def _by_channel(rows: np.ndarray) -> np.ndarray:
    return rows.reshape(-1, VggConfig().dim, rows.shape[1]).swapaxes(0, 1).reshape(rows.shape)


FORMS = {
    "same": SAME,
    "first": FIRST,
    "transposed": Form(lambda w: (w.T,), lambda w: (w.T,)),
    "class-token": Form(lambda x: (x[0, 0],), lambda x: (x[None, None],)),
    "positions": Form(
        lambda x: (x[0, 0], x[0, 1:].reshape(side(x.shape[1]), side(x.shape[1]), -1)),
        lambda first, grid: (
            np.concatenate([first[None], grid.reshape(-1, grid.shape[-1])])[None],
        ),
    ),
    "qkv": Form(lambda q, k, v: (np.concatenate([q, k, v]).T,), lambda w: np.split(w.T, 3)),
    "qkv-bias": Form(lambda q, k, v: (np.concatenate([q, k, v]),), lambda b: np.split(b, 3)),
    "qkv-layers": Form(
        lambda *x: (np.concatenate(x[::2]).T, np.concatenate(x[1::2])),
        lambda w, b: [*itertools.chain(*zip(np.split(w.T, 3), np.split(b, 3), strict=True))],
    ),
    "qv-bias": Form(
        lambda q, v: (np.concatenate([q, np.zeros_like(q), v]),),
        lambda b: (b[: len(b) // 3], b[2 * len(b) // 3 :]),
    ),
    "masked-bias": Form(lambda bias, mask: (bias * mask,), lambda bias: (bias, _mask_of(bias))),
    "pair": Form(lambda a, b: (np.concatenate([a, b]).T,), lambda w: np.split(w.T, 2)),
    "pair-bias": Form(lambda a, b: (np.concatenate([a, b]),), lambda b: np.split(b, 2)),
    "scores": Form(lambda w: (w[:, :, 0].T,), lambda w: (w.T[:, :, None],)),
}
"""Forms of single arrays, or of several that correspond to one, by name."""
_LAYERS = {
    "norm": SAME,
    "linear": FORMS["transposed"],
    "pointwise": Form(lambda w: (w[:, :, 0, 0].T,), lambda w: (w.T[:, :, None, None],)),
    "conv": Form(lambda w: (w.transpose(2, 3, 1, 0),), lambda w: (w.transpose(3, 2, 0, 1),)),
    # A transposed convolution, whose torch weight begins with the input channels.
    "upconv": Form(lambda w: (w.transpose(2, 3, 0, 1),), lambda w: (w.transpose(2, 3, 0, 1),)),
    "depthwise": Form(
        lambda w: (w[:, 0].transpose(1, 2, 0),), lambda w: (w.transpose(2, 0, 1)[:, None],)
    ),
    "patches": Form(
        lambda w: (w.transpose(2, 3, 1, 0).reshape(-1, w.shape[0]),),
        lambda w: (w.reshape(side(len(w) // 3), side(len(w) // 3), 3, -1).transpose(3, 2, 0, 1),),
    ),
    # Before whitening, hloc's descriptor has the first channel of all clusters, then the second.
    "hloc-whitening": Form(lambda w: (_by_cluster(w.T),), lambda w: (_by_channel(w).T,)),
}
"""Forms of the weights of layers, which may have a bias, by kind of layer."""


def _zeros(shape: Callable[[Any], tuple[int, ...]], form: Form = SAME) -> Extra:
    """Return an extra that is zeros if no file had it; the configuration gives its shape."""
    return Extra(lambda config: np.zeros(shape(config), np.float32), form)


def _width(config: Any) -> tuple[int, ...]:
    return (config.backbone.dim,)


def _mask_shape(config: Any) -> tuple[int, ...]:
    return (1, config.backbone.dim)


def _patch_numbers(config: Any) -> int:
    return 3 * config.backbone.patch_size**2


def _published_periods(config: Any) -> np.ndarray:
    """Return a head's periods as DINOv3's public files store them, rounded to bfloat16."""
    periods = rotary_periods(config.backbone.dim // config.backbone.heads)
    return np.asarray(periods.astype(jnp.bfloat16), np.float32)


EXTRAS = {
    "extra-count": Extra(lambda config: np.zeros((), np.int64)),
    "extra-dustbin": _zeros(lambda config: ())._replace(optional=True),
    "extra-levels": _zeros(lambda config: (config.aggregator.levels,)),
    "extra-mask": _zeros(_mask_shape),
    "extra-ones": Extra(lambda config: np.ones(_width(config), np.float32)),
    "extra-zeros": _zeros(_width),
    "extra-first-mask": _zeros(_mask_shape, FIRST),
    "extra-periods": Extra(_published_periods),
    # SAGE's unused branch: two layers, as wide as published.
    "extra-branch-0": _zeros(lambda config: (config.aggregator.hidden, config.backbone.dim, 1, 1)),
    "extra-branch-1": _zeros(lambda config: (config.aggregator.hidden,)),
    "extra-branch-2": _zeros(lambda config: (192, config.aggregator.hidden, 1, 1)),
    "extra-branch-3": _zeros(lambda config: (192,)),
    # From Pair-VPR's first training stage: the prediction of masked pixels, and a copy of the
    # positions with a row for the class token.
    "extra-decoder-mask": _zeros(lambda config: (1, 1, config.aggregator.width)),
    "extra-decoder-positions": _zeros(
        lambda config: (1 + config.aggregator.positions, config.aggregator.width)
    ),
    "extra-pixels-weight": _zeros(lambda config: (_patch_numbers(config), config.aggregator.width)),
    "extra-pixels-bias": _zeros(lambda config: (_patch_numbers(config),)),
}
"""Arrays that public files have but no descriptor needs, by name."""
ABSENT = {
    "absent-zero": Absent(0.0),
    "absent-one": Absent(1.0),
    "absent-exponent": Absent(START),
}
"""Arrays that public files lack, by name."""


def read_tables(texts: Mapping[str, str], known: Mapping[str, Rows]) -> dict[str, Rows]:
    """Parse tables, each of which may include `known` and earlier ones; return all, by name."""
    bias = Row(("bias",), ("bias",), SAME)
    tables: dict[str, Rows] = {
        name: (Row(("weight",), ("weight",), form), bias) for name, form in _LAYERS.items()
    }
    tables |= known
    for name, text in texts.items():
        tables[name] = read_table(text, tables)
    return tables


def read_table(text: str, tables: Mapping[str, Rows]) -> Rows:
    """Parse a table of lines OURS THEIRS FORM; "+ PREFIX+ TABLE" includes another table's rows."""
    kinds = {**FORMS, **EXTRAS, **ABSENT, **tables}
    rows: list[Row] = []
    for line in filter(None, text.splitlines()):
        ours, theirs, form = line.split()
        if ours == "+":
            before = theirs.removesuffix("+")
            rows += [
                row._replace(theirs=tuple(before + name for name in row.theirs))
                for row in choose("rows, table", form, tables)
            ]
        else:
            rows.append(
                Row(
                    tuple(ours.split(",")),
                    tuple(theirs.split(",")),
                    choose("rows, form", form, kinds),
                )
            )
    return tuple(rows)


def expand(rows: Rows, names: Iterable[str], ours: str = "", theirs: str = "") -> Iterator[Row]:
    """Yield the rows of a model's arrays, and of the extra arrays of its layers.

    Rows of arrays that the model lacks are left out; rows with "#" are repeated for each number.

    Args:
        rows: the table.
        names: names of the model's arrays, with numbered blocks.
        ours: prefix to add to this package's names in the table.
        theirs: prefix to add to the public files' names in the table.
    """
    parts = (itertools.accumulate(name.split("."), "{}.{}".format) for name in names)
    return _expand(rows, set(itertools.chain.from_iterable(parts)), ours, theirs)


def _expand(rows: Rows, known: set[str], ours: str, theirs: str) -> Iterator[Row]:
    for row in rows:
        for number in map(str, itertools.count() if "#" in row.ours[0] else [0]):
            here = tuple(ours + name.replace("#", number) for name in row.ours)
            there = tuple(theirs + name.replace("#", number) for name in row.theirs)
            if here[0] not in known and not isinstance(row.form, Extra):
                break
            if isinstance(row.form, Form | Extra | Absent):
                yield Row(here, there, row.form)
            else:
                yield from _expand(row.form, known, f"{here[0]}.", f"{there[0]}.")


def first_names(rows: Rows, ours: str = "", theirs: str = "") -> dict[str, str]:
    """Map this package's names to public ones: the first pair of each row, with 0 for "#"."""
    named: dict[str, str] = {}
    for row in rows:
        here, there = (
            prefix + names[0].replace("#", "0")
            for prefix, names in ((ours, row.ours), (theirs, row.theirs))
        )
        if isinstance(row.form, Form | Extra | Absent):
            named[here] = there
        else:
            named |= first_names(row.form, f"{here}.", f"{there}.")
    return named
