"""Make docstrings fit for griffe and Markdown.

griffe knows the section `Examples:` alone, and Markdown takes <a, b> for a tag.
"""

import re
from typing import Any

import griffe


class ExampleSections(griffe.Extension):
    """Change every docstring before it is parsed."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Change one docstring."""
        if obj.docstring is not None:
            text = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
            obj.docstring.value = re.sub(r"<(\w+, \w+)>", r"&lt;\1&gt;", text)

    def on_class_instance(self, *, cls: griffe.Class, **kwargs: Any) -> None:
        """Let a registered class have the signature of the dataclass that it becomes."""
        names = [str(each.value).partition("(")[0] for each in cls.decorators]
        if any(name.endswith(".register") for name in names):
            cls.decorators.append(griffe.Decorator(_Dataclass(), lineno=None, endlineno=None))


class _Dataclass(griffe.Expr):
    """What griffe takes for `@dataclasses.dataclass`."""

    canonical_path = "dataclasses.dataclass"
