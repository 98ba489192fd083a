"""Training: what is frozen, the optimiser, and one compiled step (paper section 4.2)."""

import dataclasses
import functools
import re
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree, UInt8

from crisalad_jax import platform
from crisalad_jax.classification import Classifiers, init_classifiers, updated
from crisalad_jax.config import LossConfig, ModelConfig, OptimiserConfig
from crisalad_jax.errors import InputError
from crisalad_jax.losses import LossResult, large_margin_cosine_loss, metric_loss
from crisalad_jax.model import Crisalad, among, parameter_shapes, relate, tokenise
from crisalad_jax.nn.layers import split_key
from crisalad_jax.nn.tokens import TransportStatistics
from crisalad_jax.nn.vit import Block
from crisalad_jax.pytree import named_leaves

HEAD, ADAPTERS_AND_HEAD, ALL = "head", "adapters+head", "all"
STATISTICS = (".running_mean", ".running_var")
"""Batch-norm statistics, which never train: they are measured, not learnt."""
WORDS = ("aggregator.words", "aggregator.backbone")
"""AnyLoc's vocabulary, which never trains."""
_LAST_BLOCKS = re.compile(r"last-(\d+)-blocks\+head")
_ONLY_MULTIPLIED = re.compile(r"backbone\.blocks\..*(attn|mlp)\.\w+\.weight")
"""Weights of linear layers, which `layers.linear` casts to the type of what they multiply."""


class TrainState(NamedTuple):
    """What changes from step to step. `None` stands in `trainable` where a parameter is frozen."""

    step: Int[Array, ""]
    trainable: PyTree
    optimiser: PyTree
    classifiers: Classifiers | None = None
    """Where the loss classifies."""


class Metrics(NamedTuple):
    """Scalars of one step."""

    loss: Float[Array, ""]
    b_acc: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    """Of all that trains, a classifier among it."""
    learning_rate: Float[Array, ""]
    """Of this step."""
    images: Int[Array, ""]
    """How many were valid."""
    transport: TransportStatistics | None
    """Means of the valid images', with dropout; None where the aggregator has no transport."""


def spreads_images(trains: str) -> bool:
    """Whether a batch is spread over devices: not where all parameters train, on a CPU.

    Each device has what trains, its gradient and its moments to itself: of all parameters these are
    most of the memory, which a CPU's devices share, and `tiny` saves no time by it
    (docs/performance.md).
    """
    return trains != ALL or jax.default_backend() != "cpu"


def split_params(params: Crisalad, trains: str) -> tuple[PyTree, PyTree]:
    """Split into (trainable, frozen): the model's structure, None for the other's leaves.

    `trains` is "adapters+head" (the paper: adapters, aggregator, cross-image encoder), "head" (the
    last two alone), "all", or "last-N-blocks+head" (SALAD: the last N blocks, the final layer norm,
    and the head). Where some of the blocks train, their stack is cut in two, and `merge_params`
    makes it one again: no gradient passes the frozen blocks before the last N, nor all of a first
    block whose adapter alone trains.
    Batch-norm statistics stay frozen in every case, and so does AnyLoc's vocabulary.

    Raises:
        InputError: an unknown name, or more blocks than there are.
    """
    head = ("aggregator.", "encoder.")
    match = _LAST_BLOCKS.fullmatch(trains)
    if trains == ALL:
        prefixes: tuple[str, ...] = ("",)
    elif trains == HEAD:
        prefixes = head
    elif trains == ADAPTERS_AND_HEAD:
        params = _cut_blocks(params, 1)
        prefixes = (*head, "backbone.blocks.0.adapter.", "backbone.blocks.1.adapter.")
    elif match:
        last, depth = int(match[1]), len(_stack(params).ls1)
        if last > depth:
            raise InputError(f"trains: found the last {last} blocks, expected at most {depth}")
        params = _cut_blocks(params, depth - last)
        prefixes = (*head, "backbone.norm.", "backbone.blocks.1.")
    else:
        raise InputError(
            f"trains: found {trains!r}, expected head, adapters+head, last-N-blocks+head or all"
        )
    names = iter(named_leaves(params))

    def learns(name: str) -> bool:
        constant = name.endswith(STATISTICS) or name in WORDS
        return name.startswith(prefixes) and not constant

    chosen = jax.tree.map(lambda _: learns(next(names)), params)
    return eqx.partition(params, chosen)


def trained_parameters(config: ModelConfig, trains: str) -> int:
    """How many numbers train; raises as `split_params`."""
    trainable = jax.eval_shape(
        lambda params: split_params(params, trains)[0], parameter_shapes(config)
    )
    return sum(leaf.size for leaf in jax.tree.leaves(trainable))


def _stack(params: Crisalad) -> Block:
    stack = params.backbone.blocks
    assert isinstance(stack, Block)  # a model in training's hands alone is cut
    return stack


def _cut_blocks(params: Crisalad, first: int) -> Crisalad:
    stack = _stack(params)
    parts = (jax.tree.map(lambda x: x[:first], stack), jax.tree.map(lambda x: x[first:], stack))
    backbone = dataclasses.replace(params.backbone, blocks=parts)
    return dataclasses.replace(params, backbone=backbone)


def merge_params(trainable: PyTree, frozen: PyTree) -> Crisalad:
    """Undo `split_params`: a model with one stack of blocks."""
    params = eqx.combine(trainable, frozen)
    if isinstance(params.backbone.blocks, Block):
        return params
    stack = jax.tree.map(lambda *parts: jnp.concatenate(parts), *params.backbone.blocks)
    backbone = dataclasses.replace(params.backbone, blocks=stack)
    return dataclasses.replace(params, backbone=backbone)


def learning_rate_schedule(
    config: OptimiserConfig, steps: int, steps_per_epoch: int = 1
) -> optax.Schedule:
    """Linear warm-up, then the decay that `config.schedule` names.

    A linear one reaches `final_fraction` after `config.decay_steps`, or after the last of `steps`;
    the other multiplies by `drop_factor` every `drop_epochs`, counted from the end of the warm-up.
    """
    peak, end = config.learning_rate, config.learning_rate * config.final_fraction
    if config.schedule == "linear":
        length = config.decay_steps or max(steps - config.warmup_steps, 1)
        decay = optax.linear_schedule(peak, end, length)
    else:
        decay = optax.exponential_decay(
            peak, config.drop_epochs * steps_per_epoch, config.drop_factor, staircase=True
        )
    if not config.warmup_steps:
        return _of_real_steps(decay)
    # The first step of a warm-up of n is 1 / n of the peak, not a step of length 0.
    warmup = optax.linear_schedule(
        peak / config.warmup_steps, peak, max(config.warmup_steps - 1, 1)
    )
    return _of_real_steps(optax.join_schedules([warmup, decay], [config.warmup_steps]))


def _of_real_steps(schedule: optax.Schedule) -> optax.Schedule:
    # A quotient of optax's int32 count is float32, in JAX's 64-bit mode too.
    return lambda count: schedule(jnp.asarray(count, float))


def make_optimiser(
    config: OptimiserConfig, steps: int, steps_per_epoch: int = 1
) -> optax.GradientTransformation:
    """Torch's AdamW (Loshchilov and Hutter 2019) or Adam (Kingma and Ba 2015), clipped if asked.

    Both decay every parameter: AdamW the parameter itself, Adam by way of its gradient.
    """
    schedule = learning_rate_schedule(config, steps, steps_per_epoch)
    b1, b2 = config.b1, config.b2
    if config.kind == "adamw":
        optimiser = optax.adamw(schedule, b1, b2, weight_decay=config.weight_decay)
    else:
        decay = optax.add_decayed_weights(config.weight_decay)
        optimiser = optax.chain(decay, optax.adam(schedule, b1, b2))
    if config.clip_norm is None:
        return optimiser
    return optax.chain(optax.clip_by_global_norm(config.clip_norm), optimiser)


@dataclasses.dataclass(frozen=True)
class StepConfig:
    """What a compiled step depends on."""

    model: ModelConfig
    loss: LossConfig
    optimiser: OptimiserConfig
    steps: int
    steps_per_epoch: int = 1
    """What a learning rate that falls every few epochs counts by."""
    micro_batch: int | None = None
    """See `model.tokenise`."""
    split_over: Mesh | None = None
    """Devices that keep the state in parts, as `platform.split_on` says; None: each has it whole.

    The gradient is taken of whole parameters, the optimiser's step of parts (the first stage of
    ZeRO, Rajbhandari et al. 2020)."""

    classes: tuple[int, ...] = ()
    """Of each group, where the loss classifies; an epoch trains one group after the other."""

    @property
    def schedule(self) -> optax.Schedule:
        """The learning rate of a step, from 0."""
        return learning_rate_schedule(self.optimiser, self.steps, self.steps_per_epoch)

    def make_optimiser(self) -> optax.GradientTransformation:
        """The optimiser of a run of so many steps."""
        return make_optimiser(self.optimiser, self.steps, self.steps_per_epoch)

    @property
    def compute_dtype(self) -> str:
        """The model's."""
        return self.model.compute_dtype


def init_state(
    params: Crisalad, trains: str, config: StepConfig, *, key: PRNGKeyArray | None = None
) -> tuple[TrainState, PyTree]:
    """The state before step 0, and the frozen parameters, which no step touches.

    `key` draws the classifiers, where the loss classifies.
    """
    trainable, frozen = split_params(params, trains)
    optimiser = config.make_optimiser().init(trainable)
    classifiers = None
    if config.classes:
        assert key is not None
        rate = config.loss.large_margin_cosine.learning_rate
        classifiers = init_classifiers(key, config.classes, config.model.descriptor_dim, rate)
    return TrainState(jnp.zeros((), jnp.int32), trainable, optimiser, classifiers), frozen


def narrow(frozen: PyTree, config: ModelConfig) -> PyTree:
    """Frozen weights of the backbone's linear layers in the type that they are multiplied in.

    What a step computes stays the same to the bit; in bfloat16 they take half the memory.
    """

    dtype = jnp.dtype(config.compute_dtype)
    names = iter(named_leaves(frozen))

    def narrowed(leaf: Any) -> Any:
        return leaf.astype(dtype) if _ONLY_MULTIPLIED.fullmatch(next(names)) else leaf

    return jax.tree.map(narrowed, frozen)


@functools.partial(platform.jit, runs_long=True, static_argnames="config", donate_argnames="state")
def train_step(
    state: TrainState,
    frozen: PyTree,
    images: UInt8[Array, "image height width 3"],
    labels: Int[Array, " image"],
    valid: Bool[Array, " image"],
    key: PRNGKeyArray,
    config: StepConfig,
) -> tuple[TrainState, Metrics]:
    """One step of the optimiser on the loss of a batch.

    The gradient is taken of the trainable parameters, and of the classifier of the epoch's group
    where the loss classifies; labels are then that group's classes. Dropout is drawn from `key` and
    the step's number, so that a resumed run repeats an uninterrupted one. Where loss or gradient is
    not finite, or no image valid, the state is returned as it was, and the metrics tell.
    """
    tokens_key, encoder_key = split_key(jax.random.fold_in(key, state.step), 2)

    group = state.step // config.steps_per_epoch % max(len(config.classes), 1)
    classifier = None if state.classifiers is None else state.classifiers.weights[group]

    def loss_of(trained: tuple[PyTree, Any]) -> tuple[Float[Array, ""], tuple[Any, ...]]:
        trainable, classifier = trained
        params = eqx.combine(trainable, frozen)
        # The halves of `describe`, for what the tokens tell.
        tokens = tokenise(
            params, images, config.model, key=tokens_key, micro_batch=config.micro_batch
        )
        descriptors = relate(params, tokens, config.model, mask=among(valid), key=encoder_key)
        if classifier is None:
            loss, b_acc = metric_loss(descriptors, labels, config.loss, valid=valid)
        else:
            loss, b_acc = _classified(descriptors, labels, classifier, group, valid, config)
        return loss, (b_acc, tokens.transport)

    def placed(tree: PyTree, *, whole: bool = False) -> PyTree:
        mesh = config.split_over
        if mesh is None:
            return tree

        def place(leaf: Array) -> Array:
            where = (
                NamedSharding(mesh, PartitionSpec())
                if whole
                else platform.split_on(mesh, leaf.shape)
            )
            return jax.lax.with_sharding_constraint(leaf, where)

        return jax.tree.map(place, tree)

    (loss, (b_acc, transport)), (gradient, classifier_gradient) = jax.value_and_grad(
        loss_of, has_aux=True
    )((placed(state.trainable, whole=True), placed(classifier, whole=True)))
    transport = jax.tree.map(lambda each: jnp.where(valid, each, 0).sum() / valid.sum(), transport)
    norm = optax.tree.norm((gradient, classifier_gradient))
    optimiser = config.make_optimiser()
    updates, new_optimiser = optimiser.update(gradient, state.optimiser, state.trainable)
    classifiers = state.classifiers
    if classifiers is not None:
        rate = config.loss.large_margin_cosine.learning_rate
        classifiers = updated(classifiers, group, classifier_gradient, rate)
    trainable = optax.apply_updates(state.trainable, updates)
    new = TrainState(state.step + 1, trainable, new_optimiser, classifiers)
    usable = jnp.isfinite(loss) & jnp.isfinite(norm) & valid.any()
    kept = jax.tree.map(lambda after, before: jnp.where(usable, after, before), new, state)
    rate = jnp.asarray(config.schedule(state.step))
    return placed(kept), Metrics(loss, b_acc, norm, rate, valid.sum(), transport)


def _classified(
    descriptors: Float[Array, "image descriptor"],
    labels: Int[Array, " image"],
    classifier: Float[Array, "class descriptor"],
    group: Int[Array, ""],
    valid: Bool[Array, " image"],
    config: StepConfig,
) -> LossResult:
    loss = config.loss.large_margin_cosine
    return large_margin_cosine_loss(
        descriptors,
        labels,
        classifier,
        scale=loss.scale,
        margin=loss.margin,
        valid=valid,
        classes=jnp.asarray(config.classes)[group],
    )
