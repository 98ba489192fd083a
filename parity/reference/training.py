"""Training: freezing, torch's AdamW, and the linear schedule (paper section 4.2)."""

import re
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.utils.errors import InputError
from parity.reference.losses import multi_similarity_loss
from parity.reference.model import Crisalad

HEAD = ("aggregator.", "aggregation.", "encoder.")


def freeze(model: Crisalad, trainable: str) -> list[nn.Parameter]:
    """Let gradients flow only to the parameters that `trainable` names, and return those.

    "head,-adapters" (aggregator and cross-image encoder), "adapters,head" (the paper),
    "last-N-blocks,norm,head" (SALAD: the last N blocks, the final layer norm, and the head), or
    "all". Batch-norm statistics are buffers: they have no gradient, and every forward pass in
    training mode updates them.

    Raises:
        InputError: an unknown name, or more blocks than exist.
    """
    depth = len(model.backbone.blocks)
    match = re.fullmatch(r"last-(\d+)-blocks,norm,head", trainable)
    if trainable == "all":
        prefixes: tuple[str, ...] = ("",)
    elif trainable == "head,-adapters":
        prefixes = HEAD
    elif trainable == "adapters,head":
        prefixes = (*HEAD, *(f"backbone.blocks.{i}.adapter." for i in range(depth)))
    elif match and int(match[1]) <= depth:
        last = range(depth - int(match[1]), depth)
        prefixes = (*HEAD, "backbone.norm.", *(f"backbone.blocks.{i}." for i in last))
    else:
        raise InputError(
            f"trainable: found {trainable!r}, expected head,-adapters, adapters,head or "
            f"last-N-blocks,norm,head with N at most {depth}, or all"
        )
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(name.startswith(prefixes))
    return [parameter for parameter in model.parameters() if parameter.requires_grad]


def learning_rate_factor(config: OptimiserConfig, step: int, steps: int) -> float:
    """Return the share of the peak at `step`: 1 / n to 1 in n warm-up steps, then linear decay.

    The schedule's `end_fraction` is reached after the last of `steps`, counted from 0.
    """
    if step < config.warmup_steps:
        return (step + 1) / config.warmup_steps
    done = (step - config.warmup_steps) / max(steps - config.warmup_steps, 1)
    return 1 - (1 - config.schedule.end_fraction) * min(done, 1.0)


def train(
    model: Crisalad,
    batches: Iterable[tuple[Tensor, Tensor]],
    config: TrainConfig,
    *,
    steps: int,
) -> list[float]:
    """Train `model` in place, one step per batch, and return the loss of each batch.

    Args:
        model: left in training mode. Its own configuration is used, not `config.model`.
        batches: (images, labels): (image, 3, height, width), normalised, and (image,).
        config: loss, optimiser and trainable parameters.
        steps: length of the schedule.

    Raises:
        InputError: `config.trainable` doesn't fit the model.
    """
    parameters = freeze(model, config.trainable)
    optimiser = torch.optim.AdamW(
        parameters,
        lr=config.optimiser.learning_rate,
        betas=(config.optimiser.kind.b1, config.optimiser.kind.b2),
        weight_decay=config.optimiser.weight_decay,
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser, lambda step: learning_rate_factor(config.optimiser, step, steps)
    )
    model.train()
    losses = []
    for images, labels in batches:
        optimiser.zero_grad()
        loss = multi_similarity_loss(model(images), labels, config.loss).loss
        loss.backward()
        if config.optimiser.clip_norm is not None:
            clip_gradients(parameters, config.optimiser.clip_norm)
        optimiser.step()
        schedule.step()
        losses.append(loss.item())
    return losses


def clip_gradients(parameters: list[nn.Parameter], largest: float) -> None:
    """Scale the whole gradient down to the norm `largest` if it is longer."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    norm = torch.nn.utils.get_total_norm(gradients)
    # torch's clip_grad_norm_ divides by the norm + 1e-6; optax, and so crisalad_jax, does not.
    if norm > largest:
        for gradient in gradients:
            gradient.mul_(largest / norm)
