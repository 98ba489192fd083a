"""One compiled training step: the loss, its gradient, and the optimiser (paper section 4.2)."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree, UInt8

from crisalad_jax.config.checks import require, takes
from crisalad_jax.config.short_repr import brief
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.layers import split_statistics
from crisalad_jax.nn.model import Crisalad, describe_training_batch
from crisalad_jax.nn.pixels import check_pixels
from crisalad_jax.nn.tokens import TransportStatistics
from crisalad_jax.training import distributed
from crisalad_jax.training.classifier import Classifiers, init_classifiers, update_classifiers
from crisalad_jax.training.config import MixtureSet, OptimiserConfig, TrainConfig
from crisalad_jax.training.losses import LossConfig, LossResult, metric_loss, tuple_pairs
from crisalad_jax.training.losses.base import GivenLoss
from crisalad_jax.training.optimiser import (
    averaged_weights,
    count_steps,
    learning_rate_schedule,
    make_optimiser,
    warn_of_long_warmup,
)
from crisalad_jax.training.trainable import split_params
from crisalad_jax.utils import compiler, devices
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves

WHOLE_LOSS = 1024
"""Maximum number of images for which every device computes the whole loss, at most 1 % of a step's
work (docs/training.md). For more images, XLA splits the loss and exchanges its parts."""
LossFunction = Callable[..., Float[Array, ""]]
"""Takes (descriptors, labels), (descriptors, labels, valid) or a `LossBatch`."""


@brief
class TrainState(NamedTuple):
    """The part of a training run that each step updates."""

    step: Int[Array, ""]
    trainable: PyTree
    """Trainable parameters and updated running statistics; all other leaves are None."""
    optimiser: PyTree
    classifiers: Classifiers | None = None
    """Parameters of the loss, if it has any."""

    def saved_loss(self, config: LossConfig) -> PyTree:
        """Return the loss's parameters that weight files store, if any.

        Class vectors and projections to a teacher's descriptor length are large and useless after
        the run: only `state/` stores them.
        """
        of_run = config.kind.grouping is not None or config.kind.reads_targets
        return None if of_run or self.classifiers is None else self.classifiers.weights

    @property
    def averaged(self) -> PyTree:
        """`trainable` for validation and saving, averaged over steps if the optimiser does that."""
        statistics, learnt = split_statistics(self.trainable)
        return eqx.combine(averaged_weights(self.optimiser, learnt), statistics)


@brief
class Metrics(NamedTuple):
    """Scalars of one step."""

    loss: Float[Array, ""]
    easy_anchor_fraction: Float[Array, ""]
    """Share of the anchors whose positives are all too easy for the miner to choose."""
    accuracy: Float[Array, ""] | None
    """Share of the images that are nearest to their own class; None without classification."""
    loss_numbers: Mapping[str, Array] | None
    """Other scalars of the loss (`LossValue.numbers`)."""
    gradient_norm: Float[Array, ""]
    """Euclidean norm of the whole gradient before clipping, loss parameters included."""
    learning_rate: Float[Array, ""] | None
    """Learning rate of this step; None for an optimiser that was passed in."""
    images: Int[Array, ""]
    """Number of valid images."""
    transport: TransportStatistics | None
    """Means over valid images, with dropout if any; None if the aggregator has no transport."""
    updated: Bool[Array, ""]
    """Whether the step was taken; False if it was skipped."""


def named_scalars(values: Metrics | TransportStatistics) -> dict[str, float]:
    """Return named scalars, without None; `transport.` is cut, `loss_numbers.` becomes `loss.`."""
    return {
        name.removeprefix("transport.").replace("loss_numbers.", "loss.", 1): float(leaf)
        for name, leaf in named_leaves(values).items()
    }


@dataclasses.dataclass(frozen=True)
class StepConfig:
    """The static argument of a compiled training step: all settings that it depends on."""

    model: ModelConfig
    loss: LossConfig
    optimiser: OptimiserConfig | optax.GradientTransformation
    steps: int = 1
    """Number of steps of the run, for a schedule that spans it."""
    steps_per_epoch: int = 1
    """Number of steps of an epoch, for schedules by epochs and for gradient accumulation, which
    ends with each epoch."""
    micro_batch: int | None = None
    """Number of images that pass through the backbone at a time; None is the whole batch."""
    shard_over: Mesh | None = None
    """Devices to shard the state over, as `devices.shard_spec` says; None replicates it.

    The gradient is taken on replicated parameters, the optimiser step on shards (the first stage of
    ZeRO, Rajbhandari et al. 2020)."""
    classes: tuple[int, ...] = ()
    """Number of classes of each group, if the loss classifies; an epoch trains one group."""
    batch_norm: Literal["batch", "stored"] = "batch"
    """Whether batch norms use the statistics of the batch or the stored ones."""
    tuples: bool = False
    """Whether labels are those of mined tuples (`tuple_labels`), not of places."""
    mixture: tuple[MixtureSet, ...] = ()
    """Sets whose sub-batches have their own losses, instead of `loss`."""

    def sub_batches(self, images: int) -> tuple[int, ...]:
        """Return the number of images of each set in a step, in the order of the sets."""
        shares = [each.share for each in self.mixture]
        return tuple(images * share // sum(shares) for share in shares)

    def learning_rate(self, step: Int[Array, ""]) -> Float[Array, ""] | None:
        """Compute the learning rate of a step (from 0); None if the optimiser was passed in."""
        if not isinstance(self.optimiser, OptimiserConfig):
            return None
        schedule = learning_rate_schedule(self.optimiser, self.steps, self.steps_per_epoch)
        return jnp.asarray(schedule(count_steps(self.optimiser, step, self.steps_per_epoch)))

    def make_optimiser(self) -> optax.GradientTransformation:
        """Make the optimiser of a run of `steps` steps."""
        if not isinstance(self.optimiser, OptimiserConfig):
            return self.optimiser
        return make_optimiser(self.optimiser, self.steps, self.steps_per_epoch)

    @property
    def compute_dtype(self) -> str:
        """Type of the model's matrix products."""
        return self.model.compute_dtype

    @property
    def precision(self) -> str:
        """Precision of the model's float32 products."""
        return self.model.precision


@takes(config=StepConfig)
def init_train_state(
    params: Crisalad, trainable: str, config: StepConfig, *, key: PRNGKeyArray | None = None
) -> tuple[TrainState, PyTree]:
    """Make the initial training state, and split off the frozen parameters.

    Warn if the warm-up takes more than a quarter of the run.

    Args:
        params: parameters to start from.
        trainable: which parameters train, as `split_params` takes it.
        config: the step's configuration, from `step_config`.
        key: random key for the parameters of the loss, if it has any.

    Returns:
        (state, frozen). The state is a copy, so `params` can still be used.

    Raises:
        InputError: `trainable` does not fit the model; no parameter would train; the aggregator
            (AnyLoc's) cannot be trained; the loss needs a key or numbers of classes that are not
            given; or a loss of a mixture has parameters of its own.

    Example:
        >>> import jax
        >>> from crisalad_jax import init_crisalad, recipe, step_config
        >>> config = recipe("tiny")
        >>> params = init_crisalad(jax.random.key(0), config.model)
        >>> static = step_config(config, steps=1000)
        >>> state, frozen = init_train_state(params, config.trainable, static)
        >>> int(state.step)
        0
    """
    with compiler.number_types([config]):
        if isinstance(config.optimiser, OptimiserConfig) and distributed.is_primary():
            warn_of_long_warmup(config.optimiser, config.steps, config.steps_per_epoch)
        chosen, frozen = split_params(params, config.model, trainable)
        require(
            config.model.aggregator.trainable and bool(jax.tree.leaves(chosen)),
            f"trainable: found {trainable}, of which backbone {config.model.backbone.part_name} "
            f"with aggregator {config.model.aggregator.part_name} trains nothing, expected another "
            "(`crisalad vocabulary` makes AnyLoc's models)",
        )
        statistics = None
        if config.batch_norm == "batch":
            statistics, frozen = split_statistics(frozen)
        # Copied, because a step donates the buffers of its state, and `params` are the caller's.
        chosen, statistics = jax.tree.map(jnp.copy, (chosen, statistics))
        optimiser = config.make_optimiser().init(chosen)
        dim = config.model.descriptor_dim
        classifiers = init_classifiers(key, config.loss.kind, config.classes, dim)
        for each in config.mixture:
            require(
                init_classifiers(key, each.loss.kind, (), dim) is None,
                f"mixture.{each.name}.loss: found {each.loss.kind.part_name}, which has parameters "
                "of its own, expected a loss without",
            )
        if statistics is not None:
            chosen = eqx.combine(chosen, statistics)
        return TrainState(jnp.zeros((), jnp.int32), chosen, optimiser, classifiers), frozen


@takes(config=TrainConfig)
def step_config(
    config: TrainConfig,
    *,
    steps: int,
    steps_per_epoch: int = 1,
    optimiser: optax.GradientTransformation | None = None,
    loss: LossFunction | None = None,
    classes: tuple[int, ...] = (),
    shard_over: Mesh | None = None,
) -> StepConfig:
    """Make the part of a run's configuration that its compiled step depends on.

    Args:
        config: the run's configuration.
        steps: number of steps of the run.
        steps_per_epoch: number of steps of an epoch.
        optimiser: any optax optimiser, in place of the configuration's optimiser and schedule.
        loss: any function of (descriptors, labels), (descriptors, labels, valid) or a `LossBatch`
            that returns a scalar, in place of the configuration's loss and miner.
        classes: number of classes of each group of classes, for a loss that classifies.
        shard_over: devices to shard the state over; None replicates it.

    Returns:
        A static argument of `train_step`.

    Raises:
        InputError: the loss is not a function.

    Example:
        >>> from crisalad_jax import recipe
        >>> step_config(recipe("tiny"), steps=100).steps
        100
    """
    given = None if loss is None else LossConfig(kind=GivenLoss(loss), miner="none")
    mixture = config.mixture
    if given is not None:
        mixture = tuple(dataclasses.replace(each, loss=given) for each in mixture)
    return StepConfig(
        model=config.model,
        loss=given or config.loss,
        optimiser=optimiser or config.optimiser,
        steps=steps,
        steps_per_epoch=steps_per_epoch,
        micro_batch=config.micro_batch,
        shard_over=shard_over,
        classes=classes,
        batch_norm=config.batch_norm,
        tuples=config.mines,
        mixture=mixture,
    )


@takes(config=StepConfig)
def make_train_step(config: StepConfig) -> Callable[..., tuple[TrainState, Metrics]]:
    """Make a compiled training step.

    Args:
        config: from `step_config`, the same as for `init_train_state`.

    Returns:
        `step(state, frozen, images, labels, key, valid=None, targets=None) -> (state, metrics)`;
        see `train_step`. The input state is donated. The step raises InputError for labels of 2^31
        or more, a state of another configuration, or images that are not an array of pixels.

    Example:
        >>> import jax, numpy as np, optax
        >>> from crisalad_jax import init_crisalad, init_train_state, recipe, step_config
        >>> config = recipe("tiny")
        >>> static = step_config(config, steps=10, optimiser=optax.sgd(0.1))
        >>> step = make_train_step(static)
        >>> params = init_crisalad(jax.random.key(0), config.model)
        >>> state, frozen = init_train_state(params, "head,-adapters", static)
        >>> images, labels = np.zeros((4, 98, 98, 3), np.uint8), np.array([0, 0, 1, 1])
        >>> state, metrics = step(state, frozen, images, labels, jax.random.key(1))
        >>> int(state.step), metrics.loss.shape
        (1, ())
    """

    def step(
        state: TrainState,
        frozen: PyTree,
        images: UInt8[Array | np.ndarray, "image height width 3"],
        labels: Int[Array | np.ndarray, " image"],
        key: PRNGKeyArray,
        valid: Bool[Array | np.ndarray, " image"] | None = None,
        targets: Float[Array | np.ndarray, "image target"] | None = None,
    ) -> tuple[TrainState, Metrics]:
        images, labels = checked_batch(images, labels, config.model)
        mask = jnp.ones(len(labels), bool) if valid is None else jnp.asarray(valid)
        taught = None if targets is None else jnp.asarray(targets)
        return train_step(state, frozen, images, labels, mask, key, config, targets=taught)

    return step


def checked_batch(
    images: UInt8[Array | np.ndarray, "image height width 3"],
    labels: Int[Array | np.ndarray, " image"],
    config: ModelConfig,
) -> tuple[Array, Int[Array, " image"]]:
    """Check a batch and return it as JAX arrays; raises like the step of `make_train_step`."""
    check_pixels(images, config.preprocessing)
    # JAX would truncate 64-bit labels, and merge places that differ in the upper half only. JAX
    # arrays have no such labels, and may be traced or not computed yet.
    if not isinstance(labels, jax.Array) and np.max(labels, initial=0) >= 2**31:
        raise InputError(f"labels: found up to {np.max(labels)}, expected numbers below 2^31")
    return jnp.asarray(images), jnp.asarray(labels, jnp.int32)


@devices.over_images("images", 2)
@functools.partial(compiler.jit, runs_long=True, static_argnames="config", donate_argnames="state")
def train_step(
    state: TrainState,
    frozen: PyTree,
    images: UInt8[Array, "image height width 3"],
    labels: Int[Array, " image"],
    valid: Bool[Array, " image"],
    key: PRNGKeyArray,
    config: StepConfig,
    proceed: Bool[Array, ""] | bool = True,
    targets: Float[Array, "image target"] | None = None,
) -> tuple[TrainState, Metrics]:
    """Take an optimiser step on the loss of a batch, or accumulate its gradient for a later step.

    The trainable parameters and the loss's own parameters change. If the loss classifies, only the
    group of classes of the current epoch trains, and labels are classes of that group. Dropout is
    drawn from `key` and the step number, so that a resumed run repeats an uninterrupted one.

    Running batch-norm statistics in the state are updated as in torch's training mode, and a batch
    is normalised by its own statistics; if the state has none, by the stored ones in `frozen`.

    If the loss or the gradient is not finite, or no image is valid, the state is returned unchanged
    and `Metrics.updated` is False. Passed to the next step as `proceed`, False skips it too, so a
    loop can read metrics one step late and still have the state before the failed step.

    A loss that learns from a teacher takes the teacher's descriptors of the images as `targets`.
    """
    dropout_key = jax.random.fold_in(key, state.step)
    (result, transport, statistics, all_valid), (gradient, classifier_gradient) = loss_and_gradient(
        state, frozen, images, labels, valid, dropout_key, config, targets
    )
    norm = optax.tree.norm((gradient, classifier_gradient))
    learning_rate = config.learning_rate(state.step)
    optimiser = config.make_optimiser()
    _, learnt = split_statistics(state.trainable)
    updates, new_optimiser = optimiser.update(gradient, state.optimiser, learnt)
    classifiers = state.classifiers
    if classifiers is not None:
        rate, group = config.loss.kind.learning_rate, _group(state, config)
        classifiers = update_classifiers(classifiers, group, classifier_gradient, rate)
    trainable = eqx.combine(optax.apply_updates(learnt, updates), statistics)
    new = TrainState(state.step + 1, trainable, new_optimiser, classifiers)
    updated = proceed & jnp.isfinite(result.loss) & jnp.isfinite(norm) & all_valid.any()
    state = jax.tree.map(lambda after, before: jnp.where(updated, after, before), new, state)
    if (mesh := config.shard_over) is not None:
        shards = jax.tree.map(lambda leaf: devices.shard_spec(mesh, leaf.shape), state)
        state = jax.lax.with_sharding_constraint(state, shards)
    return state, Metrics(
        loss=result.loss,
        easy_anchor_fraction=result.easy_anchor_fraction,
        accuracy=result.accuracy,
        loss_numbers=result.numbers,
        gradient_norm=norm,
        learning_rate=learning_rate,
        images=all_valid.sum(),
        transport=transport,
        updated=updated,
    )


def _group(state: TrainState, config: StepConfig) -> Int[Array, ""]:
    """Return which group of classes trains in the current epoch."""
    return state.step // config.steps_per_epoch % max(len(config.classes), 1)


class BatchLoss(NamedTuple):
    """The results of a forward pass on a batch."""

    result: LossResult
    transport: TransportStatistics | None
    """Means over the valid images."""
    statistics: PyTree
    """Running statistics of batch norms after the batch."""
    valid: Bool[Array, " image"]
    """Whether each image of the batch is valid; the whole mask is on every device."""


def loss_and_gradient(
    state: TrainState,
    frozen: PyTree,
    images: UInt8[Array, "image height width 3"],
    labels: Int[Array, " image"],
    valid: Bool[Array, " image"],
    key: PRNGKeyArray | None,
    config: StepConfig,
    targets: Float[Array, "image target"] | None = None,
) -> tuple[BatchLoss, tuple[PyTree, PyTree]]:
    """Compute the loss of a batch and its gradient inside a trace; see `train_step`.

    Args:
        state: the training state; its optimiser is not read.
        frozen: parameters that do not train.
        images: pixels of the images.
        labels: place or class of each image, or labels of mined tuples (`tuple_labels`).
        valid: which images take part.
        key: random key for dropout; None disables it.
        config: the step's configuration.
        targets: a teacher's descriptors of the images, for a loss that compares them.

    Returns:
        The results of the forward pass, and the gradients of trainable and of loss parameters.
    """
    classifier, group = None, _group(state, config)
    if state.classifiers is not None:
        classifier = jax.tree.map(lambda leaf: leaf[group], state.classifiers.weights)

    statistics, learnt = split_statistics(state.trainable)
    # Small arrays that the loss, the mask and the metrics need for all images.
    all_labels, all_valid = _gathered(labels, valid)

    def loss_of(trained: tuple[PyTree, Any]) -> tuple[Float[Array, ""], tuple[Any, ...]]:
        learnt, classifier = trained
        params = eqx.combine(learnt, statistics, frozen)
        updates_statistics = bool(jax.tree.leaves(statistics))
        descriptors, tokens, measured = describe_training_batch(
            params,
            images,
            config.model,
            valid=all_valid,
            measured=valid if updates_statistics else None,
            key=key,
            micro_batch=config.micro_batch,
            sub_batches=config.sub_batches(len(all_labels)),
        )
        descriptors = devices.gather_images(descriptors)
        compared = config.loss.kind.reads_tokens
        local = devices.gather_images(getattr(tokens, compared)) if compared else None
        compute = functools.partial(_loss, config=config)
        if len(all_labels) <= WHOLE_LOSS:
            compute = devices.whole_on_each(compute)
        taught = None if targets is None else devices.gather_images(targets)
        result = compute(descriptors, local, all_labels, all_valid, classifier, group, taught)
        updated = measured if updates_statistics else statistics
        return result.loss, (result, tokens.transport, updated)

    weights = learnt, classifier
    if config.shard_over is not None:
        whole = NamedSharding(config.shard_over, PartitionSpec())
        weights = jax.lax.with_sharding_constraint(weights, whole)
    gradients, (result, transport, statistics) = jax.grad(loss_of, has_aux=True)(weights)
    transport = jax.tree.map(
        lambda each: jnp.where(valid, each, 0).sum() / all_valid.sum(), transport
    )
    return BatchLoss(result, transport, statistics, all_valid), gradients


def _gathered(
    labels: Int[Array, " image"], valid: Bool[Array, " image"]
) -> tuple[Int[Array, " image"], Bool[Array, " image"]]:
    """Gather the labels and the valid masks of all devices, exchanged as one array."""
    mesh = devices.image_mesh()
    if mesh is None:
        return labels, valid
    own = [each.reshape(mesh.size, -1) for each in (labels, valid.astype(labels.dtype))]
    labels, valid = jnp.split(devices.gather_images(jnp.concatenate(own, axis=1)), 2, axis=1)
    return devices.gather_images((labels.ravel(), valid.ravel() != 0))


def _loss(
    descriptors: Float[Array, "image descriptor"],
    tokens: Float[Array, "image token dim"] | None,
    labels: Int[Array, " image"],
    valid: Bool[Array, " image"],
    classifier: PyTree,
    group: Int[Array, ""],
    targets: Float[Array, "image target"] | None,
    config: StepConfig,
) -> LossResult:
    """Compute the loss of a batch of places or mined tuples, or of its sub-batches."""
    if config.mixture:
        return _mixed_loss(descriptors, labels, valid, config)
    return metric_loss(
        descriptors,
        labels,
        config.loss,
        valid=valid,
        params=classifier,
        classes=jnp.asarray(config.classes)[group] if config.classes else None,
        pairs=tuple_pairs(labels, valid=valid) if config.tuples else None,
        tokens=tokens,
        targets=targets,
    )


def _mixed_loss(
    descriptors: Float[Array, "image descriptor"],
    labels: Int[Array, " image"],
    valid: Bool[Array, " image"],
    config: StepConfig,
) -> LossResult:
    """Add the weighted losses of the sub-batches, each computed on its own images only."""
    ends = np.cumsum(config.sub_batches(len(labels)))[:-1]
    parts = zip(*(jnp.split(each, ends) for each in (descriptors, labels, valid)), strict=True)
    numbers: dict[str, Array] = {}
    losses, easy = [], []
    for each, (rows, of_rows, are_valid) in zip(config.mixture, parts, strict=True):
        found = metric_loss(rows, of_rows, each.loss, valid=are_valid)
        numbers[each.name] = found.loss
        numbers |= {f"{each.name}.{name}": one for name, one in (found.numbers or {}).items()}
        losses.append(each.weight * found.loss)
        easy.append(found.easy_anchor_fraction * are_valid.sum())
    easy_anchors = sum(easy) / jnp.maximum(valid.sum(), 1)
    return LossResult(jnp.stack(losses).sum(), easy_anchors, numbers=numbers)
