"""The models in this package, there before any download: a small one, and baselines.

docs/starter.md says how the small one was trained, on rendered pictures alone, and what it recalls.
Histograms of oriented gradients and SeqSLAM's thumbnails have no parameters: their files are a
configuration. They are no published models: their files are part of the package, and their licence
the package's.
"""

import os
import pathlib

from crisalad_jax.utils.files import real_path

NAME = "starter"
"""Its name, for `--weights` and `load`."""
FILE = pathlib.Path(__file__).with_name(f"{NAME}.safetensors")
FILES = {NAME: FILE, "hog": FILE.with_stem("hog"), "thumbnail": FILE.with_stem("thumbnail")}
"""The files of all models in this package by their names."""
BEST = "megaloc"
"""The published model that recalls the most, which a note names."""


def named(weights: str | os.PathLike[str]) -> str:
    """Return the words for a file of weights in what people read: of one of these its name."""
    names = (name for name, file in FILES.items() if file == pathlib.Path(weights))
    return next(names, os.fspath(weights))


def recorded(weights: str | os.PathLike[str]) -> str:
    """Return what a map records of where its weights are: a path, or the name of one of these.

    The package has another place on another machine, where a map may be taken.
    """
    path = real_path(pathlib.Path(weights))
    if os.fspath(weights) in FILES and not path.exists():
        return os.fspath(weights)
    names = (name for name, file in FILES.items() if real_path(file) == path)
    return next(names, str(path))


def resolved(record: str) -> pathlib.Path:
    """Return the file of weights that a map has a record of, the opposite of `recorded`."""
    return FILES.get(record, pathlib.Path(record))
