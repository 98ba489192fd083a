"""The table of public data sets: what sets.toml says of each."""

import dataclasses
import difflib
import pathlib
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from crisalad_jax.utils.errors import InputError

Host = Literal["http", "huggingface", "kaggle", "rsync", "google-drive", "form", "request"]
"""Where a set is: an address that needs nobody, a hub, or a person to ask."""
FETCHED: tuple[Host, ...] = ("http", "huggingface", "kaggle", "rsync")
"""Hosts that a program may download from."""


@dataclasses.dataclass(frozen=True)
class SetFile:
    """A file of a set."""

    address: str
    """Address, or a name as OWNER/NAME at a hub."""
    file: str = ""
    """Path at the hub; of an address, its name where the address does not end in it."""
    sha256: str | None = None
    """SHA-256 of the file; None where nobody publishes it."""
    into: str = ""
    """Where it is unpacked, or put where it is no archive."""
    inside: str = ""
    """An archive in it, which holds the images."""

    @property
    def name(self) -> str:
        """Its name on disk."""
        return (self.file or self.address).rpartition("/")[2]


@dataclasses.dataclass(frozen=True)
class SetPart:
    """What is published of a part of a set."""

    name: str
    database: int | None = None
    """Number of images; None where it is not known."""
    queries: int | None = None
    printed: str = ""
    """A regular expression of the beginning of its name, as `open_benchmark` gives it: where other
    sets have the same counts, or none are known."""

    @property
    def words(self) -> str:
        """The counts in words."""
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
    """Where these facts are from."""
    files: tuple[SetFile, ...] = ()
    gigabytes: float | None = None
    """Size of the files as they are downloaded; None where it is not known."""
    licence: str | None = None
    """Licence or terms; None where they are not known."""
    ask: str = "nobody"
    """Whom a user has to ask."""
    steps: tuple[str, ...] = ()
    """What a user does by hand."""
    parts: tuple[SetPart, ...] = ()
    cities: tuple[str, ...] = ()
    """Cities of a set of training places."""
    renamed: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Files that have another name where `evaluate` reads them."""
    pairs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Folders of the database and the queries, in which images of one number show one place."""
    frames: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Folders of the database and the queries, the list of their frames, and the metres between
    two."""
    note: str = ""

    @property
    def is_fetched(self) -> bool:
        """Whether a program may download it."""
        return self.host in FETCHED

    def by_hand(self, folder: str) -> list[str]:
        """List what a user does by hand, for a folder."""
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
    """Look a public data set up.

    Raises:
        InputError: there is no such set; the message has the nearest names.

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
