"""Recipes: training configurations of published methods by name, or with one part swapped."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from crisalad_jax.config.checks import choose, require, takes
from crisalad_jax.config.part import Part
from crisalad_jax.config.plugins import load_entry_points
from crisalad_jax.config.registry import REGISTRIES, add_named
from crisalad_jax.data.augmentations.light import LightAugmentConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.backbones import BACKBONES
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.training.config import OptimiserConfig, TrainConfig, has_adapters
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.optimisers import AdamW
from crisalad_jax.training.schedules import LinearSchedule
from crisalad_jax.training.trainable import ADAPTERS, ADAPTERS_AND_HEAD, ALL, HEAD, terms_of
from crisalad_jax.utils.output import warn

Make = Callable[[ModelConfig, str], TrainConfig]
"""Takes the model of a preset and the preset's name; returns the configuration."""
RECIPES: dict[str, Make] = {}
"""Recipes by name. A published method's name stands for its original training. Rows of the paper's
Table 2 that have no recipe differ from `crisalad` by one flag."""


def register_recipe(name: str) -> Callable[[Make], Make]:
    """Make a decorator that registers a function as the recipe `name`.

    Args:
        name: the recipe's name in flags.

    Returns:
        The decorator; the function takes the model of a preset and the preset's name, and returns
        the training configuration.

    Raises:
        InputError: on decoration, if the name is taken by another function.

    Example:
        >>> @register_recipe("crisalad-two-epochs")
        ... def two_epochs(model, preset):
        ...     return TrainConfig(model=model, epochs=2)
        >>> recipe("tiny", "crisalad-two-epochs").epochs
        2
    """

    def decorate(make: Make) -> Make:
        add_named("recipe", RECIPES, name, make)
        return make

    return decorate


@takes(preset=str, model=(ModelConfig, type(None)))
def recipe(
    preset: str = "b14", name: str | None = None, *, model: ModelConfig | None = None
) -> TrainConfig:
    """Look up a training configuration, which includes the parts of the model.

    Args:
        preset: the size of the model (`PRESETS`).
        name: name of the recipe (`RECIPES`), or RECIPE+PART: a recipe with a registered part, as
            NAME or KIND:NAME, in place of its own. PART by itself means crisalad+PART. None is the
            paper's recipe or, for preset `tiny`, `scratch`.
        model: configuration of the model to start from, in place of the preset's and the recipe's.
            It is trained and validated at its own image size. If the recipe trains adapters and
            the model has none, only its head trains.

    Returns:
        The configuration of a training run.

    Raises:
        InputError: the preset, recipe or part does not exist, or they do not fit together.

    Example:
        >>> recipe("b14").optimiser.learning_rate
        6e-05
        >>> recipe("b14", "crisalad+gem").model.descriptor_dim
        768
        >>> from crisalad_jax import load
        >>> recipe(name="salad", model=load("starter").config).model.image_size
        (192, 256)
    """
    size = choose("preset", preset, PRESETS)
    name = ("scratch" if preset == "tiny" else "crisalad") if name is None else name
    if name in RECIPES:
        return _of_model(RECIPES[name](size, preset), model)
    base, part = split_name(name)
    found = find_part(part, preset)
    if base is None:
        warn(f"recipe: found part {name}; using crisalad+{name}, CriSALAD with this part")
    return with_part(_of_model(RECIPES[base or "crisalad"](size, preset), model), found)


def _of_model(config: TrainConfig, model: ModelConfig | None) -> TrainConfig:
    """Apply a recipe to another model than its own, if one is given."""
    if model is None:
        return config
    fits = ADAPTERS not in terms_of(config.trainable) or has_adapters(model)
    trainable = config.trainable if fits else HEAD
    return dataclasses.replace(config, model=model, trainable=trainable, validation_size=None)


def model_of(
    model: ModelConfig,
    preset: str,
    backbone: Any,
    aggregator: str | None,
    *,
    head: Mapping[str, Any] | None = None,
    image_size: tuple[int, int] | None = None,
    compute_dtype: Any = "float32",
    **preprocessing: Any,
) -> ModelConfig:
    """Make the model of a published method, without a cross-image encoder.

    Training images are resized as `PreprocessingConfig.for_training` says, whatever is set here.
    For a preset that normalises by local contrast, such as `tiny`, only `filter` of
    `preprocessing` is used, because that preset is not a published model.

    Args:
        model: the preset's model.
        preset: the preset's name.
        backbone: the method's backbone.
        aggregator: name of the head, made in the preset's size; None keeps the model's.
        head: settings of the head that differ from the preset's.
        image_size: height and width for a convolutional backbone, which preset `tiny` replaces with
            a small ResNet at the preset's image size; None is the preset's size.
        compute_dtype: type of the matrix products; see `ModelConfig`.
        **preprocessing: how photographs are resized, as fields of `PreprocessingConfig`.

    Example:
        >>> from crisalad_jax import PRESETS
        >>> tiny = PRESETS["tiny"]
        >>> model_of(tiny, "tiny", tiny.backbone, "gem", filter="bicubic").preprocessing.filter
        'bicubic'
    """
    if preset == "tiny" and image_size is not None:
        backbone, image_size = BACKBONES.make("resnet", preset), None
    chain, part = model.preprocessing, model.aggregator
    if aggregator is not None:
        part = AGGREGATORS.make(aggregator, preset, **(head or {}))
    if chain.normalisation == "local-contrast":
        preprocessing = {name: each for name, each in preprocessing.items() if name == "filter"}
    return dataclasses.replace(
        model,
        image_size=image_size or model.image_size,
        preprocessing=dataclasses.replace(chain, **preprocessing),
        backbone=backbone,
        aggregator=part,
        cross_image="none",
        compute_dtype=compute_dtype,
    )


def validation_size(preset: str, side: int) -> tuple[int, int] | None:
    """Return (side, side) as the validation size; for preset `tiny` None, the model's own size."""
    return None if preset == "tiny" else (side, side)


def split_name(name: str) -> tuple[str | None, str]:
    """Split RECIPE+PART into the two names; the recipe is None if there is only a part.

    Example:
        >>> split_name("crisalad+step:newton"), split_name("gem")
        (('crisalad', 'step:newton'), (None, 'gem'))
    """
    base, plus, part = name.partition("+")
    return (base, part) if plus and base in RECIPES else (None, name)


def mines_tuples(name: str) -> bool:
    """Return whether a name belongs to a recipe that mines tuples.

    Example:
        >>> mines_tuples("netvlad"), mines_tuples("salad"), mines_tuples("crisalad+netvlad")
        (True, False, False)
    """
    return name in RECIPES and recipe("b14", name).mines


def mixes_sets(name: str) -> bool:
    """Return whether a name belongs to a recipe that trains on a mixture of training sets."""
    return name in RECIPES and bool(recipe("b14", name).mixture)


def find_part(
    name: str, preset: str, *, what: str = "recipe", others: Iterable[str] = RECIPES
) -> Part:
    """Look up a part that `with_part` can swap in.

    Args:
        name: the part's name, or KIND:NAME if several kinds have a part of that name.
        preset: the size of the model, for which the part is made.
        what: what messages call the name.
        others: other names that the caller accepts, which messages list.

    Returns:
        The part.

    Raises:
        InputError: there is no such part, or several kinds have one.

    Example:
        >>> find_part("step:newton", "b14").part_name
        'newton'
    """
    kind, colon, part = name.rpartition(":")
    kinds = [each for each in _KINDS if each == kind or not colon]
    if not any(part in REGISTRIES[each] for each in kinds):
        load_entry_points()
    found = [each for each in kinds if part in REGISTRIES[each]]
    require(
        bool(found),
        f"{what}: found {name!r}, expected one of {', '.join(sorted(others))}, or a registered "
        f"part as NAME or KIND:NAME, with a kind of {', '.join(_KINDS)} (is a plug-in missing? "
        "--plugin FILE.py or MODULE)",
    )
    require(
        len(found) < 2,
        f"{what}: found {name!r}, which is a part of several kinds, expected "
        f"{' or '.join(f'{each}:{part}' for each in found)}",
    )
    return REGISTRIES[found[0]].make(part, preset)


_KINDS = (
    *("aggregator", "adapter", "cross_image", "step", "dustbin", "loss", "backbone"),
    *("augmentation", "sampler", "gradient", "start", "optimiser", "schedule"),
)


def with_part(config: TrainConfig, part: Any) -> TrainConfig:
    """Replace the part of a recipe that is of the same kind as `part`; leave the rest as it is.

    With a new aggregator, the model has no cross-image encoder: its descriptors are single-image.
    CriSALAD's backbone stays frozen, with the same adapters, so that methods differ only in how
    they use its features. A new adapter trains together with the head, unless everything trains.

    Raises:
        InputError: the part does not fit, or the recipe's model has no place for such a part.
    """
    kind, model = part.registry.kind, config.model
    if kind == "augmentation":
        return dataclasses.replace(config, augmentation=part)
    if kind == "sampler":
        return config.with_each(sampler=lambda _: part)
    if kind in ("optimiser", "schedule"):
        field = "kind" if kind == "optimiser" else "schedule"
        optimiser = dataclasses.replace(config.optimiser, **{field: part})
        return dataclasses.replace(config, optimiser=optimiser)
    if kind == "loss":

        def changed(loss: LossConfig) -> LossConfig:
            miner = "none" if part.ranks_all else loss.miner
            return dataclasses.replace(loss, kind=part, miner=miner)

        return config.with_each(loss=changed)
    if kind == "backbone":
        model = dataclasses.replace(model, backbone=part)
        trainable = config.trainable if has_adapters(model) else HEAD
        return dataclasses.replace(config, model=model, trainable=trainable, validation_size=None)
    if kind == "adapter":
        require(
            hasattr(model.backbone, "adapter"),
            f"recipe: found adapter {part.part_name!r} for backbone {model.backbone.part_name}, "
            "expected a vision transformer, such as vit",
        )
        backbone: Any = dataclasses.replace(model.backbone, adapter=part)
        model, trainable = dataclasses.replace(model, backbone=backbone), config.trainable
        if trainable != ALL:
            trainable = ADAPTERS_AND_HEAD if has_adapters(model) else HEAD
        return dataclasses.replace(config, model=model, trainable=trainable)
    if kind == "cross_image":
        return dataclasses.replace(config, model=dataclasses.replace(model, cross_image=part))
    if kind == "aggregator":
        return dataclasses.replace(config, model=with_head(model, part), validation_size=None)
    # The dustbin is a setting of the aggregator; the transport's other parts belong to the solver.
    field = "dustbin" if kind == "dustbin" else "sinkhorn"
    require(
        hasattr(model.aggregator, field),
        f"recipe: found {kind} {part.part_name!r} for aggregator {model.aggregator.part_name}, "
        "expected one that transports, such as salad",
    )
    if field != kind:
        part = dataclasses.replace(getattr(model.aggregator, field), **{kind: part})
    aggregator: Any = dataclasses.replace(model.aggregator, **{field: part})
    return dataclasses.replace(config, model=dataclasses.replace(model, aggregator=aggregator))


def with_head(model: ModelConfig, aggregator: Any) -> ModelConfig:
    """Return a model with this aggregator, and no cross-image encoder."""
    return dataclasses.replace(model, aggregator=aggregator, cross_image="none")


@takes(config=TrainConfig)
def from_scratch(config: TrainConfig) -> TrainConfig:
    """Change a recipe so that its model trains from random weights, like recipe `scratch`.

    The recipe's model and kind of loss stay, because they define its method. The optimiser, the
    loss's constants, the augmentation and the batches are those of `scratch`. The whole model
    trains, in float32. Exceptions: an augmentation from a plug-in stays, and so do batches that
    consist of mined tuples or mix several data sets.

    Args:
        config: the recipe.

    Returns:
        The configuration of a training run from random weights.

    Example:
        >>> from_scratch(recipe("tiny", "crisalad+gem")).trainable
        'all'
    """
    augmentation = config.augmentation
    if type(augmentation).__module__.startswith("crisalad_jax."):
        augmentation = LightAugmentConfig(colour=0.4, gamma=0.5, illumination=0.6)
    places = TrainConfig.places_per_batch
    batches = {"places_per_batch": places, "images_per_place": 2, "min_images": 2}
    order = {} if config.mixture else {"sampler": "shuffled"}
    return dataclasses.replace(
        config.with_each(
            loss=lambda loss: dataclasses.replace(loss, kind=loss.kind.from_scratch())
        ),
        model=dataclasses.replace(config.model, compute_dtype="float32"),
        optimiser=OptimiserConfig(
            kind=AdamW(b2=0.99),
            learning_rate=1e-3,
            schedule=LinearSchedule(end_fraction=0.02),
            warmup_steps=30,
            weight_decay=0.05,
            clip_norm=1.0,
        ),
        trainable="all",
        augmentation=augmentation,
        **({} if config.mines or config.mixture else batches),
        **order,
        epochs=150,
        validate_every=10,
        patience=None,
    )
