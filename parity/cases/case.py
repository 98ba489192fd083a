"""Compare outputs, all gradients and a step of AdamW in each case.

Both sides hold the same float32 numbers and compute in the same precision. bfloat16 is also
compared with the reference in float64: our error is at most `TRUTH_FACTOR` times torch's.
"""

import dataclasses
import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch

from crisalad_jax.checkpoints.formats import to_params, to_state
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad
from crisalad_jax.training.config import OptimiserConfig
from crisalad_jax.training.optimiser import make_optimiser
from parity.cases.parts import Part
from parity.cases.weights import random_state
from parity.compare import (
    AFTER,
    EXACT,
    OTHER_SIGNS,
    OWN_STEP,
    STEP,
    TOLERANCES,
    Arrays,
    Row,
    as_double,
    compare,
    compare_joined,
    compare_signs,
    compare_truth,
    relative_error,
)
from parity.reference.model import Crisalad as TorchCrisalad

LAYOUT = "reference"
STEPS = 20
ONE_STEP = OptimiserConfig(learning_rate=1e-2)
"""A step so long that the rounding of the parameter it is added to is small in comparison."""
SLOPE = 1e-4
"""Size of the gradients that flow into a case: small, so that AdamW's epsilon of 1e-8 matters.

Doubling the epsilon changes the MLP's step by 1.6 %; with 1 here, the change would be 1e-5, and
undetected.
"""

Draw = Callable[[np.random.Generator], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Case:
    """A layer, or a whole model's descriptor."""

    name: str
    model: ModelConfig
    part: Part
    inputs: Mapping[str, Draw] = dataclasses.field(default_factory=dict)
    """How each input is drawn. Real numbers get the precision's type, and have gradients."""
    forward: str = "layer"
    """Tolerance for the outputs: "layer" or "descriptor"."""
    bfloat16: bool = True
    """False for layers that are float32 or wider in every model."""
    smooth: bool = True
    """False if a rectifier or clamp may fall on either side in low precision."""
    exact: bool = False
    """The outputs are discrete choices without gradients, and must be identical."""


class Pass(NamedTuple):
    """Outputs, and the gradients of the sum of outputs times slopes."""

    outputs: Arrays
    parameters: Arrays
    """Gradients by the reference's names; only of parameters that the case uses."""
    inputs: Arrays


def check_case(case: Case, precision: str, seed: int) -> list[Row]:
    """Compute all rows of a case."""
    tolerances = TOLERANCES[precision]
    rng = random(case.name, seed)
    model = build(case.model, precision, rng)
    inputs = {name: draw(rng) for name, draw in case.inputs.items()}
    if precision == "bfloat16":
        # Already rounded, so that the float64 reference sees the same inputs.
        inputs = {name: _rounded(array) for name, array in inputs.items()}

    def slope(name: str, shape: tuple[int, ...]) -> np.ndarray:
        return random(f"{case.name}: {name}", seed).normal(scale=SLOPE, size=shape)

    theirs = _their_pass(case, model, inputs, slope)
    with jax.enable_x64(precision == "float64"):
        ours = _our_pass(case, model, inputs, slope)
        if case.exact:
            return [compare(case.name, "choices", precision, ours.outputs, theirs.outputs, EXACT)]
        forward = tolerances[case.forward]
        rows = [compare(case.name, "forward", precision, ours.outputs, theirs.outputs, forward)]
        our_gradients, their_gradients = _gradients(ours, theirs)
        noise = cancelling(their_gradients)
        if their_gradients:
            tolerance = tolerances["gradients" if case.smooth else "gradients, kinks"]
            pair = our_gradients, their_gradients
            rows.append(compare(case.name, "gradients", precision, *pair, tolerance, noise=noise))
        if theirs.parameters:
            steps = _check_step(case, precision, model, ours.parameters, theirs.parameters)
            # After a kink, bfloat16 gradients differ too much for steps along their signs.
            rows += steps if case.smooth or precision != "bfloat16" else steps[:1]
    if precision == "bfloat16":
        exact = build(case.model, "float64", random(case.name, seed))
        truth = _their_pass(case, exact, inputs, slope)
        rows = _with_truth(case, rows, ours, theirs, truth)
    return rows


def _with_truth(case: Case, rows: list[Row], ours: Pass, theirs: Pass, truth: Pass) -> list[Row]:
    """Add rows for both sides' errors relative to the float64 reference to those of bfloat16."""
    precision = "bfloat16"
    pair = ours.outputs, theirs.outputs
    added = [compare_truth(case.name, "forward, from float64", precision, *pair, truth.outputs)]
    mine, other = _gradients(ours, theirs)
    true, _ = _gradients(truth, truth)
    if case.smooth:
        told = {name: array for name, array in true.items() if name not in cancelling(true)}
        where = case.name, "gradients, from float64", precision
        added.append(compare_truth(*where, mine, other, told))

    def noted(row: Row) -> Row:
        if row.quantity != "gradients" or row.worst not in true:
            return row
        error = relative_error(other[row.worst], true[row.worst])
        return dataclasses.replace(row, note=f"torch's own is {error:.1e} from float64's")

    return [*map(noted, rows), *added]


def random(name: str, seed: int) -> np.random.Generator:
    """Make the generator of one case, independent of which others run."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def build(config: ModelConfig, precision: str, rng: np.random.Generator) -> TorchCrisalad:
    """Build the reference with random float32 weights, stored in float64 if requested."""
    model = TorchCrisalad(dataclasses.replace(config, compute_dtype=precision))
    shapes = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    state = random_state(shapes, rng)
    model.load_state_dict({name: torch.from_numpy(array) for name, array in state.items()})
    return (model.double() if precision == "float64" else model).eval()


def convert(model: TorchCrisalad) -> tuple[Crisalad, dict[str, np.ndarray]]:
    """Convert a reference model to copies of our parameters and of the extras."""
    state = {name: tensor.detach().numpy() for name, tensor in model.state_dict().items()}
    params, extras = to_params(state, model.config, LAYOUT, source="the torch reference")
    # Copied: torch counts a batch norm's batches in place.
    return jax.tree.map(jnp.array, params), {name: x.copy() for name, x in extras.items()}


def split(arrays: Arrays) -> dict[str, np.ndarray]:
    """Split fused arrays into the parts whose errors are compared separately.

    These are queries, keys and values; the class token's position and those of the patches.
    """
    parts: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if name.endswith(("qkv.weight", "qkv.bias", "in_proj_weight", "in_proj_bias")):
            thirds = np.split(array, 3)
            parts |= {f"{name}[{x}]": y for x, y in zip(("q", "k", "v"), thirds, strict=True)}
        elif name.endswith("pos_embed"):
            parts |= {f"{name}[class]": array[:, :1], f"{name}[grid]": array[:, 1:]}
        else:
            parts[name] = array
    return parts


def cancelling(names: Mapping[str, Any]) -> dict[str, str]:
    """Map names whose gradient is 0 up to rounding to names that give the size of its terms.

    The transport absorbs a constant added to a column of scores in the column's potential, and so
    the dustbin's score and the score network's last bias. The softmax absorbs a constant added to a
    row of attention scores, and so the bias of the keys.
    """
    partners = {
        "aggregator.dust_bin": "aggregator.score.3.weight",
        "aggregator.score.3.bias": "aggregator.score.3.weight",
        "dustbin": "scores",
    }
    found = {name: partner for name, partner in partners.items() if name in names}
    for ending in ("qkv.bias[k]", "in_proj_bias[k]"):
        partner = ending.replace("bias", "weight")
        found |= {n: n.removesuffix(ending) + partner for n in names if n.endswith(ending)}
    return found


def _rounded(array: np.ndarray) -> np.ndarray:
    if not np.issubdtype(array.dtype, np.floating):
        return array
    return torch.from_numpy(array).bfloat16().float().numpy()


def _gradients(ours: Pass, theirs: Pass) -> tuple[Arrays, Arrays]:
    """Collect gradients of everything that either side uses; 0 on a side that does not use it."""
    mine, other = ({**split(x.parameters), **x.inputs} for x in (ours, theirs))
    names = {**other, **mine}

    def filled(side: Arrays) -> Arrays:
        return {name: side.get(name, np.zeros_like(array)) for name, array in names.items()}

    return filled(mine), filled(other)


Slope = Callable[[str, tuple[int, ...]], np.ndarray]


def _their_pass(
    case: Case, model: TorchCrisalad, inputs: Mapping[str, np.ndarray], slope: Slope
) -> Pass:
    dtype = model.compute_dtype
    tensors = {name: torch.from_numpy(array) for name, array in inputs.items()}
    reals = {
        name: tensor.to(dtype, copy=True).requires_grad_()
        for name, tensor in tensors.items()
        if tensor.is_floating_point()
    }
    outputs = case.part.theirs(model, tensors | reals, model.config)
    wide = torch.promote_types(dtype, torch.float32)
    terms = [
        (output.to(wide) * torch.from_numpy(slope(name, tuple(output.shape))).to(wide)).sum()
        for name, output in outputs.items()
        if output.requires_grad
    ]
    by_name = {name: as_double(output) for name, output in outputs.items()}
    if not terms:
        return Pass(by_name, {}, {})
    parameters = dict(model.named_parameters())
    leaves = [*parameters.values(), *reals.values()]
    gradients = torch.autograd.grad(torch.stack(terms).sum(), leaves, allow_unused=True)
    found = [None if gradient is None else as_double(gradient) for gradient in gradients]
    used = zip(parameters, found, strict=False)
    return Pass(
        by_name,
        {name: gradient for name, gradient in used if gradient is not None and gradient.any()},
        {
            name: gradient
            for name, gradient in zip(reals, found[len(parameters) :], strict=True)
            if gradient is not None
        },
    )


def _our_pass(
    case: Case, model: TorchCrisalad, inputs: Mapping[str, np.ndarray], slope: Slope
) -> Pass:
    params, _ = convert(model)
    config = model.config
    reals = {
        name: jnp.asarray(array, config.compute_dtype)
        for name, array in inputs.items()
        if np.issubdtype(array.dtype, np.floating)
    }
    constants = {name: jnp.asarray(x) for name, x in inputs.items() if name not in reals}
    wide = jnp.promote_types(config.compute_dtype, jnp.float32)

    def total(params: Crisalad, reals: Mapping[str, jax.Array]) -> tuple[jax.Array, Any]:
        outputs = case.part.ours(params, {**constants, **reals}, config)
        terms = [
            (output.astype(wide) * jnp.asarray(slope(name, output.shape), wide)).sum()
            for name, output in outputs.items()
        ]
        return sum(terms, jnp.zeros((), wide)), outputs

    gradient = jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))
    (_, outputs), (of_params, of_reals) = gradient(params, reals)
    by_name = to_state(jax.tree.map(as_double, of_params), config, LAYOUT, {})
    learnt = dict(model.named_parameters())
    return Pass(
        {name: as_double(output) for name, output in outputs.items()},
        # A gradient of exactly 0 belongs to a parameter that the case does not use.
        {name: array for name, array in by_name.items() if name in learnt and array.any()},
        {name: as_double(array) for name, array in of_reals.items()},
    )


def _check_step(
    case: Case,
    precision: str,
    model: TorchCrisalad,
    our_gradients: Arrays,
    their_gradients: Arrays,
) -> list[Row]:
    """Compare one step from the same start: along the reference's gradient, then along each side's.

    AdamW's first step is the sign of the gradient, whatever its size. If a gradient is rounding
    noise, the signs on the two sides are unrelated: such elements are left out of the row for steps
    along own gradients, and counted in its note. In bfloat16, a few of the other elements may still
    differ in sign, which can be a large part of a small array: there, that row covers all arrays
    joined, and another row counts the differing signs in each array.
    """
    names = [name for name in their_gradients if name in our_gradients]
    start = {name: model.get_parameter(name).detach().numpy() for name in names}
    optimiser = make_optimiser(ONE_STEP, STEPS)

    @jax.jit
    def step(params: jax.Array, gradient: jax.Array) -> jax.Array:
        update, _ = optimiser.update(gradient, optimiser.init(params), params)
        return jnp.asarray(optax.apply_updates(params, update))

    def after(gradients: Arrays) -> dict[str, np.ndarray]:
        # All arrays are joined, because the step is elementwise and one array compiles faster.
        joined = np.concatenate([start[name].ravel() for name in names])
        along = np.concatenate([gradients[name].ravel() for name in names]).astype(joined.dtype)
        sizes = np.cumsum([start[name].size for name in names])[:-1]
        pieces = np.split(as_double(step(joined, along)), sizes)
        return split({n: x.reshape(start[n].shape) for n, x in zip(names, pieces, strict=True)})

    origin = split({name: as_double(array) for name, array in start.items()})
    theirs = _their_step(start, their_gradients)
    same, own = after(their_gradients), after(our_gradients)
    mine, other = split(our_gradients), split(their_gradients)
    # An array without a gradient, such as unused positions, would only decay.
    noise = cancelling(theirs)
    compared = [name for name in theirs if name not in noise and other[name].any()]
    tolerances = TOLERANCES[precision]
    floor = tolerances["gradients" if case.smooth else "gradients, kinks"].value
    told = {name: _told(mine[name], other[name], floor) for name in compared}
    elements, kept = sum(x.size for x in told.values()), sum(int(x.sum()) for x in told.values())
    note = (
        f"{elements - kept} of {elements} elements left out: gradients below {floor:.0e} of their "
        "array's root mean square"
    )

    def moved(state: Arrays, where: Mapping[str, Any]) -> dict[str, np.ndarray]:
        return {name: np.where(where[name], state[name] - origin[name], 0) for name in compared}

    def row(
        check: Callable[..., Row], name: str, ours: Arrays, theirs: Arrays, note: str = ""
    ) -> Row:
        return check(case.name, name, precision, ours, theirs, tolerances[name], note=note)

    def there(state: Arrays) -> Arrays:
        return {name: state[name] for name in compared}

    everywhere = dict.fromkeys(compared, True)
    steps = ((compare, OWN_STEP),)
    if precision == "bfloat16":
        steps = ((compare_joined, OWN_STEP), (compare_signs, OTHER_SIGNS))
    return [
        row(compare, STEP, moved(same, everywhere), moved(theirs, everywhere)),
        *(row(check, name, moved(own, told), moved(theirs, told), note) for check, name in steps),
        row(compare, AFTER, there(own), there(theirs)),
    ]


def _their_step(start: Arrays, gradients: Arrays) -> dict[str, np.ndarray]:
    leaves = {name: torch.from_numpy(array).clone() for name, array in start.items()}
    for name, leaf in leaves.items():
        leaf.grad = torch.from_numpy(gradients[name]).to(leaf.dtype)
    torch.optim.AdamW(
        leaves.values(),
        lr=ONE_STEP.learning_rate,
        betas=(ONE_STEP.kind.b1, ONE_STEP.kind.b2),
        weight_decay=ONE_STEP.weight_decay,
    ).step()
    return split({name: as_double(leaf) for name, leaf in leaves.items()})


def _told(ours: np.ndarray, theirs: np.ndarray, floor: float) -> np.ndarray:
    """Return where a gradient is above rounding noise, or 0 on both sides."""
    size = np.abs(theirs)
    return (size > floor * np.sqrt(np.mean(size**2))) | ((size == 0) & (ours == 0))
