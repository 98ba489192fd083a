"""The texts below the fields of a class, for `help` and for flags."""

import ast
import dataclasses
import functools
import inspect
import itertools
import textwrap
from collections.abc import Mapping
from typing import Any, Self, SupportsIndex, TypeVar

_T = TypeVar("_T")


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
        body = node.body if isinstance(node, ast.ClassDef) else []
        for line, below in itertools.pairwise(body):
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                text = _text(below)
                if text is not None:
                    docs[line.target.id] = text
    return docs


def _text(node: ast.stmt) -> str | None:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        value = node.value.value
        return inspect.cleandoc(value) if isinstance(value, str) else None
    return None
