"""How public classes print: their `repr` and their `help`."""

import ast
import dataclasses
import functools
import inspect
import itertools
import math
import pathlib
import textwrap
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, SupportsIndex, TypeVar

_T = TypeVar("_T")
_WIDTH = 88
"""Maximum characters in a line: what a notebook shows without a scroll bar."""
_FEW = 4
"""Maximum items of a collection shown in full; of a larger one only the first is shown."""


class _Style(NamedTuple):
    """How a class prints."""

    always: tuple[str, ...] = ()
    switch: tuple[Any, ...] = ()
    is_brief: bool = False


_STYLE = "__crisalad_style__"


def short_repr(*always: str, switch: tuple[Any, ...] = ()) -> Callable[[type[_T]], type[_T]]:
    """Return a decorator that makes `concise_repr` the `repr` of a configuration class.

    The `help` of the class then shows the docstrings below its fields, too.

    Args:
        *always: names of fields that are printed even at their defaults.
        switch: a field, the value at which it makes others unused, and their names (if omitted, all
            others). Unused fields are neither printed nor compared (`config.io.differences`).
    """
    return lambda cls: _print_in(_Style(always, switch), cls)


def brief(cls: type[_T]) -> type[_T]:
    """Give a result class a `repr` that shortens the value of each field to at most one line.

    Arrays print as type and shape, model parameters as their count, and collections of more than
    four items as the first item. `help` shows the docstrings below the fields.

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
    return _print_in(_Style(is_brief=True), cls)


def _print_in(style: _Style, cls: type[_T]) -> type[_T]:
    setattr(cls, _STYLE, style)
    cls.__repr__ = concise_repr  # pyright: ignore[reportAttributeAccessIssue]
    return with_field_docs(cls)


def _style_of(value: Any) -> _Style:
    return getattr(value, _STYLE, _Style())


def concise_repr(value: Any) -> str:
    """Format a value as the call that makes it, without fields that are unused or at defaults.

    A field with a part at its defaults prints as the part's name. Long calls take a line per field.

    Args:
        value: a dataclass, or a NamedTuple that `brief` decorates.

    Returns:
        For a configuration, valid Python once the classes that it names are imported.

    Example:
        >>> from crisalad_jax import CrossImageConfig, ModelConfig
        >>> print(ModelConfig(aggregator="gem", cross_image=CrossImageConfig(heads=4, layers=2)))
        ModelConfig(backbone='vit', aggregator='gem', cross_image=CrossImageConfig(heads=4))
    """
    return _write(value, _WIDTH)


def in_one_line(value: Any) -> str:
    """Format any value for a message: a configuration in one line, others as their first line."""
    first, *more = _write(value, math.inf).splitlines() or [""]
    return f"{first} ..." if more else first


def _write(value: Any, width: float) -> str:
    """Write a value in a line of this width, or else with a line for each field or tuple item."""
    name, parts = type(value).__qualname__, _fields
    if isinstance(value, tuple) and type(value).__repr__ is tuple.__repr__:
        name, parts = "", lambda values, each: (_write(item, each) for item in values)
    elif type(value).__repr__ is not concise_repr:
        return repr(value)
    line = f"{name}({', '.join(parts(value, math.inf))})"
    if not name and len(value) == 1:
        line = f"{line[:-1]},)"
    if len(line) <= width:
        return line
    lines = ",\n".join(parts(value, width - 4))
    return f"{name}(\n{textwrap.indent(lines, '    ')},\n)"


def _fields(value: Any, width: float) -> Iterator[str]:
    """Write the fields that are printed."""
    for name, each in _shown(value):
        if _style_of(value).is_brief:
            text = f"{name}={_short(each)}"
            yield text if len(text) <= width else f"{text[: int(width) - 4]} ..."
        elif hasattr(each, "part_name") and not list(_shown(each)):
            yield f"{name}={each.part_name!r}"
        else:
            yield f"{name}={_write(each, width - len(name) - 1)}"


def _short(value: Any) -> str:
    """Write a field of a `brief` class in one line."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None:
        return f"{dtype}{list(shape)}" if shape else str(value)
    if type(value).__repr__ is concise_repr:
        return _write(value, math.inf)
    if isinstance(value, pathlib.PurePath):
        return repr(str(value))
    if isinstance(value, float):  # four digits of a fraction, and all digits of metres
        return f"{value:.4g}" if abs(value) < 1000 else repr(value)
    if isinstance(value, Mapping):
        return _few("{}", len(value), (f"{k!r}: {_short(v)}" for k, v in value.items()))
    if hasattr(value, "_fields"):
        fields = (f"{name}={_short(each)}" for name, each in zip(value._fields, value, strict=True))
        return f"{type(value).__name__}({', '.join(fields)})"
    if isinstance(value, list | tuple):
        return _few("[]" if isinstance(value, list) else "()", len(value), map(_short, value))
    first, *more = repr(value).splitlines() or [""]
    return f"{first}, {more[-1]}" if more else first  # parameters: their class and count


def _few(ends: str, count: int, items: Iterator[str]) -> str:
    texts = list(itertools.islice(items, count if count <= _FEW else 1))
    if count > _FEW:
        texts.append(f"... {count - 1:,} more")
    return f"{ends[0]}{', '.join(texts)}{ends[1]}"


def _shown(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the fields that are printed."""
    if dataclasses.is_dataclass(value):
        defaults = {field.name: default_of(field) for field in fields_in_use(value)}
    else:
        defaults = dict.fromkeys(value._fields, dataclasses.MISSING) | value._field_defaults
    for name, default in defaults.items():
        each = getattr(value, name)
        # Arrays have no truth value.
        same = each is default or (not hasattr(each, "shape") and each == default)
        if name in _style_of(value).always or not same:
            yield name, each


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Return the default of a field; `dataclasses.MISSING` if it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def fields_in_use(config: Any) -> list[dataclasses.Field[Any]]:
    """List a configuration's fields, without those that its switch (`short_repr`) makes unused.

    Example:
        >>> from crisalad_jax import ProjectionConfig
        >>> [field.name for field in fields_in_use(ProjectionConfig(dim=0))]
        ['dim']
    """
    fields, switch = list(dataclasses.fields(config)), _style_of(config).switch
    if not switch or getattr(config, switch[0]) != switch[1]:
        return fields
    name, _, *unused = switch
    return [f for f in fields if f.name not in unused and (unused or f.name == name)]


def with_field_docs(cls: type[_T]) -> type[_T]:
    """Add the docstrings of a class's fields to what `help(cls)` shows, and return the class."""
    doc = _Doc(cls.__doc__ or "")
    doc.kind = cls
    cls.__doc__ = doc
    return cls


class _Doc(str):
    """A docstring that is completed when it is shown: reading sources would slow down imports.

    `help`, and `?` in a notebook, first call `expandtabs`.
    """

    kind: type

    def expandtabs(self, tabsize: SupportsIndex = 8) -> str:
        names = getattr(self.kind, "_fields", None)
        if names is None:
            names = [field.name for field in dataclasses.fields(self.kind)]
        texts = field_docs(self.kind)
        lines = (f"    {name}: {texts[name]}" for name in names if name in texts)
        fields = [line.replace("\n", "\n" + 8 * " ") for line in lines]
        heading = ["", "Attributes:"] if fields else []
        return "\n".join([inspect.cleandoc(str(self)), *heading, *fields]).expandtabs(tabsize)


@functools.cache
def field_docs(kind: type) -> Mapping[str, str]:
    """Return the docstrings of a dataclass's or NamedTuple's fields, inherited or not, by name."""
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
