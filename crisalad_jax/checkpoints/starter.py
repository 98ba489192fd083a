"""The model in this package: small, trained on rendered pictures alone, there before any download.

docs/starter.md says how it was trained, and what it recalls. It is no published model: its file is
part of the package, and its licence the package's.
"""

import os
import pathlib

from crisalad_jax.utils.files import real_path
from crisalad_jax.utils.notes import tell

NAME = "starter"
"""Its name, for `--weights` and `load`."""
FILE = pathlib.Path(__file__).with_name(f"{NAME}.safetensors")
BEST = "megaloc"
"""The published model that recalls the most, which a note names."""


def default_weights() -> pathlib.Path:
    """Return the file of the model in this package, and tell that it was taken."""
    tell_taken()
    return FILE


def tell_taken() -> None:
    """Tell that the model in this package was taken."""
    tell(
        f"no --weights: taking {NAME}, the small model in this package, trained on rendered "
        f"pictures alone (docs/{NAME}.md); for the best recall: --weights {BEST}"
    )


def named(weights: str | os.PathLike[str]) -> str:
    """Return the words for a file of weights in what people read: of this model its name."""
    return NAME if pathlib.Path(weights) == FILE else os.fspath(weights)


def recorded(weights: str | os.PathLike[str]) -> str:
    """Return what a map records of where its weights are: a path, or the name of this model.

    The package has another place on another machine, where a map may be taken.
    """
    path = real_path(pathlib.Path(weights))
    is_named = os.fspath(weights) == NAME and not path.exists()
    return NAME if is_named or path == real_path(FILE) else str(path)


def resolved(record: str) -> pathlib.Path:
    """Return the file of weights that a map has a record of, the opposite of `recorded`."""
    return FILE if record == NAME else pathlib.Path(record)
