"""Match the names of images in tables and lists with files, however other systems spell them.

Windows writes backslashes between folders, and macOS accents as letters of their own (NFD).
"""

import os
import pathlib
import unicodedata
from collections.abc import Collection, Iterable


def plain(name: str) -> str:
    r"""Return a name with slashes, in normal form C.

    Example:
        >>> plain("caf" + "e\u0301" + "\\" + "1.jpg")
        'café/1.jpg'
    """
    return unicodedata.normalize("NFC", name.replace("\\", "/"))


def matched(names: Iterable[str], there: Collection[str]) -> dict[str, str]:
    """Return which of the names that are `there` each name means; some mean none.

    That is the name itself, or else one that differs only in slashes or its normal form.
    """
    found = {name: name for name in names}
    if strange := [name for name in found if name not in there]:
        by_plain = {plain(name): name for name in there}
        for name in strange:
            if (meant := by_plain.get(plain(name))) is None:
                del found[name]
            else:
                found[name] = meant
    return found


class Disk:
    """Finds files by names; each folder is listed once, as to stat each file is slow far away."""

    def __init__(self) -> None:
        """Begin without any listing."""
        self._listings: dict[pathlib.Path, dict[str, str]] = {}

    def find(self, root: pathlib.Path, name: str) -> pathlib.Path | None:
        """Return the path below `root` that a name means; None where there is none."""
        path = root / name
        if (there := self.names(path.parent).get(path.name)) is not None:
            return path.with_name(there)
        path = root
        for part in pathlib.PurePosixPath(plain(name)).parts:
            if part not in ("/", ".."):
                listing = self.names(path)
                if (part := listing.get(part, "")) == "":
                    return None
            path = path / part
        return path

    def names(self, folder: pathlib.Path) -> dict[str, str]:
        """Return the names in a folder, by themselves and as `plain` writes them."""
        if folder not in self._listings:
            try:
                names = os.listdir(folder)
            except OSError:
                names = []
            by_name = {name: name for name in names}
            self._listings[folder] = {plain(name): name for name in names} | by_name
        return self._listings[folder]
