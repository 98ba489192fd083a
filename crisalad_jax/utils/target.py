"""The platform that a program is traced for, which all platform-dependent choices read here."""

import contextlib
import dataclasses
import functools
import os
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.extend import backend
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding

Platform = Literal["cpu", "gpu", "tpu", "portable"]
_LOWERED_AS = {"cpu": "cpu", "gpu": "cuda", "tpu": "tpu"}


@dataclasses.dataclass(frozen=True)
class Target:
    """A platform, and the properties that a program's choices depend on.

    Example:
        >>> GPU.product_dtype("bfloat16"), CPU.product_dtype("bfloat16")
        (dtype(bfloat16), dtype('float32'))
    """

    platform: Platform
    """The platform; "portable" is any of them, for exported programs."""
    cudnn: bool = False
    """Whether cuDNN's fused attention, which never writes scores to memory, compiles there."""
    branches: bool = True
    """Whether a program may branch on values that it computes."""

    def product_dtype(self, dtype: Any) -> Any:
        """Return the fastest output type of a product of matrices of `dtype`, before it is rounded.

        A CPU uses its bfloat16 units only for products with float32 outputs. A GPU and a TPU round
        as they write, at no cost.
        """
        narrow = self.platform in ("gpu", "tpu")
        return jnp.dtype(dtype) if narrow else jnp.promote_types(dtype, jnp.float32)


CPU, GPU, TPU = Target("cpu"), Target("gpu", cudnn=True), Target("tpu")
PORTABLE = Target("portable")
"""No platform-dependent choices: a program runs on all platforms."""
STRAIGHT = Target("portable", branches=False)
"""No platform-dependent choices or branches: for ONNX programs, which any engine can run."""
# JAX's trace cache depends on this: a function traced for one target is traced again for another.
_chosen = jax.make_user_context(None)
_mesh = jax.make_user_context(None)
_ONE_DEVICE = AbstractMesh((1,), ("image",), axis_types=(AxisType.Auto,))


@contextlib.contextmanager
def jax_setting(name: str, value: Any) -> Iterator[None]:
    """Change one of JAX's settings while the block runs."""
    before = jax.config.values[name]
    jax.config.update(name, value)
    try:
        yield
    finally:
        jax.config.update(name, before)


def target() -> Target:
    """Return the target of the current trace: that of `lowering_for`, or this machine."""
    return _chosen.value or machine()


@functools.cache
def machine() -> Target:
    """Return this machine as a target, detected once."""
    platform = jax.default_backend()
    if platform == "gpu":
        return Target("gpu", cudnn=_compiles_cudnn())
    return {"cpu": CPU, "tpu": TPU}.get(platform, PORTABLE)


def widens_slices() -> bool:
    """Return whether XLA widens a whole stack of bfloat16 arrays before a loop slices it.

    The CPU compiler of jax before 0.11 does (docs/performance-studies.md, Choices by processor).
    """
    return target().platform == "cpu" and jax.__version_info__ < (0, 11)


def absent_platforms(error: Exception | None = None) -> str | None:
    """Describe the platforms in `JAX_PLATFORMS` that this JAX lacks; None if it has them all.

    Args:
        error: JAX's error, if any; afterwards, JAX returns the devices started before the error.
    """
    named = os.environ.get("JAX_PLATFORMS")
    if not named:
        return None
    try:
        jax.devices()
        if "Unable to initialize backend" not in str(error):
            return None
    except Exception:  # RuntimeError, or an AssertionError without a message
        jax.config.update("jax_platforms", None)
    here = ", ".join(sorted(backend.backends()))
    return f"JAX_PLATFORMS: found {named!r}, expected platforms that this JAX has: {here}"


def _compiles_cudnn() -> bool:
    """Try to compile a training step's attention to padded tokens, which cuDNN restricts most."""
    token = jax.ShapeDtypeStruct((1, 72, 1, 64), jnp.bfloat16)
    lengths = jax.ShapeDtypeStruct((1,), jnp.int32)

    def attend(q: jax.Array, k: jax.Array, v: jax.Array, lengths: jax.Array) -> jax.Array:
        mixed = jax.nn.dot_product_attention(
            q, k, v, key_value_seq_lengths=lengths, implementation="cudnn"
        )
        return mixed.astype(jnp.float32).sum()

    try:
        jax.jit(jax.grad(attend, argnums=(0, 1, 2))).lower(token, token, token, lengths).compile()
    except Exception:  # a missing or old cuDNN and an old GPU raise different errors
        return False
    return True


def traced_mesh() -> Mesh | AbstractMesh | None:
    """Return the devices of the current trace; None if they are not known.

    A kernel, unlike an XLA operation, needs an explicit sharding. The devices are those of
    `jax.set_mesh`, of `over_devices_of`, or the machine's only one. Within `jax.shard_map` each
    device computes its own images, so it counts as one device.
    """
    ambient = jax.sharding.get_abstract_mesh()
    if not ambient.empty:
        return _ONE_DEVICE if set(ambient.axis_types) == {AxisType.Manual} else ambient
    if _mesh.value is not None:
        return _mesh.value
    return _ONE_DEVICE if jax.device_count() == 1 else None


def over_devices_of(leaves: Sequence[Any]) -> contextlib.AbstractContextManager[None]:
    """Trace for the devices that the arguments of a program are on; see `traced_mesh`."""
    if target().platform != "tpu":
        return contextlib.nullcontext()
    shardings = (getattr(leaf, "sharding", None) for leaf in leaves)
    meshes = (each.mesh for each in shardings if isinstance(each, NamedSharding))
    return _mesh(next((mesh for mesh in meshes if mesh.size > 1), _ONE_DEVICE))


@contextlib.contextmanager
def lowering_for(chosen: Target) -> Iterator[None]:
    """Trace and lower for another platform while the block runs, whether or not it is present.

    Every platform-dependent choice reads `target`, and becomes that platform's. Traces of other
    targets are neither used nor changed. For an absent GPU, `scripts/compile_check/absent.py`
    answers JAX's queries about cuDNN.

    Args:
        chosen: the target, such as `TPU`.

    Example:
        >>> with lowering_for(TPU):
        ...     target().platform
        'tpu'
    """
    with _chosen(chosen):
        yield


def lowering_platforms() -> tuple[str, ...] | None:
    """Return the platforms to lower for, as `jax.stages.Traced.lower` takes them.

    None leaves the choice to JAX, outside of `lowering_for` and for a portable program.
    """
    name = _LOWERED_AS.get(_chosen.value.platform) if _chosen.value else None
    return None if name is None else (name,)
