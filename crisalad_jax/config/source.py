"""Digest the source code of parts, to detect that a name stands for another part."""

import ast
import functools
import hashlib
import inspect
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

from crisalad_jax.config.parts import Part, parts_of


def source_digest(part: type[Part]) -> str | None:
    """Compute the digest of the source code that defines a part; None where there is no code.

    The code is the part's module and, in a package, its sibling modules. Methods that were assigned
    from other modules count too. Comments, docstrings and layout do not.
    """
    files = _files_of(part)
    if files is None:
        return None
    return hashlib.sha256("".join(map(_file_digest, files)).encode()).hexdigest()


def _files_of(part: type[Part]) -> list[pathlib.Path] | None:
    """List the files of the code that defines a part; None where there is no code."""
    base = part.registry.base
    classes = [each for each in part.__mro__ if issubclass(each, base) and each is not base]
    files: set[pathlib.Path] = set()
    # How a part prints changes no descriptor, and `Part` sets it from a module of this package.
    # `__replace__` is the standard library's, which Python 3.13 gives to dataclasses.
    unrelated = ("__repr__", "__replace__")
    methods = [f for each in classes for name, f in vars(each).items() if name not in unrelated]
    for member in [part, *methods]:
        file = _file_of(member)
        if member is part and file is None:
            return None
        if file is not None and file.is_file():
            beside = file.parent.glob("*.py") if (file.parent / "__init__.py").exists() else [file]
            files.update(beside)
    return sorted(files)


def _file_of(member: Any) -> pathlib.Path | None:
    if inspect.isclass(member):
        try:
            return pathlib.Path(inspect.getfile(member))
        except (TypeError, OSError):  # defined in a console
            return None
    code = getattr(inspect.unwrap(member), "__code__", None) if callable(member) else None
    # Methods that dataclasses generate have no file.
    return (
        None if code is None or code.co_filename.startswith("<") else pathlib.Path(code.co_filename)
    )


@functools.cache
def _file_digest(path: pathlib.Path) -> str:
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not _is_text(line)]  # pyright: ignore
    return hashlib.sha256("\n".join(_tokens(tree)).encode()).hexdigest()


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _tokens(node: Any) -> Iterator[str]:
    """Yield the tokens of a syntax tree; skip empty fields, which newer Pythons add."""
    if isinstance(node, ast.AST):
        yield type(node).__name__
        for name, value in ast.iter_fields(node):
            if value is not None and value != []:
                yield name
                yield from _tokens(value)
    elif isinstance(node, list):
        yield "["
        for item in node:
            yield from _tokens(item)
        yield "]"
    else:
        yield repr(node)


Sources = dict[str, tuple[str, str | None]]


def sources_of(config: Any) -> Sources:
    """Return the name and the source's digest of every part in a configuration."""
    return {
        field: (part.part_name, source_digest(type(part)))
        for field, part in parts_of(config).items()
    }


def source_bytes_of(config: Any) -> dict[str, str]:
    """Return a digest of the bytes of every part's source, which is quick to compare."""
    digests = {}
    for field, part in parts_of(config).items():
        files = _files_of(type(part)) or []
        digests[field] = hashlib.sha256(b"".join(map(_bytes_digest, files))).hexdigest()
    return digests


@functools.cache
def _bytes_digest(path: pathlib.Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()


def changed_sources(
    config: Any,
    recorded: Mapping[str, Any],
    same_version: bool,
    recorded_bytes: Mapping[str, Any] | None = None,
) -> list[str]:
    """Return the parts whose source differs from the recorded one, as "field name".

    Built-in parts of another version of this package are not compared: the package's tests check
    that they do the same. Sources of the bytes in `recorded_bytes` are the same, and not parsed.
    """
    same_bytes = recorded_bytes and source_bytes_of(config)
    changed = []
    for field, part in parts_of(config).items():
        name, digest = recorded.get(field, (None, None))
        built_in = type(part).__module__.startswith("crisalad_jax.")
        if name != part.part_name or digest is None or (built_in and not same_version):
            continue
        if recorded_bytes and same_bytes and recorded_bytes.get(field) == same_bytes[field]:
            continue
        if digest != source_digest(type(part)):
            changed.append(f"{field} {name}")
    return changed
