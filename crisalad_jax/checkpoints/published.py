"""Models that others published, by name, from the list of their files in published.toml."""

import dataclasses
import difflib
import pathlib
import re
import tomllib
from collections.abc import Iterator
from typing import Any

from crisalad_jax.checkpoints import starter
from crisalad_jax.config.checks import check_types, choose
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import one_line

GITHUB = "https://github.com/"


@dataclasses.dataclass(frozen=True)
class Licence:
    """The licence of a repository that publishes a model."""

    name: str
    """SPDX identifier, or a phrase for a custom licence or for none, such as "no licence file"."""
    commercial: bool | None = None
    """Whether it allows commercial use; None if the repository does not say."""
    terms: str = ""
    """What else a user must know about the licence; empty if nothing."""

    def __post_init__(self) -> None:
        """Check the types."""
        check_types(self)

    @property
    def words(self) -> str:
        """The licence in words, with what a user must know about it."""
        if self.commercial is None:
            return f"{self.name}: its authors have not said who may use it"
        terms = self.terms if self.commercial else "no commercial use"
        return f"licence {self.name}" + (f": {terms}" if terms else "")


@dataclasses.dataclass(frozen=True)
class Published:
    """A published model."""

    name: str
    """Name for `--weights` and `load`, of lower-case letters, digits and hyphens."""
    format: str
    """Name of the file's format, as `crisalad convert --format` takes it."""
    descriptor: int
    """Dimensions of a descriptor."""
    parameters: int
    """Number of parameters, as `crisalad info` counts them."""
    images: str
    """How images are resized, in words, such as "224 x 224, bilinear (Pillow)"."""
    licence: Licence
    repository: str
    """Address of the page that publishes the file."""
    file: str
    """Name of the file; mirrors use the same name."""
    url: str | None
    """Address of the file; None if it has none of its own, as in a shared folder or an archive."""
    paper: str
    """Authors, venue and year."""
    backbone: str = ""
    """If the file holds only a vocabulary, the name of the published model whose backbone it needs;
    otherwise empty."""
    note: str = ""
    """What is uncertain about these facts, or how to get the file by hand; may be empty."""

    def __post_init__(self) -> None:
        """Check the types."""
        check_types(self)

    @property
    def notice(self) -> str:
        """The licence in words, and the repository that it applies to."""
        return f"{self.licence.words} ({self.repository})"

    @property
    def restriction(self) -> str:
        """The notice of a licence that forbids commercial use; otherwise empty."""
        return self.notice if self.licence.commercial is False else ""


PUBLISHED: dict[str, Published] = {}
"""Published models by name."""
_LICENCES: dict[str, Licence] = {}


def register_published(text: str) -> None:
    """Register custom published models, and how their files name a model's arrays.

    The names of the models then work in `load`, `--weights`, `crisalad models` and `compare`, and
    those of the formats in `convert`. A plug-in FILE.py (`--plugin FILE.py`) can call this, and
    register parts of the models too.

    Args:
        text: TOML with the sections of this package's `published.toml` (licence, family) and of its
            `formats.toml` (chains, tables, backbones, heads, formats). It may refer to names in
            those two files, but not define them again.

    Raises:
        InputError: the text is not such TOML, a name is taken, or the format or licence of a model
            is unknown. Nothing is registered in that case.

    Example:
        >>> register_published(
        ...     '''
        ...     [formats.town-gem]
        ...     holds = "Town-GeM .pth"
        ...     backbone = "dinov2 net."
        ...     head = "cosplace pool."
        ...     images = "pillow 224 224"
        ...     [[family]]
        ...     format = "town-gem"
        ...     licence = "MIT"
        ...     repository = "town/gem"
        ...     paper = "Town et al. 2026"
        ...     images = "224 x 224, bilinear (Pillow)"
        ...     url = "https://town.example/"
        ...     models = [{name="town-gem", descriptor=512, parameters=86973185, file="gem.pth"}]
        ...     '''
        ... )
        >>> published_model("town-gem").url
        'https://town.example/gem.pth'
    """
    # Imported here, so that names can be completed and listed without JAX.
    from crisalad_jax.checkpoints.formats.families import FORMATS, add_formats

    source = "register_published"
    try:
        facts = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: found no TOML: {error}") from error
    licences, models = _read(facts, source)
    own = {model.format for model in models} & facts.get("formats", {}).keys()
    for model in models:
        if model.format not in own | FORMATS.keys():
            raise InputError(
                f"{source}: {model.name}: found format {model.format!r}, expected one that the "
                f"text defines, or {', '.join(FORMATS)}"
            )
    add_formats(facts, source)
    _LICENCES.update(licences)
    PUBLISHED.update({model.name: model for model in models})


def _read(facts: dict[str, Any], source: str) -> tuple[dict[str, Licence], list[Published]]:
    """Take licences and models out of `facts`.

    Raises:
        InputError: naming `source`, if a field is missing or unknown, or a name is taken.
    """
    try:
        licences = {each["name"]: Licence(**each) for each in facts.pop("licence", [])}
        if taken := licences.keys() & _LICENCES.keys():
            raise InputError(f"found licence {min(taken)}, a name that is taken")
        models = [
            model
            for family in facts.pop("family", [])
            for model in _models(family, _LICENCES | licences)
        ]
    except (InputError, KeyError, TypeError) as error:
        words = "" if isinstance(error, InputError) else "cannot be read: "
        raise InputError(f"{source}: {words}{one_line(error)}") from error
    names = [*PUBLISHED, *starter.FILES, *(model.name for model in models)]
    if len(set(names)) < len(names):
        raise InputError(f"{source}: found {max(names, key=names.count)}, a name that is taken")
    return licences, models


def _models(family: dict[str, Any], licences: dict[str, Licence]) -> Iterator[Published]:
    before = family.pop("url", None)
    for model in family.pop("models"):
        fields: dict[str, Any] = {**family, **model}
        fields["repository"] = GITHUB + fields["repository"]
        fields["licence"] = choose("licence", fields["licence"], licences)
        fields.setdefault("url", before and before + fields["file"])
        yield Published(**fields)


def published_model(name: str) -> Published:
    """Return the published model of this name.

    Raises:
        InputError: there is no such model; the message lists the nearest names.

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
    """Return up to three model names similar to `name`, as the end of a message; "" if none."""
    plain = _plain(name)
    words = {each: _plain(f"{each} {m.file} {m.repository}") for each, m in PUBLISHED.items()}
    near = [each for each, own in words.items() if plain in own or plain.replace("-", "") in own]
    # If only a family is named, the longest descriptors come first: they recall the most.
    near.sort(key=lambda each: (each != plain, -PUBLISHED[each].descriptor))
    near += difflib.get_close_matches(plain, [*starter.FILES, *PUBLISHED])
    near = list(dict.fromkeys(near))[:3]
    return f"; nearest: {', '.join(near)}" if near else ""


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower())


_OWN = pathlib.Path(__file__).with_suffix(".toml")
_licences, _own = _read(tomllib.loads(_OWN.read_text(encoding="utf-8")), _OWN.name)
_LICENCES.update(_licences)
PUBLISHED.update({model.name: model for model in _own})
