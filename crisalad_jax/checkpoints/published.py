"""Models that others published, by name: what published.toml says of their files."""

import dataclasses
import difflib
import pathlib
import re
import tomllib
from collections.abc import Iterator
from typing import Any

from crisalad_jax.checkpoints import starter
from crisalad_jax.utils.errors import InputError

GITHUB = "https://github.com/"


@dataclasses.dataclass(frozen=True)
class Licence:
    """The licence of a repository that publishes a model."""

    name: str
    """SPDX identifier, or words where the repository has no licence."""
    commercial: bool | None = None
    """Whether it allows commercial use; None where nothing is said."""
    terms: str = ""
    """What else a user has to know of it, in words."""

    @property
    def words(self) -> str:
        """The licence, and what a user has to know of it."""
        if self.commercial is None:
            return f"{self.name}: its authors have not said who may use it"
        terms = self.terms if self.commercial else "no commercial use"
        return f"licence {self.name}" + (f": {terms}" if terms else "")


@dataclasses.dataclass(frozen=True)
class Published:
    """A published model."""

    name: str
    """Name for `--weights` and `load`, of small letters, digits and hyphens."""
    format: str
    """Format of the file."""
    descriptor: int
    """Numbers in a descriptor."""
    parameters: int
    """Number of parameters, as `crisalad info` counts them."""
    images: str
    """How images are resized, in words: those of the configuration of its format."""
    licence: Licence
    repository: str
    """Address of the page that publishes the file."""
    file: str
    """Name of the file, also at a mirror."""
    url: str | None
    """Address of the file; None where it has none of its own, as in a folder or an archive."""
    paper: str
    """Authors, venue and year."""
    backbone: str = ""
    """Name of the published model whose backbone the file's vocabulary is of; empty where the file
    is a whole model."""
    note: str = ""
    """What is not certain of these facts, or has to be done by hand."""

    @property
    def notice(self) -> str:
        """The licence in words, and whose it is."""
        return f"{self.licence.words} ({self.repository})"

    @property
    def restriction(self) -> str:
        """The notice of a licence that forbids commerce; otherwise empty."""
        return self.notice if self.licence.commercial is False else ""


def _read() -> Iterator[Published]:
    table = tomllib.loads(pathlib.Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    licences = {fields["name"]: Licence(**fields) for fields in table["licence"]}
    for family in table["family"]:
        before = family.pop("url", None)
        for model in family.pop("models"):
            fields: dict[str, Any] = {**family, **model}
            fields["repository"] = GITHUB + fields["repository"]
            fields["licence"] = licences[fields["licence"]]
            fields.setdefault("url", before and before + fields["file"])
            yield Published(**fields)


PUBLISHED: dict[str, Published] = {model.name: model for model in _read()}
"""Published models by name."""


def published_model(name: str) -> Published:
    """Look a published model up.

    Raises:
        InputError: there is no such model; the message has the nearest names.

    Example:
        >>> published_model("megaloc").format
        'megaloc'
    """
    if name not in PUBLISHED:
        raise InputError(
            f"{name}: found no published model of this name, expected one of `crisalad models`"
            f"{nearest_names(name)}"
        )
    return PUBLISHED[name]


def restriction_of(format: str) -> str:
    """Return the `Published.restriction` that all published models of a format share, or ""."""
    notices = {model.restriction for model in PUBLISHED.values() if model.format == format}
    return notices.pop() if len(notices) == 1 else ""


def nearest_names(name: str) -> str:
    """Return the published names most like this one, as the end of a message."""
    plain = _plain(name)
    words = {each: _plain(f"{each} {m.file} {m.repository}") for each, m in PUBLISHED.items()}
    near = [each for each, own in words.items() if plain in own or plain.replace("-", "") in own]
    # Of a family that is named alone the longest descriptors, which recall the most.
    near.sort(key=lambda each: (each != plain, -PUBLISHED[each].descriptor))
    near += difflib.get_close_matches(plain, [*starter.FILES, *PUBLISHED])
    near = list(dict.fromkeys(near))[:3]
    return f"; nearest: {', '.join(near)}" if near else ""


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower())
