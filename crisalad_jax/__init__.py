"""CriSALAD visual place recognition in pure JAX.

The public names are listed once, in `__init__.pyi`, and imported when they are first used, so that
reading pictures takes no jax and a model no file formats.
"""

import ast
import importlib
import os
import pathlib
from typing import Any

from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.version import VERSION

__version__ = VERSION
# OpenCV reads this limit when it is imported; see `data.opencv`.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))


def _homes() -> dict[str, tuple[str, str | None]]:
    """Read the public names from the stub: the module of each, and its name there."""
    stub = ast.parse(pathlib.Path(__file__).with_suffix(".pyi").read_bytes())
    homes: dict[str, tuple[str, str | None]] = {}
    for node in stub.body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module != "typing":
            for alias in node.names:
                module = f"{node.module}.{alias.name}"
                is_module = node.module == __name__
                home = (module, None) if is_module else (node.module, alias.name)
                homes[alias.asname or alias.name] = home
    return homes


_HOMES = _homes()
__all__ = sorted([*_HOMES, "__version__"])


def __getattr__(name: str) -> Any:
    """Import a public name from the module it lives in."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    try:
        home = importlib.import_module(module)
    except ModuleNotFoundError as error:
        message = missing_extra(error, f"{__name__}.{name}")
        raise ModuleNotFoundError(message, name=error.name) from error
    return home if attribute is None else getattr(home, attribute)


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
