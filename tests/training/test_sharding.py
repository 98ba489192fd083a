"""What devices exchange in a training step, and that this changes no result."""

import pytest

from tests.training.programs import run_on_devices

PROGRAM = """
import collections, dataclasses, re, sys, warnings
import jax, numpy as np, optax
from crisalad_jax.nn.model import describe, extract_tokens, init_crisalad
from crisalad_jax.training import trainer, step as module
from crisalad_jax.training.step import StepConfig, init_train_state, train_step
from crisalad_jax.utils import devices as sharding
from tests.conftest import RECIPE
from tests.nn.test_model import pictures

# Adam would make full steps of the rounding of gradients that are 0, as of a key's bias.
SGD = optax.sgd(0.1)
COLLECTIVE = re.compile(
    r"= .* (all-reduce|all-gather|reduce-scatter|all-to-all|collective-permute)(?:-start)?\\("
)
COUNT, LABELS = 16, np.repeat(np.arange(8), 2).astype(np.int32)
sharding.SHARD_FROM = 64
devices = sharding.devices_for(COUNT)
assert devices.mesh.size == 8
images, valid = np.asarray(pictures(COUNT)), np.arange(COUNT) != 3
key = jax.random.key(1)

def step(model, shared=None, lowered=False, **options):
    config = StepConfig(model, RECIPE.loss, SGD, 10, **options)
    params = init_crisalad(jax.random.key(0), model)
    state, frozen = init_train_state(params, "adapters,head", config)
    batch = images, LABELS, valid
    if shared is not None:
        batch = [shared.shard_batch(x) for x in batch]
        place = shared.shard if config.shard_over else shared.replicate
        state, frozen = place(state), shared.replicate(frozen)
    arguments = state, frozen, *batch, key, config
    if lowered:
        return train_step.lower(*arguments).as_text()
    if "count" in sys.argv:
        text = train_step.lower(*arguments).compile().as_text()
        return dict(sorted(collections.Counter(COLLECTIVE.findall(text)).items()))
    state, metrics = train_step(*arguments)
    return jax.tree.map(np.asarray, (state.trainable, metrics))

def agree(found, expected):
    # Sums in another order, of numbers up to about 1.
    for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)

MODEL = RECIPE.model
assert MODEL.cross_image.dropout > 0 and MODEL.cross_image.layers == 2
"""
COUNTS = """
print(step(MODEL, devices, micro_batch=8))
# Whether the loss is computed whole on each device: of few images it is.
whole, loss = [], module.metric_loss

def metric_loss(*args, **options):
    whole.append(sharding.image_mesh() is None)
    return loss(*args, **options)

module.metric_loss = metric_loss
jax.clear_caches()
text = step(dataclasses.replace(MODEL, compute_dtype="bfloat16"), devices, lowered=True)
module.WHOLE_LOSS = COUNT - 1
jax.clear_caches()
step(MODEL, devices, lowered=True)
print(whole)
# A bfloat16 model's sums over devices are of float32 numbers.
scatters = text.split("stablehlo.reduce_scatter")[1:]
operands = [each.split(") -> ")[0].rpartition("tensor<")[2] for each in scatters]
print([each.rpartition("x")[2] for each in operands])
params = devices.replicate(init_crisalad(jax.random.key(0), MODEL))
for function in describe, extract_tokens:
    text = function.lower(params, devices.shard_batch(images), MODEL).compile().as_text()
    print(dict(collections.Counter(COLLECTIVE.findall(text))))
"""
VALUES = """
# Dropout too has the same bits: images are valid or not, one device or eight.
alone = step(MODEL)
assert alone[1].updated
agree(step(MODEL, devices), alone)
agree(step(MODEL, devices, shard_over=devices.mesh), alone)
# Two of eight devices would have no image of a micro-batch of four: each takes one.
agree(step(MODEL, devices, micro_batch=4), alone)
agree(step(MODEL, devices, micro_batch=8), step(MODEL, micro_batch=8))
params = init_crisalad(jax.random.key(0), MODEL)
agree(
    describe(devices.replicate(params), devices.shard_batch(images), MODEL),
    describe(params, images, MODEL),
)
# Six images for eight devices: six take them, and a note says so.
few = dataclasses.replace(RECIPE, trainable="adapters,head")
with warnings.catch_warnings(record=True) as notes:
    warnings.simplefilter("always")
    assert trainer._choose_devices(few).mesh.size == 6
    assert trainer._choose_devices(dataclasses.replace(few, places_per_batch=4)).mesh.size == 8
for note in notes:
    print(note.message)
"""


@pytest.mark.slow
def test_a_step_exchanges_what_it_must_and_no_more() -> None:
    """Gathers of labels, of each layer's keys and values, and of descriptors; then gradients.

    The gradient of a layer's keys and values is scattered, and those of all parameters are summed
    at once. Nothing is exchanged in a loop, such as the transport's over images. Describing gathers
    each layer's keys and values, and its first half nothing.
    """
    expected = "{'all-gather': 4, 'all-reduce': 1, 'reduce-scatter': 2}"
    assert run_on_devices(8, PROGRAM + COUNTS, "count") == [
        expected,
        "[True, False]",
        "['f32>', 'f32>']",
        "{'all-gather': 2}",
        "{}",
    ]


@pytest.mark.slow
def test_eight_devices_take_the_step_of_one() -> None:
    assert run_on_devices(8, PROGRAM + VALUES) == [
        "training: found 8 devices for 6 images a step, of which 6 share them, the most that "
        "divide them in each process"
    ]
