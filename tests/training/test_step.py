"""What trains, the optimiser against torch, and one compiled step."""

import dataclasses
import functools
import re
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax.nn.aggregators.queries import BoqConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import (
    Crisalad,
    cast_params,
    describe,
    extract_tokens,
    init_crisalad,
    parameter_shapes,
)
from crisalad_jax.training.config import OptimiserConfig, TrainConfig
from crisalad_jax.training.losses import Loss, LossConfig, LossValue, metric_loss
from crisalad_jax.training.losses.pairwise import MultiSimilarityConfig
from crisalad_jax.training.optimiser import learning_rate_schedule, make_optimiser
from crisalad_jax.training.optimisers import AdamW
from crisalad_jax.training.schedules import LinearSchedule, MilestonesSchedule, StepSchedule
from crisalad_jax.training.step import (
    Metrics,
    StepConfig,
    TrainState,
    init_train_state,
    make_train_step,
    named_scalars,
    step_config,
    train_step,
)
from crisalad_jax.training.trainable import merge_params, split_params
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.pytree import named_leaves
from crisalad_jax.utils.target import GPU, lowering_for
from tests.conftest import MODEL as CONFIG
from tests.conftest import assert_equal, random_params
from tests.nn.test_model import pictures

# No dropout, so that a step can be compared with one taken by hand.
MODEL = dataclasses.replace(
    CONFIG,
    aggregator=dataclasses.replace(CONFIG.aggregator, dropout=0.0),
    cross_image=dataclasses.replace(CONFIG.cross_image, dropout=0.0),
)
STEP = StepConfig(
    MODEL,
    LossConfig(kind=MultiSimilarityConfig(base=0.5)),
    OptimiserConfig(learning_rate=1e-3),
    10,
)
LABELS = jnp.array([0, 0, 1, 1, 2, 2])
VALID = np.ones(6, bool)


@pytest.fixture(scope="module")
def params():
    return init_crisalad(jax.random.key(0), MODEL)


def take_step(
    state, frozen, *, images=None, labels=LABELS, valid=VALID, key=None, config=STEP
) -> tuple[TrainState, Metrics]:
    """A step on six pictures of three places, unless told otherwise."""
    images = pictures(6) if images is None else images
    key = jax.random.key(0) if key is None else key
    return train_step(state, frozen, images, labels, valid, key, config)


HEAD = ("aggregator.", "cross_image.")
LAST = (*HEAD, "backbone.blocks.1.")


@pytest.mark.parametrize(
    ("trainable", "prefixes"),
    [
        ("adapters,head", (*HEAD, "backbone.blocks.0.adapter.", "backbone.blocks.1.adapter.")),
        ("last-1-blocks,norm,head", (*LAST, "backbone.norm.")),
        ("norm,head,-adapters", (*HEAD, "backbone.norm.")),
        (
            "last-1-blocks,norm,positions,head",
            (*LAST, "backbone.norm.", "backbone.cls_token", "backbone.pos_embed"),
        ),
        ("last-1-blocks,head", LAST),
        ("all", ("",)),
    ],
)
def test_what_trains_is_chosen_by_name(params, trainable: str, prefixes: tuple[str, ...]) -> None:
    chosen, frozen = split_params(params, MODEL, trainable)
    trained, fixed = named_leaves(chosen), named_leaves(frozen)
    assert not trained.keys() & fixed.keys()
    assert all(name.startswith(prefixes) for name in trained)
    assert not any(name.startswith(prefixes) for name in fixed)
    assert trained
    whole = named_leaves(merge_params(chosen, frozen, MODEL))
    for name, leaf in named_leaves(params).items():
        np.testing.assert_array_equal(whole[name], leaf)


def test_blocks_are_counted_from_the_end(params) -> None:
    last, _ = split_params(params, MODEL, "last-1-blocks,norm,head")
    weight = named_leaves(last)["backbone.blocks.1.attn.qkv.weight"]
    np.testing.assert_array_equal(weight, params.backbone.blocks.attn.qkv.weight[1:])


def test_a_norm_that_the_aggregator_leaves_out_stays_frozen() -> None:
    """It has no gradient: weight decay alone would move it."""
    boq = BoqConfig(channels=16, queries=3, rows=2)
    cross_image = "none"
    model = dataclasses.replace(MODEL, aggregator=boq, cross_image=cross_image)
    shapes = parameter_shapes(model)
    for last_norm in (False, True):
        chosen = dataclasses.replace(boq, last_norm=last_norm)
        model = dataclasses.replace(model, aggregator=chosen)
        split = functools.partial(split_params, config=model, trainable="last-1-blocks,norm,head")
        names = named_leaves(jax.eval_shape(split, shapes)[0])
        assert ("backbone.norm.weight" in names) == last_norm


@pytest.mark.parametrize(
    "trainable",
    [
        pytest.param("adapters,head", marks=pytest.mark.slow),
        "head,-adapters,backbone.blocks.1.attn,backbone.patch_embed",
    ],
)
def test_a_step_changes_what_trains_and_nothing_else(params, trainable: str) -> None:
    state, frozen = init_train_state(params, trainable, STEP)
    trainable_names = named_leaves(state.trainable).keys()
    # The optimiser's two moments stand beside trainable leaves only.
    moments = [n for n in named_leaves(state.optimiser) if ".mu." in n or ".nu." in n]
    assert len(moments) == 2 * len(trainable_names)
    before = named_leaves(jax.tree.map(np.array, state.trainable))
    frozen_before = named_leaves(jax.tree.map(np.array, frozen))
    state, metrics = take_step(state, frozen)
    assert state.step == 1
    assert metrics.gradient_norm > 0
    # The dustbin's score has no effect (sinkhorn.py), but weight decay moves it.
    after = named_leaves(state.trainable)
    still = {name for name in after if jnp.array_equal(after[name], before[name])}
    # Biases that start at 0 and have no gradient, and empty registers, may stay.
    assert not {name for name in still if name.endswith("weight") and after[name].size}
    for name, leaf in named_leaves(frozen).items():
        np.testing.assert_array_equal(leaf, frozen_before[name])


def test_frozen_parameters_get_no_gradient_buffers(params) -> None:
    """The compiled step of adapters,head makes no array of a frozen block weight's stacked shape
    but the weights themselves: no gradient, no moment."""

    def made(jaxpr) -> list[tuple[int, ...]]:
        shapes = [v.aval.shape for equation in jaxpr.eqns for v in equation.outvars]
        for equation in jaxpr.eqns:
            for value in equation.params.values():
                inner = getattr(value, "jaxpr", value)
                shapes += made(inner) if hasattr(inner, "eqns") else []
        return shapes

    state, frozen = init_train_state(params, "adapters,head", STEP)
    # Of a part of the stack, which is cut in two.
    shape = (1, *params.backbone.blocks.mlp.fc1.weight.shape[1:])
    assert shape not in made(jax.make_jaxpr(take_step)(state, frozen).jaxpr)
    everything = init_train_state(params, "last-1-blocks,norm,head", STEP)
    assert shape in made(jax.make_jaxpr(take_step)(*everything).jaxpr)  # the search can find one


@pytest.mark.slow
def test_the_step_is_adamw_on_the_losss_gradient(params) -> None:
    """Loss and update recomputed outside the step, the update by torch.optim.AdamW."""
    images = pictures(6)
    state, frozen = init_train_state(params, "all", STEP)
    stepped, metrics = take_step(state, frozen)

    def loss(p):
        return metric_loss(describe(p, images, MODEL), LABELS, STEP.loss).loss

    value, gradient = jax.value_and_grad(loss)(params)
    np.testing.assert_allclose(metrics.loss, value, rtol=1e-5)
    tensors = {n: torch.tensor(np.asarray(v)) for n, v in named_leaves(params).items()}
    for name, g in named_leaves(gradient).items():
        tensors[name].grad = torch.tensor(np.asarray(g))
    torch.optim.AdamW(tensors.values(), lr=1e-3, weight_decay=0.01).step()
    after = named_leaves(stepped.trainable)
    for name in after:
        # Adam's first step is lr times the gradient's sign: where the gradient is rounding noise
        # around 0, so is its sign. Elsewhere the two agree to the last places.
        g = np.abs(np.asarray(named_leaves(gradient)[name]))
        sure = g > 1e-6
        np.testing.assert_allclose(
            np.asarray(after[name])[sure], tensors[name].numpy()[sure], atol=2e-6, err_msg=name
        )


OPTIMISERS = {
    # Linear decay of an epoch a step, clipped.
    "adamw": (
        OptimiserConfig(
            kind=AdamW(b2=0.9),
            learning_rate=0.1,
            schedule=LinearSchedule(0.2),
            weight_decay=0.05,
            clip_norm=1.0,
        ),
        lambda each: torch.optim.AdamW([each], lr=0.1, betas=(0.9, 0.9), weight_decay=0.05),
        lambda each: torch.optim.lr_scheduler.LinearLR(each, 1.0, 0.2, total_iters=9),
    ),
    # CricaVPR's, down to a half every three epochs, with decay.
    "adam": (
        OptimiserConfig(
            kind="adam", learning_rate=0.1, schedule=StepSchedule(epochs=3), weight_decay=0.1
        ),
        lambda each: torch.optim.Adam([each], lr=0.1, weight_decay=0.1),
        lambda each: torch.optim.lr_scheduler.StepLR(each, step_size=3, gamma=0.5),
    ),
}
"""Ours, torch's optimiser, and its schedule."""


@pytest.mark.parametrize("name", OPTIMISERS)
def test_steps_of_an_optimiser_equal_torchs(name: str) -> None:
    """Nine steps on given gradients, of two an epoch but under linear decay."""
    config, make, schedule = OPTIMISERS[name]
    start, *gradients = np.random.default_rng(0).standard_normal((10, 7))
    per_epoch = 1 if config.schedule == LinearSchedule(0.2) else 2
    tensor = torch.tensor(start, requires_grad=True)
    theirs = make(tensor)
    down = schedule(theirs)
    for step, gradient in enumerate(gradients):
        tensor.grad = torch.tensor(gradient)
        if config.clip_norm is not None:
            torch.nn.utils.clip_grad_norm_([tensor], config.clip_norm)
        theirs.step()
        if step % per_epoch == per_epoch - 1:
            down.step()
    ours = optimised(config, start, gradients, steps_per_epoch=per_epoch)
    # Torch clips to a norm less by 1e-6 of itself, of which Adam's eps lets a hundredth by. Sums of
    # nine steps of order 1 are each rounded to 1e-16.
    bound = 1e-13 if config.clip_norm is None else 1e-7
    np.testing.assert_allclose(ours, tensor.detach().numpy(), rtol=0, atol=bound)


@pytest.mark.parametrize("kind", [pytest.param("sgd", marks=pytest.mark.slow), "adamw"])
def test_gradients_of_several_batches_equal_torchs(kind: Literal["sgd", "adamw"]) -> None:
    """DINO-Mix's: four batches' mean, each number clipped; epochs of seven batches, so that the
    second step of each has three, whose sum is still divided by four, as in Lightning."""
    config = OptimiserConfig(
        kind=kind,
        learning_rate=0.1,
        schedule=MilestonesSchedule((2,), gamma=0.3),
        warmup_steps=3,
        weight_decay=1e-3,
        clip_value=0.5,
        accumulate=4,
    )
    start, *gradients = np.random.default_rng(0).standard_normal((1 + 3 * 7, 9))
    tensor = torch.tensor(start, requires_grad=True)
    theirs = (
        torch.optim.SGD([tensor], lr=0.1, momentum=0.9, weight_decay=1e-3)
        if kind == "sgd"
        else torch.optim.AdamW([tensor], lr=0.1, weight_decay=1e-3)
    )
    warm = torch.optim.lr_scheduler.LambdaLR(theirs, lambda n: min(1, (n + 1) / 3) * 0.3 ** (n > 3))
    clipped = []
    tensor.grad = torch.zeros_like(tensor)
    for batch, gradient in enumerate(gradients):
        tensor.grad += torch.tensor(gradient) / 4
        if batch % 7 in (3, 6):
            clipped.append(int((tensor.grad.abs() > 0.5).sum()))
            torch.nn.utils.clip_grad_value_([tensor], 0.5)
            theirs.step()
            warm.step()
            tensor.grad.zero_()
    assert min(clipped) > 0  # in every step, and never all
    assert max(clipped) < 9
    ours = optimised(config, start, gradients, steps_per_epoch=7)
    # Sums of six steps of order 1, each rounded to 1e-16.
    np.testing.assert_allclose(ours, tensor.detach().numpy(), rtol=0, atol=1e-13)


def optimised(
    config: OptimiserConfig,
    start: np.ndarray,
    gradients: list[np.ndarray],
    *,
    steps_per_epoch: int = 1,
) -> np.ndarray:
    """The array after a step for each gradient, in float64.

    In float32 Adam's 1 - b2 = 0.001 is right to 6e-5 only, which would hide a small mistake.
    """
    with jax.enable_x64(True):
        optimiser = make_optimiser(config, steps=len(gradients), steps_per_epoch=steps_per_epoch)
        array = jnp.asarray(start)
        state = optimiser.init(array)
        for gradient in gradients:
            updates, state = optimiser.update(jnp.asarray(gradient), state, array)
            array = array + updates
        return np.asarray(array)


def test_schedule_by_hand() -> None:
    schedule = learning_rate_schedule(
        OptimiserConfig(learning_rate=1.0, schedule=LinearSchedule(0.1), warmup_steps=4), 14
    )
    found = [float(schedule(step)) for step in (0, 1, 3, 4, 9, 14)]
    np.testing.assert_allclose(found, [0.25, 0.5, 1.0, 1.0, 0.55, 0.1], atol=1e-6)


def test_invalid_images_change_no_gradient(params) -> None:
    images, valid = pictures(6), np.array([True] * 4 + [False] * 2)
    results = []
    for seed in (1, 2):
        images[4:] = pictures(2, seed)
        _, metrics = take_step(*init_train_state(params, "all", STEP), images=images, valid=valid)
        results.append((float(metrics.loss), float(metrics.gradient_norm)))
    np.testing.assert_allclose(*results, rtol=1e-5)
    _, all_valid = take_step(*init_train_state(params, "all", STEP), images=images)
    assert abs(float(all_valid.loss) - results[0][0]) > 1e-3


def of_aggregator(params: Crisalad, **fields) -> Crisalad:
    return dataclasses.replace(params, aggregator=dataclasses.replace(params.aggregator, **fields))


def steep(params: Crisalad) -> Crisalad:
    """Below a hidden unit of 1e25 weights of 1e-25 give tokens of order 1, with slopes of 1e25."""
    network = params.aggregator.token_features
    bias, weight = network.fc1.bias.at[0].set(1e25), network.fc2.weight.at[0].multiply(1e-25)
    fc1 = dataclasses.replace(network.fc1, bias=bias)
    fc2 = dataclasses.replace(network.fc2, weight=weight)
    return of_aggregator(params, token_features=dataclasses.replace(network, fc1=fc1, fc2=fc2))


# Over a tiny alpha the positives' logarithms overflow; alpha leaves their slopes.
OVERFLOWS = LossConfig(kind=MultiSimilarityConfig(alpha=1.2e-38))


@pytest.mark.parametrize(
    ("change", "loss", "finite"),
    [
        (lambda params: of_aggregator(params, dust_bin=jnp.float32(jnp.nan)), None, (False, False)),
        (steep, None, (True, False)),
        (lambda params: params, OVERFLOWS, (False, True)),
    ],
    ids=["neither", "loss", "gradient"],
)
def test_a_step_whose_loss_or_gradient_is_not_finite_keeps_the_state(
    params, change, loss, finite
) -> None:
    config = STEP if loss is None else dataclasses.replace(STEP, loss=loss)
    labels = LABELS if loss is None else jnp.array([0, 0, 0, 1, 1, 1])
    state, frozen = init_train_state(change(params), "adapters,head", config)
    before = named_leaves(jax.tree.map(np.array, state.trainable))
    state, metrics = take_step(state, frozen, labels=labels, config=config)
    assert (jnp.isfinite(metrics.loss), jnp.isfinite(metrics.gradient_norm)) == finite
    assert state.step == 0
    for name, leaf in named_leaves(state.trainable).items():
        np.testing.assert_array_equal(leaf, before[name])


@pytest.mark.slow  # whole runs are compared bit for bit
def test_same_key_same_bits_and_dropout_changes_with_the_step() -> None:
    config = dataclasses.replace(STEP, model=CONFIG)
    start = init_crisalad(jax.random.key(0), CONFIG)

    def loss_of(*, key: int = 0, step: int = 0) -> float:
        state, frozen = init_train_state(start, "adapters,head", config)
        state = state._replace(step=jnp.int32(step))
        return float(take_step(state, frozen, key=jax.random.key(key), config=config)[1].loss)

    assert loss_of() == loss_of()
    # The same parameters and batch: only the key, or the step's number, tells the draws apart.
    assert len({loss_of(), loss_of(key=1), loss_of(step=1)}) == 3


def gradient_of(config: ModelConfig, micro_batch: int | None, key: jax.Array | None):
    start = random_params(config)

    def loss(params: Crisalad) -> jax.Array:
        found = describe(params, images, config, key=key, micro_batch=micro_batch)
        return metric_loss(found, LABELS, STEP.loss).loss

    images = pictures(6)
    return jax.jit(jax.value_and_grad(loss))(start)


WIDE = dataclasses.replace(CONFIG, compute_dtype="float64")


@pytest.fixture(scope="module")
def whole_batch():
    """Loss and gradient of all images at once, with dropout."""
    with jax.enable_x64(True):
        return gradient_of(WIDE, None, jax.random.key(3))


@pytest.mark.parametrize(
    ("micro_batch", "remat"),
    [
        (2, "full"),
        pytest.param(None, "none", marks=pytest.mark.slow),
        pytest.param(3, "dots", marks=pytest.mark.slow),
    ],
)
def test_micro_batches_and_remat_change_no_gradient(
    whole_batch, micro_batch: int | None, remat: str
) -> None:
    """Dropout included; encoder, miner and loss see the whole batch."""
    with jax.enable_x64(True):
        config = dataclasses.replace(WIDE, remat=remat)
        value, found = gradient_of(config, micro_batch, jax.random.key(3))
    whole, expected = whole_batch
    np.testing.assert_allclose(value, whole, rtol=1e-12)
    found, expected = named_leaves(found), named_leaves(expected)
    total = np.sqrt(sum(np.sum(np.square(leaf)) for leaf in expected.values()))
    assert total > 0.1
    for name, leaf in expected.items():
        # Parameters are float32, and so are their gradients, each part's rounded once; a thousandth
        # of the whole is what those have whose terms cancel.
        bound = 3e-7 * max(np.linalg.norm(leaf), 1e-3 * total)
        assert np.linalg.norm(found[name] - leaf) < bound, name


@pytest.mark.parametrize("micro_batch", [None, pytest.param(2, marks=pytest.mark.slow)])
def test_a_step_tells_of_the_transport_of_valid_images(params, micro_batch) -> None:
    config = dataclasses.replace(STEP, micro_batch=micro_batch)
    state, frozen = init_train_state(params, "adapters,head", config)
    valid = np.array([1, 1, 1, 0, 1, 0], bool)
    _, metrics = take_step(state, frozen, valid=valid, config=config)
    expected = extract_tokens(params, pictures(6)[valid], MODEL).transport
    assert expected is not None
    for name, each in expected._asdict().items():
        # Means of four numbers, computed in batches of another size. Errors of the marginals are
        # rounding, of 2e-7; all others are of order 1.
        actual = getattr(metrics.transport, name)
        np.testing.assert_allclose(actual, each.mean(), rtol=1e-5, atol=1e-6)
    assert 0 < float(metrics.transport.dustbin_share) < 1


def test_a_micro_batch_divides_the_batch(params) -> None:
    with pytest.raises(InputError, match=r"^micro_batch: found 4, expected a divisor of"):
        describe(params, pictures(6), MODEL, micro_batch=4)


@pytest.mark.slow
def test_frozen_weights_in_half_the_memory_change_no_bit() -> None:
    """In bfloat16 they are multiplied in that type anyway."""
    model = dataclasses.replace(CONFIG, compute_dtype="bfloat16")
    config = dataclasses.replace(STEP, model=model)
    results = []
    for change in (lambda frozen, _: frozen, cast_params):
        state, frozen = init_train_state(random_params(model), "adapters,head", config)
        with lowering_for(GPU):  # as on a CPU from jax 0.11 on
            frozen = change(frozen, model)
        results.append(take_step(state, frozen, config=config))
    kinds = {name: leaf.dtype for name, leaf in named_leaves(frozen).items()}
    assert kinds["backbone.blocks.1.mlp.fc1.weight"] == jnp.bfloat16
    assert {kind for name, kind in kinds.items() if "norm" in name} == {jnp.dtype("float32")}
    assert_equal(*results)


@pytest.mark.parametrize(
    ("classes", "key", "words"),
    [
        ((), jax.random.key(0), "large-margin-cosine: found a key and classes (), expected"),
        ((3,), None, "large-margin-cosine: found no key and classes (3,), expected"),
    ],
)
def test_a_classification_needs_classes_and_a_key(params, classes, key, words) -> None:
    loss = LossConfig(kind="large-margin-cosine", miner="none")
    static = step_config(TrainConfig(model=MODEL, loss=loss), steps=5, classes=classes)
    with pytest.raises(InputError, match=re.escape(words)):
        init_train_state(params, "head,-adapters", static, key=key)


@pytest.mark.usefixtures("_unchecked")
def test_another_configuration_or_loss_is_named(params) -> None:
    config = TrainConfig(model=MODEL)
    with pytest.raises(InputError, match=r"^config: found TrainConfig, expected StepConfig$"):
        init_train_state(params, "head,-adapters", config)
    with pytest.raises(InputError, match=r"^GivenLoss.function: found 'triplet', expected"):
        step_config(config, steps=5, loss="triplet")


def test_labels_that_32_bits_cannot_tell_apart_are_refused(params) -> None:
    config = TrainConfig(model=MODEL)
    static = step_config(config, steps=1)
    state, frozen = init_train_state(params, "head,-adapters", static)
    labels = np.array([0, 2**32, 1, 2**32 + 1, 2, 2])
    with pytest.raises(InputError, match=r"^labels: found up to 4294967297, expected numbers bel"):
        make_train_step(static)(state, frozen, pictures(6), labels, jax.random.key(0))


@dataclasses.dataclass(frozen=True)
class Scaled(Loss):
    """Softplus of similarities times a learnt scale, which it reports."""

    part_name: ClassVar[str] = "scaled"

    def init(self, key, classes, dim):
        return {"scale": jnp.full((), 2.0)}

    def apply(self, params, batch):
        scale = params["scale"]
        pull = jax.nn.softplus(scale * (0.5 - batch.similarities))
        loss = jnp.where(batch.pairs.positives, pull, 0).sum() / batch.anchors
        return LossValue(loss, numbers={"scale": scale, "pairs": batch.pairs.positives.sum()})


def test_a_step_tells_a_losss_own_numbers(params) -> None:
    """The scale steps down as Adam does at first, by its learning rate of 0.01."""
    loss = LossConfig(kind=Scaled(), miner="none")
    static = dataclasses.replace(STEP, loss=loss)
    state, frozen = init_train_state(params, "head,-adapters", static, key=jax.random.key(0))
    found = []
    for _ in range(2):
        state, metrics = take_step(state, frozen, config=static)
        found.append(named_scalars(metrics))
    assert [each["loss.scale"] for each in found] == [2.0, pytest.approx(2.01, abs=1e-6)]
    assert found[0]["loss.pairs"] == 6  # of three places of two images
    assert "loss" in found[0]
    assert "marginal_error" in found[0]
