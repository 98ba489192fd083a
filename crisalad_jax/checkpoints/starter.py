"""The models in this package, available without a download: a small one, and baselines.

docs/starter.md describes how the small one was trained, only on rendered images, and its recall.
The baselines, histograms of oriented gradients ("hog") and SeqSLAM's thumbnails, have no
parameters: their files hold only a configuration. All files are under the licence of this package,
and none of these models counts as a published one.
"""

import os
import pathlib

from crisalad_jax.utils.files import real_path

NAME = "starter"
"""Name of the small model, for `--weights` and `load`."""
FILE = pathlib.Path(__file__).with_name(f"{NAME}.safetensors")
FILES = {name: FILE.with_stem(name) for name in (NAME, "starter-1", "hog", "thumbnail")}
"""The files of all models in this package by their names."""
BEST = "megaloc"
"""The published model with the best recall, which a warning recommends."""


def named(weights: str | os.PathLike[str]) -> str:
    """Return the name to print for a weight file: that of a model in this package, or its path."""
    names = (name for name, file in FILES.items() if file == pathlib.Path(weights))
    return next(names, os.fspath(weights))


def recorded(weights: str | os.PathLike[str]) -> str:
    """Return what a map records as its weights: a path, or the name of a model in this package.

    A name remains valid on another machine, where the package is at another path.
    """
    path = real_path(pathlib.Path(weights))
    if os.fspath(weights) in FILES and not path.exists():
        return os.fspath(weights)
    names = (name for name, file in FILES.items() if real_path(file) == path)
    return next(names, str(path))


def resolved(record: str) -> pathlib.Path:
    """Return the weight file that a map has recorded; the inverse of `recorded`."""
    return FILES.get(record, pathlib.Path(record))
