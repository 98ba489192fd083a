"""How public classes print: their `repr`, their HTML in a notebook, and their `help`."""

import ast
import dataclasses
import functools
import html
import inspect
import itertools
import math
import pathlib
import textwrap
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self, SupportsIndex, TypeVar

_T = TypeVar("_T")
_WIDTH = 88
"""Characters of a line, at most: as a notebook shows without a scroll bar."""
_FEW = 4
"""Number of items in a collection that is shown whole; of a larger one the first is shown."""
_SWITCH = "__short_repr_switch__"
_ALWAYS = "__short_repr_always__"
_BRIEF = "__short_repr_brief__"


def short_repr(*always: str, switch: tuple[Any, ...] = ()) -> Callable[[type[_T]], type[_T]]:
    """Return a decorator that gives a configuration the `repr` of `concise_repr`.

    Its `help` shows the texts below its fields.

    Args:
        *always: fields that are printed at their defaults too.
        switch: a field, its value with which others are not in use, and the names of these; by
            default of all others. They are left out, and not compared (`config.io.differences`).
    """

    def decorate(cls: type[_T]) -> type[_T]:
        setattr(cls, _ALWAYS, always)
        setattr(cls, _SWITCH, switch)
        cls.__repr__ = concise_repr  # pyright: ignore[reportAttributeAccessIssue]
        return with_field_docs(cls)

    return decorate


def brief(cls: type[_T]) -> type[_T]:
    """Give a class of results a `repr` of a line for each field, whatever its size.

    Arrays print as type and shape, parameters as their number, collections as their first items. A
    notebook shows the same as a table, and `help` the texts below the fields.

    Args:
        cls: a dataclass or NamedTuple.

    Example:
        >>> import numpy as np
        >>> from typing import NamedTuple
        >>> @brief
        ... class Found(NamedTuple):
        ...     names: list[str]
        ...     descriptors: np.ndarray
        >>> Found([f"{i}.jpg" for i in range(9)], np.zeros((9, 256)))
        Found(names=['0.jpg', ... 8 more], descriptors=float64[9, 256])
    """
    setattr(cls, _BRIEF, True)
    cls.__repr__ = concise_repr  # pyright: ignore[reportAttributeAccessIssue]
    cls._repr_html_ = _html  # pyright: ignore[reportAttributeAccessIssue]
    return with_field_docs(cls)


def concise_repr(value: Any) -> str:
    """Write a value as the call that makes it, without fields that change nothing.

    Those are fields at their defaults, and fields that are not in use. A part at its defaults is
    its name. Long calls take a line for each field.

    Args:
        value: a dataclass, or a NamedTuple that is `brief`.

    Returns:
        For a configuration Python, where the classes that it names are imported.

    Example:
        >>> from crisalad_jax import CrossImageConfig, ModelConfig
        >>> print(ModelConfig(aggregator="gem", cross_image=CrossImageConfig(layers=0, heads=4)))
        ModelConfig(backbone='vit', aggregator='gem', cross_image=CrossImageConfig(layers=0))
    """
    return _write(value, "", 0, _WIDTH)


def in_one_line(value: Any) -> str:
    """Write any value for a message: a configuration in one line, of other values the first."""
    first, *more = _write(value, "", 0, math.inf).splitlines() or [""]
    return f"{first} ..." if more else first


def _write(value: Any, before: str, indent: int, width: float) -> str:
    """Write `before` and a value; the line has `indent` characters already."""
    if type(value).__repr__ is not concise_repr:
        return f"{before}{value!r}"
    shown = list(_shown(value))
    name = getattr(value, "part_name", None)
    if before and name and not shown:
        return f"{before}{name!r}"
    opening, inner = f"{before}{type(value).__qualname__}(", indent + 4
    if hasattr(value, _BRIEF):
        texts = [f"{field}={_short(each)}" for field, each in shown]
        lines = [_clipped(text, _WIDTH - inner) for text in texts]
    else:
        texts = [_write(each, f"{field}=", 0, math.inf) for field, each in shown]
        lines = [_write(each, f"{field}=", inner, width) for field, each in shown]
    line = f"{opening}{', '.join(texts)})"
    if indent + len(line) <= width:
        return line
    fields = "".join(f"{' ' * inner}{line},\n" for line in lines)
    return f"{opening}\n{fields}{' ' * indent})"


def _short(value: Any) -> str:
    """Write a field of a `brief` class in one line."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None:
        return f"{dtype}{list(shape)}" if shape else str(value)
    if type(value).__repr__ is concise_repr:
        return _write(value, "", 0, math.inf)
    if isinstance(value, pathlib.PurePath):
        return repr(str(value))
    if isinstance(value, float):  # a fraction has four digits, and metres all of theirs
        return f"{value:.4g}" if abs(value) < 1000 else repr(value)
    if isinstance(value, Mapping):
        return _few("{}", len(value), (f"{k!r}: {_short(v)}" for k, v in value.items()))
    if hasattr(value, "_fields"):
        fields = (f"{name}={_short(each)}" for name, each in zip(value._fields, value, strict=True))
        return f"{type(value).__name__}({', '.join(fields)})"
    if isinstance(value, list | tuple):
        return _few("[]" if isinstance(value, list) else "()", len(value), map(_short, value))
    first, *more = repr(value).splitlines() or [""]
    return f"{first}, {more[-1]}" if more else first  # parameters: their class and their number


def _few(ends: str, count: int, items: Iterator[str]) -> str:
    texts = list(itertools.islice(items, count if count <= _FEW else 1))
    if count > _FEW:
        texts.append(f"... {count - 1:,} more")
    return f"{ends[0]}{', '.join(texts)}{ends[1]}"


def _clipped(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 4]} ..."


def _html(self: Any) -> str:
    rows = (
        f"<tr><th>{field}</th><td>{html.escape(_clipped(_short(value), _WIDTH))}</td></tr>"
        for field, value in _shown(self)
    )
    return f"<table><caption>{type(self).__qualname__}</caption>{''.join(rows)}</table>"


def _shown(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the fields that are printed."""
    if dataclasses.is_dataclass(value):
        always = getattr(value, _ALWAYS, ())
        defaults = {field.name: default_of(field) for field in fields_in_use(value)}
    else:
        always = ()
        defaults = dict.fromkeys(value._fields, dataclasses.MISSING) | value._field_defaults
    for name, default in defaults.items():
        each = getattr(value, name)
        # Arrays have no truth value.
        same = each is default or (not hasattr(each, "shape") and each == default)
        if name in always or not same:
            yield name, each


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Return the default of a field; `dataclasses.MISSING` without one."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def fields_in_use(config: Any) -> list[dataclasses.Field[Any]]:
    """List a configuration's fields without those that its switch puts out of use.

    Example:
        >>> from crisalad_jax import CrossImageConfig
        >>> [field.name for field in fields_in_use(CrossImageConfig(layers=0))]
        ['layers']
    """
    fields, switch = list(dataclasses.fields(config)), getattr(config, _SWITCH, ())
    if not switch or getattr(config, switch[0]) != switch[1]:
        return fields
    name, _, *unused = switch
    return [f for f in fields if f.name not in unused and (unused or f.name == name)]


def with_field_docs(cls: type[_T]) -> type[_T]:
    """Let a class's docstring end with the texts below its fields."""
    cls.__doc__ = _Doc(cls.__doc__ or "", cls)
    return cls


class _Doc(str):
    """A docstring that is put together when it is read: to read sources would slow an import.

    `help` takes the docstring of an abstract class out of its namespace, without `__get__`, and
    begins with `expandtabs`.
    """

    def __new__(cls, text: str, kind: type) -> Self:
        doc = super().__new__(cls, text)
        doc.kind = kind
        return doc

    kind: type

    def expandtabs(self, tabsize: SupportsIndex = 8) -> str:
        return self.__get__(None, self.kind).expandtabs(tabsize)

    def __get__(self, instance: Any, owner: type) -> str:
        names = getattr(self.kind, "_fields", None)
        if names is None:
            names = [field.name for field in dataclasses.fields(self.kind)]
        texts = field_docs(self.kind)
        lines = (f"    {name}: {texts[name]}" for name in names if name in texts)
        fields = [line.replace("\n", "\n" + 8 * " ") for line in lines]
        if not fields:
            return str(self)
        return "\n".join([inspect.cleandoc(str(self)), "", "Attributes:", *fields])


@functools.cache
def field_docs(kind: type) -> Mapping[str, str]:
    """Read the texts below the fields of a dataclass or NamedTuple and of its base classes."""
    docs: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(each) and not hasattr(each, "_fields"):
            continue
        try:
            source = textwrap.dedent(inspect.getsource(each))
        except (OSError, TypeError):  # made in a console
            continue
        (node,) = ast.parse(source).body
        for line, below in itertools.pairwise(getattr(node, "body", ())):
            text = below.value if isinstance(below, ast.Expr) else None
            if isinstance(line, ast.AnnAssign) and isinstance(text, ast.Constant):
                docs[ast.unparse(line.target)] = inspect.cleandoc(str(text.value))
    return docs
