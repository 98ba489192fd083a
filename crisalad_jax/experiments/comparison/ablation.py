"""The paper's Tables 2 and 3: CriSALAD with one part changed, and the costs of its adapters."""

import dataclasses
import functools
import pathlib
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from crisalad_jax.config.part import Part
from crisalad_jax.experiments.comparison.methods import training_with
from crisalad_jax.experiments.comparison.records import advised
from crisalad_jax.experiments.comparison.timing import Race, race
from crisalad_jax.nn.adapter import AdapterConfig, adapter, init_adapter
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import PRESETS, ModelConfig
from crisalad_jax.nn.costs import adapter_macs, paper_adapter_macs
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes import find_part, from_scratch, recipe
from crisalad_jax.utils.compiler import jit
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import read_json, write_json
from crisalad_jax.utils.pytree import named_leaves

AdapterKind = Literal["depthwise", "multi-resolution", "mlp", "none"]


class Ablation(NamedTuple):
    """A row of Table 2."""

    adapter: AdapterKind = "depthwise"
    encoder: bool = True
    learning_rate: float = 6e-5
    schedule: Literal["linear", "step"] = "linear"

    def training(self, preset: str, *, from_nothing: bool) -> TrainConfig:
        """Make the paper's recipe with these changes, or from nothing that of `scratch`."""
        config = recipe(preset, "crisalad")
        backbone = dataclasses.replace(
            config.model.backbone,
            adapter=AdapterConfig(kind=self.adapter),
        )
        model = dataclasses.replace(config.model, backbone=backbone)
        if not self.encoder:
            cross_image = dataclasses.replace(model.cross_image, layers=0)
            model = dataclasses.replace(model, cross_image=cross_image)
        # The backbone stays frozen: without adapters the head alone trains.
        trainable = "head" if self.adapter == "none" else config.trainable
        config = dataclasses.replace(config, model=model, trainable=trainable)
        rate = self.learning_rate
        if from_nothing:
            config = from_scratch(config)
            rate *= config.optimiser.learning_rate / OptimiserConfig.learning_rate
        optimiser = dataclasses.replace(
            config.optimiser, learning_rate=rate, schedule=self.schedule
        )
        return dataclasses.replace(config, optimiser=optimiser)


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
"""The paper's rows, and one without any adapter, which the paper lacks. Its last row, printed with
the step schedule, is also here with the linear one, which changes a single part."""


def row_training(name: str, preset: str, *, from_nothing: bool) -> TrainConfig:
    """Look up how a row of an ablation is trained.

    Args:
        name: of `ABLATIONS`, or a registered part, as NAME or KIND:NAME, in the place of CriSALAD's
            own.
        preset: the size of the model.
        from_nothing: whether training starts from random weights.

    Returns:
        The configuration.

    Raises:
        InputError: there is no such row or part, or it does not fit.

    Example:
        >>> row_training("triplet", "b14", from_nothing=False).loss.kind.part_name
        'triplet'
    """
    if name in ABLATIONS:
        return ABLATIONS[name].training(preset, from_nothing=from_nothing)
    return training_with(find_row(name, preset), preset, from_nothing=from_nothing)


def find_row(name: str, preset: str) -> Part:
    """Look up the part that a row swaps which is none of `ABLATIONS`; raises as `find_part`."""
    return find_part(name, preset, what="--rows", others=ABLATIONS)


ROW_HEADERS = ("row", "adapter", "cross-image encoder", "learning rate", "scheduler")
"""Headers of a row's name and of its `row_labels`."""


def row_labels(training: TrainConfig) -> tuple[str, ...]:
    """Describe adapter, encoder, learning rate and scheduler in words."""
    model, optimiser = training.model, training.optimiser
    encoder = "yes" if model.cross_image.layers else "no"
    rate = f"{optimiser.learning_rate:.2g}"
    return (adapter_kind(model), encoder, rate, optimiser.schedule)


def adapter_kind(model: ModelConfig) -> str:
    """Return the kind of a model's adapters; "none" where its backbone has no such setting."""
    return getattr(model.backbone, "adapter", AdapterConfig(kind="none")).kind


class AdapterCost(NamedTuple):
    """A row of Table 3."""

    adapter: str
    paper_parameters: int
    """Number of parameters as the paper counts them, see `NOTES`."""
    parameters: int
    """Number of parameters of one adapter here, with batch norms' running statistics."""
    paper_macs: int
    macs: int
    """Multiply-accumulates that an image really takes."""
    time: tuple[float, float, float] | None
    """Time over the depthwise adapter's: median, least and most of the rounds."""


NOTES = (
    "Table 3 at the paper's size: ViT-B/14, 224 x 224 pixels, 256 patches and a class token.",
    "Parameters as the paper counts them: of the depthwise adapter all weights, the biases of its "
    "two convolutions, and none of its two linears, which have none: 741,504. The other reading, a "
    "bias of the up-projection and none of the convolutions, has as many "
    '(`AdapterConfig.bias="up"`). Of the '
    "multi-resolution adapter all weights and the biases of its two linears, without its "
    "convolutions' biases (432) and its batch norms (864, and 864 running statistics): 761,472.",
    "MACs as the paper counts them: each linear once an image, convolutions at 256 positions, "
    "biases and norms never. FLOPs are twice that. Truly a linear acts on all 257 tokens.",
    "The paper's MLP row counts otherwise: 1.181 M is 2 x 589,824 + 1,152, two a weight and one a "
    "bias (0.590 M by the count of the other rows). Its parameters, printed as 2356.08 K, follow "
    "from neither count: the MLP adapter at the others' width has 590,976.",
)


def adapter_costs(*, measure: bool = True, rounds: int = 5, images: int = 4) -> list[AdapterCost]:
    """Compute Table 3, of one adapter at the paper's size.

    Args:
        measure: whether to time the adapters, in turns.
        rounds: number of turns of each.
        images: number of images in a batch.
    """
    kinds: tuple[AdapterKind, ...] = ("mlp", "multi-resolution", "depthwise")
    raced = _race(kinds, rounds, images) if measure else None
    return [
        AdapterCost(
            kind,
            _paper_parameters(kind),
            sum(leaf.size for leaf in _sizes(kind).values()),
            _paper_macs(kind),
            adapter_macs(_model(kind)),
            None if raced is None else raced.slower(kind, "depthwise"),
        )
        for kind in kinds
    ]


def adapter_costs_once(out: pathlib.Path) -> list[AdapterCost]:
    """Measure Table 3 in the first call for a folder; later calls read its adapters.json.

    Raises:
        InputError: that file is not whole.
    """
    path = out / "adapters.json"
    if not path.exists():
        write_json(path, {"costs": [cost._asdict() for cost in adapter_costs()]})
    with advised():
        value = read_json(path, "costs of adapters")
        try:
            return [AdapterCost(**row) for row in value["costs"]]
        except (KeyError, TypeError) as error:
            raise InputError(f"{path}: found {error}, expected costs of adapters") from error


def _model(kind: AdapterKind) -> ModelConfig:
    backbone = ViTConfig(adapter=AdapterConfig(kind=kind))
    return dataclasses.replace(PRESETS["b14"], backbone=backbone)


def _sizes(kind: AdapterKind) -> dict[str, Any]:
    make = functools.partial(init_adapter, dim=ViTConfig().dim, config=AdapterConfig(kind=kind))
    return named_leaves(jax.eval_shape(make, jax.random.key(0)))


def _paper_parameters(kind: AdapterKind) -> int:
    linears = ("down.", "up.")
    if kind == "multi-resolution":
        counted = [
            leaf.size
            for name, leaf in _sizes(kind).items()
            if name.startswith(linears) or name.endswith("conv.weight")
        ]
        return sum(counted)
    return sum(leaf.size for leaf in _sizes(kind).values())


def _paper_macs(kind: AdapterKind) -> int:
    macs = paper_adapter_macs(_model(kind))
    if kind != "mlp":
        return macs
    biases = [leaf.size for name, leaf in _sizes(kind).items() if name.endswith("bias")]
    return 2 * macs + sum(biases)


def _race(kinds: tuple[AdapterKind, ...], rounds: int, images: int) -> Race:
    dim, patches = ViTConfig().dim, 16 * 16
    tokens = jnp.ones((images, 1 + patches, dim), jnp.float32)

    @functools.partial(jit, static_argnames="grid")
    def apply(params: Any, tokens: jax.Array, grid: tuple[int, int]) -> jax.Array:
        return adapter(params, tokens, grid)

    def call(kind: AdapterKind) -> Any:
        params = init_adapter(jax.random.key(0), dim, AdapterConfig(kind=kind))
        return lambda: jax.block_until_ready(apply(params, tokens, (16, 16)))

    return race({kind: functools.partial(call, kind) for kind in kinds}, rounds)
