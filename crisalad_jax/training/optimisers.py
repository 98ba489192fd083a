"""Optimisers: the interface of custom ones, the built-in ones, and optax's by dotted name."""

import abc
import dataclasses
import functools
import inspect
import re
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

import jax

from crisalad_jax.config.checks import Fraction, require
from crisalad_jax.config.part import Part
from crisalad_jax.config.registry import Registry, count_arguments
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.output import one_line
from crisalad_jax.utils.pytree import named_leaves

Rate = Callable[[Any], Any]
"""A learning rate as a function of the step number, as in optax."""
_PREFIX = "optax."


class Optimiser(Part, abc.ABC):
    """An optimiser, as a frozen dataclass whose fields are its settings.

    A plain function of (learning_rate, weight_decay) that returns an optax transformation is an
    optimiser without settings. If it takes only (learning_rate), the weight decay is added to the
    gradient, as in torch's Adam and SGD.

    Example:
        >>> import optax
        >>> from crisalad_jax import OptimiserConfig, register_optimiser
        >>> @register_optimiser("lion")
        ... def lion(learning_rate, weight_decay):
        ...     return optax.lion(learning_rate, weight_decay=weight_decay)
        >>> OptimiserConfig(kind="lion", learning_rate=1e-5).kind.part_name
        'lion'
    """

    @abc.abstractmethod
    def make(self, learning_rate: Rate, weight_decay: float) -> Any:
        """Return an optax transformation, which turns gradients into updates of the weights.

        Args:
            learning_rate: a function of the optimiser's step number, from 0.
            weight_decay: `OptimiserConfig.weight_decay`.
        """


def _of_function(function: Callable[..., Any]) -> Mapping[str, Any]:
    """Return the methods of an optimiser that is a plain function."""
    takes_decay = count_arguments(function, "learning_rate", "weight_decay") == 2

    def make(_: Any, learning_rate: Rate, weight_decay: float) -> Any:
        if takes_decay:
            return function(learning_rate, weight_decay)
        return _decayed(weight_decay, function(learning_rate))

    return {"make": make}


_MATRICES = "muon_weight_dimension_numbers"
"""Argument that says which arrays optax's Muon orthogonalises as matrices; Adam updates the others.
By default an array of two axes counts as a matrix, one of three does not."""
_TOKENS = re.compile(r"token|pos_embed")


def _decayed(weight_decay: float, optimiser: Any) -> Any:
    """Add the weight decay to the gradient before the optimiser."""
    import optax

    return optax.chain(optax.add_decayed_weights(weight_decay), optimiser)


@functools.cache
def _of_optax(name: Any) -> type[Optimiser] | None:
    """Make an optimiser from an optax function, with the function's plain arguments as settings.

    Args:
        name: a name such as optax.contrib.muon; for names outside optax the result is None.

    Raises:
        InputError: there is no such function in optax, or it takes no learning rate.
    """
    if not name.startswith(_PREFIX):
        return None
    import optax

    found: Any = optax
    for part in name.removeprefix(_PREFIX).split("."):
        found = None if part.startswith("_") else getattr(found, part, None)
    # optax's modules also contain names of other libraries.
    is_ours = inspect.isfunction(found) and found.__module__.startswith(_PREFIX)
    parameters = inspect.signature(found).parameters if is_ours else {}
    require(
        "learning_rate" in parameters,
        f"optimiser: found {name!r}, expected a function of optax that takes a learning rate, such "
        "as optax.lion or optax.contrib.muon",
    )
    fields: list[Any] = []
    for each in parameters.values():
        kind = _plain_type(each.default, each.annotation)
        if kind is not None and each.name not in ("learning_rate", "weight_decay"):
            fields.append((each.name, kind, each.default))
    namespace = {
        "__doc__": (inspect.getdoc(found) or name).partition("\n")[0],
        "__module__": __name__,
        "__qualname__": name,
        "part_name": name,
        "function": staticmethod(found),
    }
    kind = name.rpartition(".")[2]
    return dataclasses.make_dataclass(
        kind, fields, bases=(_OptaxOptimiser,), frozen=True, namespace=namespace
    )


def _plain_type(default: Any, annotation: Any) -> Any:
    """Return the type of a field for an optax argument; None if no field can hold it."""
    if isinstance(default, bool | int | float | str):
        return type(default)
    if isinstance(default, tuple) and all(isinstance(each, float) for each in default):
        return tuple[float, ...]
    if default is None:
        choices = typing.get_args(annotation)
        takes_trees = any(typing.get_origin(each) is Iterable for each in choices)
        kinds = () if takes_trees else (float, int)
        return next((kind | None for kind in kinds if kind in choices), None)
    return None


class _OptaxOptimiser(Optimiser):
    """The base class of the parts that `_of_optax` makes."""

    function: ClassVar[Callable[..., Any]]

    def __post_init__(self) -> None:
        """Trace a step, because a function may need more than a gradient, or reject a setting."""

        def step(weights: Any) -> Any:
            optimiser = self.make(lambda count: 1e-3, 0.0)
            return optimiser.update(weights, optimiser.init(weights), weights)

        try:
            jax.eval_shape(step, {"weight": jax.ShapeDtypeStruct((2, 2), "float32")})
        except Exception as error:
            raise InputError(
                f"optimiser {self.part_name}: cannot step with only a gradient and a schedule: "
                f"{type(error).__name__}: {one_line(error)}"
            ) from error

    def make(self, learning_rate: Rate, weight_decay: float) -> Any:
        """Call the function; if it takes no weight decay, add that to the gradient."""
        settings = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        settings["learning_rate"] = learning_rate
        parameters = inspect.signature(self.function).parameters
        if _MATRICES in parameters:
            settings[_MATRICES] = _matrices
        if "weight_decay" in parameters:
            return self.function(**settings, weight_decay=weight_decay)
        return _decayed(weight_decay, self.function(**settings))


def _matrices(weights: Any) -> Any:
    """Return the two axes of each matrix, and None for everything else; see `_MATRICES`.

    The first axis of a stack numbers the blocks: stacked vectors are not matrices. Embeddings, such
    as tokens and positions, are not treated as matrices either (Jordan et al. 2024).
    """
    from optax.contrib import MuonDimensionNumbers

    names = iter(named_leaves(weights))

    def axes(leaf: Any) -> Any:
        name = next(names)
        own = leaf.ndim - name.startswith("backbone.blocks.")
        return MuonDimensionNumbers(-2, -1) if own == 2 and not _TOKENS.search(name) else None

    return jax.tree.map(axes, weights)


OPTIMISERS = Registry(
    "optimiser", Optimiser, of_function=_of_function, find_other=_of_optax, others="optax.NAME"
)
register_optimiser = OPTIMISERS.register


@dataclasses.dataclass(frozen=True)
class _Moments(Optimiser):
    """Decays of the two moments of Adam."""

    b1: Fraction = 0.9
    """Decay of the running mean of the gradients."""
    b2: Fraction = 0.999
    """Decay of the running mean of the squared gradients."""


@OPTIMISERS.register("adamw")
class AdamW(_Moments):
    """AdamW (Loshchilov and Hutter 2019), as in torch: weight decay is decoupled from the gradient.

    Example:
        >>> from crisalad_jax import OptimiserConfig
        >>> OptimiserConfig(kind=AdamW(b2=0.99)).kind.b1
        0.9
    """

    def make(self, learning_rate: Rate, weight_decay: float) -> Any:
        """Return optax's AdamW."""
        import optax

        return optax.adamw(learning_rate, self.b1, self.b2, weight_decay=weight_decay)


@OPTIMISERS.register("adam")
class Adam(_Moments):
    """Adam (Kingma and Ba 2015), as in torch: the weight decay is part of the gradient."""

    def make(self, learning_rate: Rate, weight_decay: float) -> Any:
        """Return optax's Adam, with the weight decay first added to the gradient."""
        import optax

        return _decayed(weight_decay, optax.adam(learning_rate, self.b1, self.b2))


@OPTIMISERS.register("sgd")
class Sgd(Optimiser):
    """SGD with torch's momentum, without dampening; the weight decay is part of the gradient."""

    momentum: Fraction = 0.9
    """Share of the previous update's direction to retain."""

    def make(self, learning_rate: Rate, weight_decay: float) -> Any:
        """Return optax's SGD, with the weight decay first added to the gradient."""
        import optax

        return _decayed(weight_decay, optax.sgd(learning_rate, self.momentum))
