"""The models in this package, available without a download: a small one, and baselines.

docs/starter.md says how the small one was trained, only on rendered images, and what it recalls.
Histograms of oriented gradients and SeqSLAM's thumbnails have no parameters: their files hold only
a configuration. None of them is a published model: the files are part of the package, under its
licence.
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
"""The published model with the best recall, which a warning names."""


def named(weights: str | os.PathLike[str]) -> str:
    """Return what to call a weight file in output: its path, or the name of a model here."""
    names = (name for name, file in FILES.items() if file == pathlib.Path(weights))
    return next(names, os.fspath(weights))


def recorded(weights: str | os.PathLike[str]) -> str:
    """Return what a map records as its weights: a path, or the name of a model in this package.

    A map may be moved to another machine, where the package is at another path.
    """
    path = real_path(pathlib.Path(weights))
    if os.fspath(weights) in FILES and not path.exists():
        return os.fspath(weights)
    names = (name for name, file in FILES.items() if real_path(file) == path)
    return next(names, str(path))


def resolved(record: str) -> pathlib.Path:
    """Return the weight file that a map has recorded; the inverse of `recorded`."""
    return FILES.get(record, pathlib.Path(record))
