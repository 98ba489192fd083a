"""What can be compared: methods of the paper's Table 1, rows of its Table 2, and custom rows."""

import dataclasses
import itertools
import re
import shlex
from collections.abc import Mapping
from typing import Literal, NamedTuple

from crisalad_jax.config.checks import require
from crisalad_jax.config.flags import parse_changes
from crisalad_jax.data.augmentations import Augmentation
from crisalad_jax.retrieval.reranking import RERANKERS
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.optimisers import Optimiser
from crisalad_jax.training.recipes import (
    RECIPES,
    find_part,
    from_scratch,
    mines_tuples,
    mixes_sets,
    recipe,
    split_name,
    with_part,
)
from crisalad_jax.training.schedules import Schedule
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import warn


class ComparedMethod(NamedTuple):
    """A line in the table of `crisalad compare`."""

    title: str
    """Name of the method as its authors write it."""
    recipe: str
    """Name that `recipe` looks up; methods of one recipe share its runs."""
    rerank: str | None = None
    """Second stage that re-ranks the first retrievals, if any."""


METHODS: Mapping[str, ComparedMethod] = {
    "crisalad+netvlad": ComparedMethod("CriSALAD + NetVLAD", "crisalad+netvlad"),
    "crisalad+gem": ComparedMethod("CriSALAD + GeM", "crisalad+gem"),
    "crisalad+conv-ap": ComparedMethod("CriSALAD + Conv-AP", "crisalad+conv-ap"),
    "crisalad+patch-netvlad": ComparedMethod(
        "CriSALAD + Patch-NetVLAD", "crisalad+netvlad", rerank="patch-netvlad"
    ),
    "crisalad+transvpr": ComparedMethod(
        "CriSALAD + TransVPR", "crisalad+transvpr", rerank="transvpr"
    ),
    "cosplace-vit": ComparedMethod("CosPlace over our ViT", "cosplace-vit"),
    "crisalad+mixvpr": ComparedMethod("CriSALAD + MixVPR", "crisalad+mixvpr"),
    "eigenplaces-vit": ComparedMethod("EigenPlaces over our ViT", "eigenplaces-vit"),
    "anyloc": ComparedMethod("AnyLoc", "anyloc"),
    "cricavpr": ComparedMethod("CricaVPR", "cricavpr"),
    "salad": ComparedMethod("DINO-SALAD", "salad"),
    "crisalad": ComparedMethod("CriSALAD", "crisalad"),
    "boq": ComparedMethod("BoQ", "boq"),
}
"""Methods in the order of the paper's Table 1. crisalad+NAME has the head of method NAME, with the
backbone and training of CriSALAD; other names are recipes."""


def method_of(name: str, preset: str, what: str = "--methods") -> ComparedMethod:
    """Look up a method to compare.

    Args:
        name: one of `METHODS`, or what `recipe` looks up: a recipe, or RECIPE+PART. A PART by
            itself means crisalad+PART.
        preset: the size of the models, such as "b14".
        what: the flag that gave the name, for messages.

    Returns:
        The method; for a recipe that is not in `METHODS`, its title is the name of the recipe.

    Raises:
        InputError: there is no such method, recipe or part; or the recipe trains on several sets.

    Example:
        >>> method_of("crisalad+gem", "b14").title, method_of("step:newton", "b14").title
        ('CriSALAD + GeM', 'crisalad+step:newton')
    """
    whole = name
    base, part = split_name(name)
    require(
        not mixes_sets(base or name),
        f"{what}: found {name}, which trains on several sets, expected one that trains on one, as "
        "all others do (`crisalad train` has the recipe)",
    )
    if mines_tuples(name):
        warn(
            f"{what}: found {name}, whose own recipe mines tuples of queries: it is crisalad+"
            f"{name} here, trained on places as all others are (`crisalad train` has the recipe)"
        )
        whole = f"crisalad+{name}"
    elif name not in METHODS and name not in RECIPES:
        find_part(part, preset, what=what, others={*METHODS, *ABLATIONS, *RECIPES})
        whole = f"{base or 'crisalad'}+{part}"
    return METHODS.get(whole, ComparedMethod(whole, whole))


def is_method(name: str) -> bool:
    """Return whether a name is that of a method or recipe, or looks like RECIPE+PART or KIND:NAME.

    Parts alone and recipes that mine tuples or mix sets do not count: weights may have their names.

    Example:
        >>> is_method("salad"), is_method("crisalad+gem"), is_method("megaloc")
        (True, True, False)
    """
    named = name in METHODS or name in RECIPES
    own = mines_tuples(name) or mixes_sets(name)
    spelt = ("+" in name and split_second_stage(name)[1] is None) or ":" in name
    return (named and not own) or spelt


def split_second_stage(name: str) -> tuple[str, str | None]:
    """Split MODEL+STAGE into model and second stage; after a recipe, + adds a part instead.

    Example:
        >>> split_second_stage("fol-large+fol"), split_second_stage("crisalad+transvpr")
        (('fol-large', 'fol'), ('crisalad+transvpr', None))
    """
    model, _, method = name.rpartition("+")
    return (model, method) if method in RERANKERS and model not in RECIPES else (name, None)


def method_training(name: str, preset: str, *, from_nothing: bool) -> TrainConfig:
    """Look up how a method is trained in a comparison.

    Args:
        name: what `recipe` looks up.
        preset: the size of the model, such as "b14".
        from_nothing: whether training starts from random weights; see `from_scratch`.

    Returns:
        The training configuration, with its model.

    Raises:
        InputError: the preset, recipe or part does not exist, or the part does not fit the preset.

    Example:
        >>> method_training("crisalad+light", "b14", from_nothing=True).augmentation
        LightAugmentConfig(...)
    """
    config = recipe(preset, name)
    if not from_nothing:
        return config
    scratch = from_scratch(config)
    part = None if name in RECIPES else find_part(split_name(name)[1], preset)
    # The part is what is compared, and `from_scratch` has replaced it.
    is_replaced = isinstance(part, Augmentation | Optimiser | Schedule)
    return with_part(scratch, part) if is_replaced else scratch


class Ablation(NamedTuple):
    """A row of the paper's Table 2: settings of CriSALAD (`encoder`: the cross-image encoder)."""

    adapter: str = "depthwise"
    encoder: bool = True
    learning_rate: float = 6e-5
    schedule: Literal["linear", "step"] = "linear"

    def training(self, preset: str, *, from_nothing: bool) -> TrainConfig:
        """Return the paper's recipe, or `scratch` if `from_nothing`, with the row's settings."""
        config, rate = recipe(preset, f"crisalad+adapter:{self.adapter}"), self.learning_rate
        if not self.encoder:
            model = dataclasses.replace(config.model, cross_image="none")
            config = dataclasses.replace(config, model=model)
        if from_nothing:
            config = from_scratch(config)
            rate *= config.optimiser.learning_rate / OptimiserConfig.learning_rate
        optimiser = dataclasses.replace(config.optimiser, learning_rate=rate)
        if self.schedule == "step":
            optimiser = dataclasses.replace(optimiser, schedule=self.schedule)
        return dataclasses.replace(config, optimiser=optimiser)

    def words(self, training: TrainConfig) -> str:
        """List the settings that the row changes (all if none); `training` is the row's recipe."""
        words = (
            f"adapter {self.adapter}",
            f"cross-image encoder {'yes' if self.encoder else 'no'}",
            f"learning rate {training.optimiser.learning_rate:.2g}",
            f"scheduler {self.schedule}",
        )
        changed = [own != usual for own, usual in zip(self, Ablation(), strict=True)]
        return ", ".join(itertools.compress(words, changed) if any(changed) else words)


ABLATIONS: Mapping[str, Ablation] = {
    "crisalad": Ablation(),
    "lr-1e-4": Ablation(learning_rate=1e-4),
    "step": Ablation(schedule="step"),
    "multi-resolution": Ablation("multi-resolution"),
    "mlp": Ablation("mlp"),
    "no-adapter": Ablation("none"),
    "no-encoder": Ablation(encoder=False),
    "no-encoder-step": Ablation(encoder=False, schedule="step"),
}
"""Rows of the paper's Table 2, and two more: one without any adapter; and one without encoder that
has the linear schedule, unlike the paper's, so that a single part changes."""


_FLAG = re.compile(
    r"""\s*(?:--)?([\w.-]+)\s*=\s*(?=[^\s,])((?:[^,"']|"[^"]*"|'[^']*')+?)\s*(?:,|$)"""
)
"""A flag with its value, up to an unquoted comma."""
_FIXED = (
    *("seed", "preset", "mining.kind", "patience", "validate-every", "validation-size"),
    *("monitor", "save-top-k"),
)
"""Flags of `train` that are the same for all rows: a comparison has its own seeds and preset,
trains on places, and does not validate."""


class AblationRow(NamedTuple):
    """A custom row: a recipe whose settings are changed by flags of `crisalad train`."""

    name: str
    recipe: str
    flags: tuple[tuple[str, str], ...]
    """Flags of `crisalad train`, without their two hyphens, and their values."""

    @property
    def words(self) -> str:
        """What the row changes, for a table."""
        base = () if self.recipe == "crisalad" else (("recipe", self.recipe),)
        return ", ".join(f"{flag}={value}" for flag, value in (*base, *self.flags))

    def sets(self, flag: str) -> bool:
        """Return whether the row sets a flag whose name starts with `flag`."""
        return any(own.startswith(flag) for own, _ in self.flags)

    def training(self, preset: str, *, from_nothing: bool) -> TrainConfig:
        """Return the training configuration: the recipe with the row's flags applied.

        Raises:
            InputError: the recipe, a flag or a part does not exist, or a value does not fit.
        """
        found = method_of(self.recipe, preset, f"--row {self.name}: recipe").recipe
        return self.changed(method_training(found, preset, from_nothing=from_nothing), preset)

    def changed(self, config: TrainConfig, preset: str) -> TrainConfig:
        """Apply the row's flags to a configuration; the errors are those of `training`."""
        pairs = ((f"--{flag}", *shlex.split(value)) for flag, value in self.flags)
        arguments = [word for words in pairs for word in words]
        return parse_changes(config, arguments, preset, f"--row {self.name}")


def parse_row(text: str) -> AblationRow:
    """Read a row from the text "NAME: flag=value, flag=value".

    The flags are those of `crisalad train` without their two hyphens; `recipe` is what the row
    starts from, by default crisalad. Separate the numbers of one flag by spaces, as in
    "image-size=224 224", and quote a value with a comma or a space in it.

    Args:
        text: the row's text.

    Returns:
        The row; its flags and values are checked later, by `AblationRow.training`.

    Raises:
        InputError: the text has another form, or a flag that is the same for all rows.

    Example:
        >>> parse_row("flat: recipe=salad, optimiser.learning_rate=1e-5, image_size=224 224").words
        'recipe=salad, optimiser.learning-rate=1e-5, model.image-size=224 224'
    """
    name, _, rest = (part.strip() for part in text.partition(":"))
    found = list(_FLAG.finditer(rest))
    flags = {match[1].replace("_", "-"): match[2] for match in found}
    is_whole = "".join(match.group() for match in found) == rest and len(flags) == len(found) > 0
    if not is_whole or not re.fullmatch("[^=,]+", name):
        raise InputError(
            f"--row: found {text!r}, expected NAME: flag=value, flag=value, each flag once"
        )
    if fixed := [flag for flag in flags if flag in _FIXED]:
        raise InputError(
            f"--row {name}: found {', '.join(fixed)}, expected another flag: it is the same for "
            "all rows of a comparison"
        )
    base = flags.pop("recipe", "crisalad")
    # A short form, as in `train`, since the size is often set.
    short = {"image-size": "model.image-size"}
    return AblationRow(name, base, tuple((short.get(flag, flag), flags[flag]) for flag in flags))
