"""Rows of an ablation of one's own: a recipe with settings changed by the flags of `train`."""

import dataclasses
import functools
import re
import shlex
from collections.abc import Mapping
from typing import Any

from crisalad_jax.config.flags import parse_changes
from crisalad_jax.experiments.comparison.methods import method_training
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.utils.errors import InputError

_SHAPE = "NAME: flag=value, flag=value"
_ITEM = re.compile(r"""(?:[^,"']|"[^"]*"|'[^']*'|["'])+""")
"""Text up to a comma that is in no quotes."""
_LARGEST = 2**40
"""Largest whole number, as of the command line's flags."""
_NOT_A_ROWS = {
    "seed": "the comparison's --seeds",
    "preset": "the comparison's --preset",
    "mining.kind": "places alone, which a comparison trains on",
    **dict.fromkeys(
        ("patience", "validate-every", "validation-size", "monitor", "save-top-k"),
        "none: a comparison validates nothing, and takes the weights after the last step",
    ),
}
"""Flags of `train` that no row can set, and what is expected instead."""


@dataclasses.dataclass(frozen=True)
class AblationRow:
    """A row of an ablation: a recipe with changes.

    Example:
        >>> parse_row("slow: optimiser.learning_rate=1e-5, image_size=224 224").changes
        ('optimiser.learning-rate=1e-5', 'model.image-size=224 224')
    """

    name: str
    recipe: str = "crisalad"
    """What `recipe` looks up."""
    changes: tuple[str, ...] = ()
    """FLAG=VALUE, with the flags of `crisalad train`, without their two hyphens."""

    def __post_init__(self) -> None:
        """Check the name and the shape of each change."""
        if not self.name or self.name != self.name.strip() or set(self.name) & set(":=,"):
            raise InputError(f"--row: found the name {self.name!r}, expected {_SHAPE}")
        given = []
        for change in self.changes:
            flag, equals, value = change.partition("=")
            flag = _flag(flag)
            if not flag or not equals or not value.strip():
                raise InputError(f"--row {self.name}: found {change!r}, expected flag=value")
            if flag in _NOT_A_ROWS:
                raise InputError(
                    f"--row {self.name}: {flag}: found {value.strip()}, expected "
                    f"{_NOT_A_ROWS[flag]}"
                )
            for word in value.split():
                if word.lstrip("+-").isdecimal() and abs(int(word)) > _LARGEST:
                    raise InputError(
                        f"--row {self.name}: {flag}: found {word}, expected a number of at most "
                        "2**40"
                    )
            given.append((flag, value.strip()))
        flags = [flag for flag, _ in given]
        for flag in flags:
            if flags.count(flag) > 1:
                raise InputError(f"--row {self.name}: found {flag} twice, expected it once")
        object.__setattr__(self, "changes", tuple(f"{flag}={value}" for flag, value in given))

    @property
    def flags(self) -> Mapping[str, str]:
        """Values by flag."""
        return dict(change.split("=", 1) for change in self.changes)

    @property
    def words(self) -> str:
        """What the row changes, for a table."""
        base = () if self.recipe == "crisalad" else (f"recipe={self.recipe}",)
        return ", ".join((*base, *self.changes))

    def training(self, preset: str, *, from_nothing: bool) -> TrainConfig:
        """Make the recipe with the changes.

        Raises:
            InputError: no such recipe, flag or part, or a value that does not fit.
        """
        try:
            config = method_training(self.recipe, preset, from_nothing=from_nothing)
        except InputError as error:
            raise InputError(f"--row {self.name}: {error}") from error
        config = self.changed(config, preset)
        if config.mines:
            raise InputError(
                f"--row {self.name}: found recipe {self.recipe}, which mines tuples, expected one "
                f"that trains on places, such as crisalad+{self.recipe}"
            )
        return config

    def changed(self, config: TrainConfig, preset: str) -> TrainConfig:
        """Put the row's changes into a configuration; raises as `training`."""
        return _changed(self, config, preset)


@functools.lru_cache(64)  # a comparison asks several times, and a parser takes half a second
def _changed(row: AblationRow, config: TrainConfig, preset: str) -> TrainConfig:
    arguments = []
    for flag, value in row.flags.items():
        try:
            arguments += [f"--{flag}", *shlex.split(value)]
        except ValueError as error:
            raise InputError(
                f"--row {row.name}: {flag}: found {value}, expected closed quotes"
            ) from error
    return parse_changes(config, arguments, preset, f"--row {row.name}")


def parse_row(text: str) -> AblationRow:
    """Read a row from the text "NAME: flag=value, flag=value".

    The flags are those of `crisalad train` without their two hyphens; `recipe` is what the row
    starts from, by default crisalad. Numbers of one flag stand between spaces, as in
    "image-size=224 224". A value with a comma or a space of its own stands in quotes.

    Args:
        text: the row.

    Returns:
        The row; flags and values are checked where its configuration is made.

    Raises:
        InputError: the text has another shape.

    Example:
        >>> parse_row("gem: model.aggregator=gem, model.cross-image.layers=0").flags
        {'model.aggregator': 'gem', 'model.cross-image.layers': '0'}
        >>> parse_row("flat: recipe=salad, model.aggregator.sinkhorn.step=log").recipe
        'salad'
    """
    name, colon, rest = text.partition(":")
    name = name.strip()
    if not colon or not name or set(name) & set("=,"):
        raise InputError(f"--row: found {text!r}, expected {_SHAPE}")
    items = [item.strip() for item in _ITEM.findall(rest) if item.strip()]
    if not items:
        raise InputError(f"--row {name}: found no change, expected {_SHAPE}")
    recipes = [item for item in items if _flag(item.partition("=")[0]) == "recipe"]
    changes = tuple(item for item in items if item not in recipes)
    if len(recipes) > 1:
        raise InputError(f"--row {name}: found recipe twice, expected it once")
    if not recipes:
        return AblationRow(name, changes=changes)
    recipe = recipes[0].partition("=")[2].strip()
    if not recipe:
        raise InputError(f"--row {name}: found {recipes[0]!r}, expected flag=value")
    return AblationRow(name, recipe, changes)


def as_row(given: Any) -> AblationRow:
    """Make a row of text, or of a pair: a name, and values by the flags or fields of `TrainConfig`.

    Args:
        given: text as `parse_row` reads it; or (name, mapping), where a value is a number, text,
            truth value, None, or a tuple of them; or a row.

    Returns:
        The row.

    Raises:
        InputError: another value, or what `parse_row` raises.

    Example:
        >>> as_row(("slow", {"optimiser.learning_rate": 1e-5, "recipe": "salad"})).words
        'recipe=salad, optimiser.learning-rate=1e-05'
    """
    if isinstance(given, AblationRow):
        return given
    if isinstance(given, str):
        return parse_row(given)
    if isinstance(given, tuple) and len(given) == 2 and isinstance(given[1], Mapping):
        name, values = given
        changes = {str(flag): _text(name, flag, value) for flag, value in values.items()}
        recipe = changes.pop("recipe", "crisalad")
        return AblationRow(name, recipe, tuple(f"{f}={v}" for f, v in changes.items()))
    raise InputError(f"rows: found {given!r}, expected text or (name, changes)")


def _text(name: str, flag: str, value: Any) -> str:
    if isinstance(value, tuple | list):
        return " ".join(_text(name, flag, each) for each in value)
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, str):
        return shlex.quote(value)
    raise InputError(
        f"--row {name}: {flag}: found {value!r}, expected a number, text, None or a tuple of them; "
        "a part by its name, and its settings by their own flags"
    )


def _flag(text: str) -> str:
    flag = text.strip().removeprefix("--").replace("_", "-")
    # As `train` has it, for the size is wanted often.
    return "model.image-size" if flag == "image-size" else flag
