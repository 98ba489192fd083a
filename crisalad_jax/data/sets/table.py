"""The table of public data sets, read from sets.toml."""

import dataclasses
import difflib
import pathlib
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from crisalad_jax.utils.errors import InputError

Host = Literal["http", "huggingface", "kaggle", "rsync", "google-drive", "form", "request"]
"""Where a set is: an open address, a hub, or a person to ask."""
FETCHED: tuple[Host, ...] = ("http", "huggingface", "kaggle", "rsync")
"""Hosts that a program may download from."""


@dataclasses.dataclass(frozen=True)
class SetFile:
    """A file of a set."""

    address: str
    """Address, or OWNER/NAME at a hub."""
    file: str = ""
    """Path at the hub; for an address, the file's name if the address lacks it."""
    sha256: str | None = None
    """SHA-256 of the file; None if not published."""
    into: str = ""
    """Where it is unpacked, or copied if not an archive."""
    inside: str = ""
    """An archive in it that holds the images."""

    @property
    def name(self) -> str:
        """Its name on disk."""
        return (self.file or self.address).rpartition("/")[2]


@dataclasses.dataclass(frozen=True)
class SetPart:
    """What is published about a part of a set."""

    name: str
    database: int | None = None
    """Number of images; None if unknown."""
    queries: int | None = None
    printed: str = ""
    """A regular expression for the beginning of the name that `open_benchmark` gives it, if other
    sets have the same counts, or none are known."""

    @property
    def words(self) -> str:
        """Its name and counts, for a message."""
        counts = (("database images", self.database), ("queries", self.queries))
        known = [f"{count:,} {what}" for what, count in counts if count is not None]
        return f"{self.name}: {' and '.join(known) or 'no count is published'}"


@dataclasses.dataclass(frozen=True)
class PublishedSet:
    """A public data set."""

    name: str
    title: str
    host: Host
    page: str
    """Address of the page that publishes it."""
    command: str
    """Command that reads it, for a folder DIR."""
    sources: tuple[str, ...]
    """Sources of these facts."""
    files: tuple[SetFile, ...] = ()
    gigabytes: float | None = None
    """Size of the download; None if unknown."""
    licence: str | None = None
    """Licence or terms; None if unknown."""
    ask: str = "nobody"
    """Whom a user has to ask."""
    steps: tuple[str, ...] = ()
    """Steps to do by hand."""
    parts: tuple[SetPart, ...] = ()
    cities: tuple[str, ...] = ()
    """Cities of a set of training places."""
    renamed: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """New names of files that are renamed for `evaluate`, by old name."""
    pairs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Folders of database and queries; images with the same number show the same place."""
    frames: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Folders of the database and the queries, the list of their frames, and the metres between
    two."""
    note: str = ""

    @property
    def is_fetched(self) -> bool:
        """Whether a program may download it."""
        return self.host in FETCHED

    def by_hand(self, folder: str) -> list[str]:
        """List the steps to do by hand, for a folder."""
        checked = f"crisalad data check DIR --set {self.name}"
        return [step.replace("DIR", folder) for step in (*self.steps, checked, self.command)]


def _read() -> Iterator[PublishedSet]:
    path = pathlib.Path(__file__).with_name("sets.toml")
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    for fields in table["set"]:
        known: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in fields.items()
        }
        known["files"] = tuple(SetFile(**each) for each in fields.get("files", ()))
        known["parts"] = tuple(SetPart(**each) for each in fields.get("parts", ()))
        known["sources"] = tuple(table["sources"].get(each, each) for each in fields["sources"])
        yield PublishedSet(**known)


SETS: dict[str, PublishedSet] = {each.name: each for each in _read()}
"""Public data sets by name."""


def find_set(name: str) -> PublishedSet:
    """Look up a public data set.

    Raises:
        InputError: there is no such set; the message lists the nearest names.

    Example:
        >>> find_set("amstertime").parts[0].queries
        1231
    """
    if name not in SETS:
        plain = name.lower().replace("_", "-")
        near = [each for each in SETS if plain in each or each in plain]
        near = list(dict.fromkeys([*near, *difflib.get_close_matches(plain, SETS)]))[:3]
        raise InputError(
            f"{name}: found no data set of this name, expected one of `crisalad data list`"
            + (f"; nearest: {', '.join(near)}" if near else "")
        )
    return SETS[name]
