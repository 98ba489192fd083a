"""CriSALAD visual place recognition in pure JAX.

The public names are listed in `__init__.pyi` and imported on first use, so that reading images
does not import jax, and making a model does not import the code for checkpoint formats.
"""

import os
from typing import Any

import lazy_loader

from crisalad_jax.utils.extras import missing_extra
from crisalad_jax.utils.version import VERSION

__version__ = VERSION
# OpenCV reads this limit when it is imported; see `data.images`.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**28))
_import, __dir__, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = [*_names, "__version__"]


def __getattr__(name: str) -> Any:
    """Import a public name from the module it lives in."""
    try:
        return _import(name)
    except ModuleNotFoundError as error:
        message = missing_extra(error, f"{__name__}.{name}")
        raise ModuleNotFoundError(message, name=error.name) from error
