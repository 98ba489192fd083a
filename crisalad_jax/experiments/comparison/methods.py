"""Methods of `crisalad compare`: the paper's Table 1 and BoQ, and any recipe or part by name."""

from collections.abc import Mapping
from typing import NamedTuple

from crisalad_jax.config.parts import Part
from crisalad_jax.data.augmentations import Augmentation
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.recipes import RECIPES, find_part, from_scratch, recipe, with_part


class ComparedMethod(NamedTuple):
    """A line of the table."""

    title: str
    """Name of the method as its authors write it."""
    recipe: str
    """Name that `recipe` looks up; methods of one recipe share its runs."""
    rerank: str | None = None
    """Second stage that re-ranks the first retrievals; None has none."""


METHODS: Mapping[str, ComparedMethod] = {
    "netvlad": ComparedMethod("NetVLAD", "netvlad"),
    "gem": ComparedMethod("GeM", "gem"),
    "conv-ap": ComparedMethod("Conv-AP", "conv-ap"),
    "patch-netvlad": ComparedMethod("Patch-NetVLAD", "netvlad", rerank="patch-netvlad"),
    "transvpr": ComparedMethod("TransVPR", "transvpr", rerank="transvpr"),
    "cosplace": ComparedMethod("CosPlace", "cosplace"),
    "mixvpr": ComparedMethod("MixVPR", "mixvpr"),
    "eigenplaces": ComparedMethod("EigenPlaces", "eigenplaces"),
    "anyloc": ComparedMethod("AnyLoc", "anyloc"),
    "cricavpr": ComparedMethod("CricaVPR", "cricavpr"),
    "salad": ComparedMethod("DINO-SALAD", "salad"),
    "crisalad": ComparedMethod("CriSALAD", "crisalad"),
    "boq": ComparedMethod("BoQ", "boq"),
}
"""Methods in the order of Table 1. Other names are recipes or parts, without a second stage."""


def method_of(name: str, preset: str) -> ComparedMethod:
    """Look up a method to compare.

    Args:
        name: of `METHODS`, or what `recipe` looks up: a recipe, or a part as NAME or KIND:NAME.
        preset: the size of the models.

    Returns:
        The method; of a recipe or a part its name is the title.

    Raises:
        InputError: there is no such method, recipe or part.

    Example:
        >>> method_of("netvlad", "b14").title, method_of("step:newton", "b14").title
        ('NetVLAD', 'step:newton')
    """
    if name in METHODS:
        return METHODS[name]
    if name not in RECIPES:
        find_part(name, preset, what="--methods", others={*METHODS, *RECIPES})
    return ComparedMethod(name, name)


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
        part = find_part(recipe_name, preset)
        return training_with(part, preset, from_nothing=from_nothing)
    config = recipe(preset, recipe_name)
    return from_scratch(config) if from_nothing else config


def training_with(part: Part, preset: str, *, from_nothing: bool) -> TrainConfig:
    """Make CriSALAD's recipe with one part replaced by another of its kind.

    Args:
        part: the part.
        preset: the size of the model.
        from_nothing: whether training starts from random weights, as `from_scratch` has it.

    Returns:
        The configuration.

    Raises:
        InputError: what `with_part` raises.

    Example:
        >>> training_with(find_part("light", "b14"), "b14", from_nothing=False).augmentation
        LightAugmentConfig(...)
    """
    config = with_part(recipe(preset, "crisalad"), part)
    if not from_nothing:
        return config
    config = from_scratch(config)
    # `from_scratch` sets its own augmentation, which would replace the one that is compared.
    return with_part(config, part) if isinstance(part, Augmentation) else config
