"""Count a model's trainable and frozen parameters, and its multiply-accumulates per image."""

from typing import Any, NamedTuple

from crisalad_jax.config.checks import check_count, takes
from crisalad_jax.config.io import to_plain
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.costs import PartCost, paper_adapter_macs, part_costs
from crisalad_jax.training.config import has_adapters
from crisalad_jax.training.trainable import ADAPTERS_AND_HEAD, HEAD, count_trainable


class AdapterSummary(NamedTuple):
    """Counts of one of a model's adapters."""

    parameters: int
    macs: int
    """Multiply-accumulates per image, with linear layers at all tokens."""
    paper_macs: int
    """The paper's count: each linear layer at one token, convolutions at every patch."""


@brief
class ModelSummary(NamedTuple):
    """Counts of a model's parameters and multiply-accumulates."""

    image_size: tuple[int, int]
    """Height and width in pixels."""
    images: str
    """How images are resized, as text."""
    preprocessing: dict[str, Any]
    """How images are resized and normalised, as JSON values."""
    descriptor: int
    """Length of a descriptor."""
    trainable: str
    """Which parameters train, as `split_params` takes it."""
    trainable_parameters: int
    frozen_parameters: int
    parts: list[PartCost]
    """Parameters and multiply-accumulates of each part."""
    one_adapter: AdapterSummary | None
    """Counts of one adapter; None if there are no adapters."""


@takes(config=ModelConfig)
def model_summary(
    config: ModelConfig, trainable: str | None = None, *, images: int = 16
) -> ModelSummary:
    """Count a model's parameters and multiply-accumulates, without running it.

    Args:
        config: the model's configuration.
        trainable: which parameters train, for `split_params`. None is the adapters and the head, or
            only the head if there are no adapters.
        images: number of images that attend to each other in the cross-image encoder.

    Returns:
        The counts.

    Raises:
        InputError: `trainable` does not fit the model (`split_params`), or `images` is below 1.

    Example:
        >>> from crisalad_jax import PRESETS
        >>> model_summary(PRESETS["b14"]).descriptor
        8448
    """
    check_count("batch size", images)
    if trainable is None:
        trainable = ADAPTERS_AND_HEAD if has_adapters(config) else HEAD
    trained = count_trainable(config, trainable)
    parts = part_costs(config, images=images)
    adapter = None
    if has_adapters(config):
        (all_blocks,) = (cost for cost in parts if cost.part == "adapters")
        count, macs = (x // config.backbone.depth for x in (all_blocks.parameters, all_blocks.macs))
        adapter = AdapterSummary(count, macs, paper_adapter_macs(config, macs))
    return ModelSummary(
        config.image_size,
        config.images_in_words,
        to_plain(config.preprocessing),
        config.descriptor_dim,
        trainable,
        trained,
        sum(cost.parameters for cost in parts) - trained,
        parts,
        adapter,
    )


def model_words(config: ModelConfig) -> str:
    """Describe a model's parts and its descriptor in one line.

    Args:
        config: the model's configuration.

    Returns:
        Clauses separated by semicolons, without a full stop.

    Example:
        >>> from crisalad_jax import PRESETS
        >>> model_words(PRESETS["b14"]).partition(";")[0]
        'backbone of width 768, 12 blocks, 0 registers, adapter depthwise'
    """
    backbone = config.backbone
    projection = "projected " if config.projection.dim else ""
    return (
        f"backbone of width {backbone.dim}, {backbone.depth} blocks{backbone.extras}; aggregator "
        f"{config.aggregator.part_name}; cross-image encoder {config.cross_image.part_name}; "
        f"{projection}descriptor of {config.descriptor_dim} dimensions"
    )


def summary_json(summary: ModelSummary, name: str) -> dict[str, Any]:
    """Convert a summary to JSON values, with the model's `name`."""
    values: dict[str, Any] = {"model": name} | summary._asdict()
    values["image_size"] = list(summary.image_size)
    values["parts"] = [cost._asdict() for cost in summary.parts]
    adapter: AdapterSummary | None = values.pop("one_adapter")
    return values if adapter is None else values | {"one_adapter": adapter._asdict()}


def summary_lines(summary: ModelSummary) -> list[str]:
    """Format a summary, without its table of parts, as lines for the terminal."""
    lines = [
        f"images                {summary.images}",
        f"descriptor            {summary.descriptor:>13,} dimensions",
        f"trainable             {summary.trainable_parameters:>13,} parameters "
        f"({summary.trainable})",
        f"frozen                {summary.frozen_parameters:>13,} parameters",
    ]
    if summary.one_adapter is not None:
        parameters, macs, paper_macs = summary.one_adapter
        lines += [
            f"one adapter           {parameters:>13,} parameters",
            f"  multiply-accumulates{macs:>13,} an image, linears at every token",
            f"  as the paper counts {paper_macs:>13,} (Table 3: each linear once, convolutions at "
            "every patch)",
        ]
    return lines
