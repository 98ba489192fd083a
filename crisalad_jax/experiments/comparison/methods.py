"""Methods of `crisalad compare`: the paper's Table 1 and BoQ, and any recipe or part by name."""

from collections.abc import Mapping
from typing import NamedTuple

from crisalad_jax.config.part import Part
from crisalad_jax.data.augmentations import Augmentation
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes import (
    RECIPES,
    find_part,
    from_scratch,
    mines_tuples,
    recipe,
    split_name,
    with_part,
)
from crisalad_jax.utils.output import warn


class ComparedMethod(NamedTuple):
    """A line of the table."""

    title: str
    """Name of the method as its authors write it."""
    recipe: str
    """Name that `recipe` looks up; methods of one recipe share its runs."""
    rerank: str | None = None
    """Second stage that re-ranks the first retrievals; None has none."""


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
"""Methods in the order of Table 1. Those with a + have the head of a method whose own backbone is
another, on CriSALAD's backbone and with its training. Other names are recipes or parts, without a
second stage."""


def method_of(name: str, preset: str) -> ComparedMethod:
    """Look up a method to compare.

    Args:
        name: of `METHODS`, or what `recipe` looks up: a recipe, or RECIPE+PART. A part alone
            stands for crisalad+PART.
        preset: the size of the models.

    Returns:
        The method; of a recipe its name is the title.

    Raises:
        InputError: there is no such method, recipe or part.

    Example:
        >>> method_of("crisalad+gem", "b14").title, method_of("step:newton", "b14").title
        ('CriSALAD + GeM', 'crisalad+step:newton')
    """
    if name in METHODS:
        return METHODS[name]
    if mines_tuples(name):
        warn(
            f"--methods: found {name}, whose own recipe mines tuples of queries: it is crisalad+"
            f"{name} here, trained on places as all others are (`crisalad train` has the recipe)"
        )
        whole = f"crisalad+{name}"
        return METHODS.get(whole, ComparedMethod(whole, whole))
    if name in RECIPES:
        return ComparedMethod(name, name)
    base, part = split_name(name)
    find_part(part, preset, what="--methods", others={*METHODS, *RECIPES})
    whole = f"{base or 'crisalad'}+{part}"
    return METHODS.get(whole, ComparedMethod(whole, whole))


def is_method(name: str) -> bool:
    """Return whether a name is a method's or a recipe's, or spells out RECIPE+PART or KIND:NAME.

    A part's name alone is none: with weights it may name any model.

    Example:
        >>> is_method("salad"), is_method("crisalad+gem"), is_method("megaloc")
        (True, True, False)
    """
    named = name in METHODS or name in RECIPES
    return (named and not mines_tuples(name)) or "+" in name or ":" in name


def method_training(recipe_name: str, preset: str, *, from_nothing: bool) -> TrainConfig:
    """Look up how a method is trained in a comparison.

    Args:
        recipe_name: what `recipe` looks up.
        preset: the size of the model.
        from_nothing: whether training starts from random weights, as `from_scratch` has it.

    Returns:
        The configuration.

    Raises:
        InputError: what `recipe` raises.
    """
    if recipe_name not in RECIPES:
        base, part = split_name(recipe_name)
        found = find_part(part, preset)
        return training_with(found, preset, from_nothing=from_nothing, base=base or "crisalad")
    config = recipe(preset, recipe_name)
    return from_scratch(config) if from_nothing else config


def training_with(
    part: Part, preset: str, *, from_nothing: bool, base: str = "crisalad"
) -> TrainConfig:
    """Make a recipe with one part replaced by another of its kind.

    Args:
        part: the part.
        preset: the size of the model.
        from_nothing: whether training starts from random weights, as `from_scratch` has it.
        base: name of the recipe.

    Returns:
        The configuration.

    Raises:
        InputError: what `with_part` raises.

    Example:
        >>> training_with(find_part("light", "b14"), "b14", from_nothing=False).augmentation
        LightAugmentConfig(...)
    """
    config = with_part(recipe(preset, base), part)
    if not from_nothing:
        return config
    config = from_scratch(config)
    # `from_scratch` sets its own augmentation, which would replace the one that is compared.
    return with_part(config, part) if isinstance(part, Augmentation) else config
