"""Select the training sets of a mixture by name, and check the names that are given."""

import dataclasses
from collections.abc import Collection, Sequence

from crisalad_jax.config.checks import require
from crisalad_jax.training.config import DEFAULT_SAMPLER, MixtureSet, TrainConfig
from crisalad_jax.training.losses import LossConfig


def with_sets(config: TrainConfig, names: Sequence[str]) -> TrainConfig:
    """Adapt a configuration to the given training sets.

    A mixture is reduced to these sets, each with as many places per batch as before. If there is no
    mixture, the sets form one: all have the configuration's sampler and loss, and equal shares.

    Args:
        config: the configuration of a recipe or an earlier run.
        names: names of the sets; without names, the configuration is returned unchanged.

    Raises:
        InputError: the mixture has no such set, or the loss does not compare pairs of images.
    """
    if not names:
        return config
    places = config.places_per_batch
    if config.mixture:
        check_names("--data", names, config, least=1)
        shares = sum(each.share for each in config.mixture)
        mixture = tuple(each for each in config.mixture if each.name in names)
        places = places // shares * sum(each.share for each in mixture)
    else:
        mixture = tuple(MixtureSet(name, config.sampler, config.loss) for name in names)
        places = max(1, places // len(mixture)) * len(mixture)
    return dataclasses.replace(
        config,
        mixture=mixture,
        places_per_batch=places,
        sampler=DEFAULT_SAMPLER,
        loss=LossConfig(),
    )


def check_names(
    what: str, names: Collection[str], config: TrainConfig, *, least: int | None = None
) -> None:
    """Check the names of training sets.

    Args:
        what: the argument that gives the names, for messages.
        names: names of the given sets.
        config: the run's configuration; without a mixture no set has a name.
        least: minimum number of the mixture's sets; None requires all.

    Raises:
        InputError: a name is not in the mixture, or too few are given.
    """
    expected = [each.name for each in config.mixture]
    fits = set(names) <= set(expected) and len(names) >= (len(expected) if least is None else least)
    words = f"{'all' if least is None else 'some'} of {', '.join(expected)}, by their names"
    require(
        fits,
        f"{what}: found {', '.join(names) or 'one set without a name'}, expected "
        f"{words if expected else 'one set without a name'}",
    )
