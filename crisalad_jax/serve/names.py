"""Names that a client may give to an image that it adds."""

from crisalad_jax.data.images import check_lines
from crisalad_jax.utils.errors import InputError

_LONGEST = 255
"""Most bytes of a file's name, and of a folder's, on the usual file systems."""
_LONGEST_PATH = 1000


def check_new_name(name: str) -> None:
    """Check that a name is a plain path below a folder, without hidden parts.

    Raises:
        InputError: it is empty, absolute, too long, leads out of the folder, or has letters that no
            line of text has.

    Example:
        >>> check_new_name("tuesday/0001.jpg")
    """
    expected = "expected a path such as 'tuesday/0001.jpg'"
    if not name:
        raise InputError(f"name: found an empty one, {expected}")
    check_lines([name], "name")
    parts = name.split("/")
    if not name.isprintable() or "\\" in name:
        raise InputError(f"name: found {name!r}, {expected}, without control characters")
    if any(not part or part.startswith(".") or part != part.strip() for part in parts):
        raise InputError(
            f"name: found {name!r}, {expected}, no part of which is empty or begins with a dot"
        )
    if max(len(part.encode()) for part in parts) > _LONGEST or len(name) > _LONGEST_PATH:
        raise InputError(f"name: found {len(name)} letters, expected at most {_LONGEST} a part")
