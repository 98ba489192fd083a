"""The paper's Tables 2 and 3: CriSALAD with one thing changed, and what its adapters cost."""

import dataclasses
import functools
import json
import pathlib
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from crisalad_jax.comparison.speed import Race, race
from crisalad_jax.config import (
    PRESETS,
    AdapterConfig,
    ModelConfig,
    OptimiserConfig,
    TrainConfig,
    ViTConfig,
    from_scratch,
    recipe,
)
from crisalad_jax.costs import adapter_macs, paper_adapter_macs
from crisalad_jax.errors import InputError
from crisalad_jax.files import write_json
from crisalad_jax.nn.adapter import adapter, init_adapter
from crisalad_jax.platform import jit
from crisalad_jax.pytree import named_leaves

AdapterKind = Literal["depthwise", "multi-resolution", "mlp", "none"]


class Ablation(NamedTuple):
    """A row of Table 2."""

    adapter: AdapterKind = "depthwise"
    encoder: bool = True
    learning_rate: float = 6e-5
    schedule: Literal["linear", "step"] = "linear"

    def training(self, preset: str, *, from_nothing: bool) -> TrainConfig:
        """The paper's recipe with these, or from nothing `scratch`'s with its rate scaled alike."""
        config = recipe(preset, "crisalad")
        backbone = dataclasses.replace(
            config.model.backbone,
            adapter=AdapterConfig(kind=self.adapter),
        )
        model = dataclasses.replace(config.model, backbone=backbone)
        if not self.encoder:
            model = dataclasses.replace(model, encoder=dataclasses.replace(model.encoder, layers=0))
        # What is frozen stays frozen: without adapters the head alone trains.
        trains = "head" if self.adapter == "none" else config.trains
        config = dataclasses.replace(config, model=model, trains=trains)
        rate = self.learning_rate
        if from_nothing:
            config = from_scratch(config)
            rate *= config.optimiser.learning_rate / OptimiserConfig.learning_rate
        optimiser = dataclasses.replace(
            config.optimiser, learning_rate=rate, schedule=self.schedule
        )
        return dataclasses.replace(config, optimiser=optimiser)

    def labels(self, training: TrainConfig) -> tuple[str, ...]:
        """Adapter, encoder, learning rate and scheduler, in words."""
        rate = f"{training.optimiser.learning_rate:.2g}"
        return (self.adapter, "yes" if self.encoder else "no", rate, self.schedule)


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
"""The paper's rows, its last with the step schedule as printed and with the linear one, which
changes one thing alone; and no adapter at all, which the paper has not."""


class AdapterCost(NamedTuple):
    """A row of Table 3."""

    adapter: str
    paper_parameters: int
    """As the paper counts them, see `NOTES`."""
    parameters: int
    """All numbers of one adapter here, of batch norms the running statistics too."""
    paper_macs: int
    macs: int
    """True multiply-accumulates an image."""
    time: tuple[float, float, float] | None
    """Measured, over the depthwise adapter's: median of the rounds, least, most."""


NOTES = (
    "Table 3 at the paper's size: ViT-B/14, 224 x 224 pixels, 256 patches and a class token.",
    "Parameters as the paper counts them: of the depthwise adapter all weights, the biases of its "
    "two convolutions, and none of its two linears, which have none: 741,504. Of the "
    "multi-resolution adapter all weights and the biases of its two linears, without its "
    "convolutions' biases (432) and its batch norms (864, and 864 running statistics): 761,472.",
    "MACs as the paper counts them: each linear once an image, convolutions at 256 positions, "
    "biases and norms never. FLOPs are twice that. Truly a linear acts on all 257 tokens.",
    "The paper's MLP row counts otherwise: 1.181 M is 2 x 589,824 + 1,152, two a weight and one a "
    "bias (0.590 M by the count of the other rows). Its parameters, printed as 2356.08 K, follow "
    "from neither count: the MLP adapter at the others' width has 590,976.",
)


def adapter_costs(*, measure: bool = True, rounds: int = 5, images: int = 4) -> list[AdapterCost]:
    """Table 3, of one adapter at the paper's size.

    Args:
        measure: whether to time them, in turns, at so many images.
        rounds: turns of each.
        images: of a batch.
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
    """Table 3, measured in the first call for a folder, read from its adapters.json in others.

    Raises:
        InputError: that file is not whole.
    """
    path = out / "adapters.json"
    if not path.exists():
        write_json(path, [cost._asdict() for cost in adapter_costs()])
    try:
        found = [AdapterCost(**row) for row in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: cannot read these costs: {error}; delete it, and the same command makes it "
            "anew"
        ) from error
    return found


def _model(kind: AdapterKind) -> ModelConfig:
    backbone = dataclasses.replace(PRESETS["b14"].backbone, adapter=AdapterConfig(kind=kind))
    return dataclasses.replace(PRESETS["b14"], backbone=backbone)


def _sizes(kind: AdapterKind) -> dict[str, Any]:
    template = jax.eval_shape(
        functools.partial(init_adapter, config=_model(kind).backbone), jax.random.key(0)
    )
    return named_leaves(template)


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
    config = PRESETS["b14"].backbone
    patches = 16 * 16
    tokens = jnp.ones((images, 1 + patches, config.dim))

    @functools.partial(jit, static_argnames="grid")
    def apply(params: Any, tokens: jax.Array, grid: tuple[int, int]) -> jax.Array:
        return adapter(params, tokens, grid)

    def call(kind: AdapterKind) -> Any:
        backbone: ViTConfig = _model(kind).backbone
        params = init_adapter(jax.random.key(0), backbone)
        return lambda: jax.block_until_ready(apply(params, tokens, (16, 16)))

    return race({kind: functools.partial(call, kind) for kind in kinds}, rounds)
