"""The table of public data sets, read from sets.toml."""

import dataclasses
import difflib
import pathlib
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from crisalad_jax.utils.errors import InputError

Host = Literal["http", "huggingface", "kaggle", "rsync", "google-drive", "form", "request"]
"""Kind of place that a set comes from: an open address, a hub, or a person to ask."""
FETCHED: tuple[Host, ...] = ("http", "huggingface", "kaggle", "rsync")
"""Hosts that a program may download from."""


@dataclasses.dataclass(frozen=True)
class SetFile:
    """A file to download for a set."""

    address: str
    """Address, or OWNER/NAME at a hub."""
    file: str = ""
    """Path at the hub; for an address, the name of the file if the address lacks it."""
    sha256: str | None = None
    """SHA-256 of the file; None if not published."""
    into: str = ""
    """Path below the set's files to which the file is unpacked or, if not an archive, copied."""
    inside: str = ""
    """Name of an inner archive that holds the images; "" if there is none."""

    @property
    def name(self) -> str:
        """Name of the file on disk."""
        return (self.file or self.address).rpartition("/")[2]


@dataclasses.dataclass(frozen=True)
class SetPart:
    """What is published about a part of a set."""

    name: str
    database: int | None = None
    """Number of database images; None if unknown, as for `queries`."""
    queries: int | None = None
    printed: str = ""
    """Regular expression for the beginning of the name that `open_benchmark` gives the part; for
    parts whose counts are unknown, or the same as in other sets."""

    @property
    def words(self) -> str:
        """Name and counts of the part, for a message."""
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
    """Address of the page that publishes the set."""
    command: str
    """Command that reads the set from a folder DIR."""
    sources: tuple[str, ...]
    """Sources of these facts."""
    files: tuple[SetFile, ...] = ()
    gigabytes: float | None = None
    """Size of the download; None if unknown."""
    licence: str | None = None
    """Licence or terms; None if unknown."""
    ask: str = "nobody"
    """Whom a user has to ask, or what to do first, such as filling in a form."""
    steps: tuple[str, ...] = ()
    """Steps to do by hand, with DIR for the folder."""
    parts: tuple[SetPart, ...] = ()
    cities: tuple[str, ...] = ()
    """Cities of a set of training places."""
    renamed: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """New names of files that are renamed for `evaluate`, by old name."""
    pairs: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Folders of a database and queries in which images of the same number show the same place."""
    frames: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Folders of the database and the queries, the file that lists their frames, and the metres
    between two frames."""
    note: str = ""

    @property
    def is_fetched(self) -> bool:
        """Whether `fetch_set` can download the set."""
        return self.host in FETCHED

    def by_hand(self, folder: str) -> list[str]:
        """List steps to do by hand, then the commands that check and read the set in `folder`."""
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
