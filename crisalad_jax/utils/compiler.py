"""Platform settings: compiler options, virtual devices of a CPU, and the compile cache."""

import contextlib
import functools
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, ParamSpec, Protocol, TypeVar, cast

import jax
from jax.extend.core import get_opaque_trace_state

from crisalad_jax.utils.executable_cache import cached_executable
from crisalad_jax.utils.files import user_cache
from crisalad_jax.utils.host import processor_flags, usable_cores
from crisalad_jax.utils.output import counted, warn
from crisalad_jax.utils.target import lowering_platforms, machine, over_devices_of, target

_P = ParamSpec("_P")
_R = TypeVar("_R", covariant=True)
_LEAST_MEMORY: dict[str, bool | str] = {
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"
}
"""By default XLA copies all weights of a layer out of their stack before the layer runs. That takes
half as much memory again, and is 3 to 5 % slower (`scripts/bench/study_compiler.py`)."""
_AMX = "amx_tile"
_BY_EIGEN: dict[str, bool | str] = {
    "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_REDUCE"
}
"""Eigen for products of float32, and YNN only for sums: faster than jaxlib's choice of YNN for all
on Intel processors with AMX, slower on AMD's (docs/performance-studies.md)."""
_AT_REST = get_opaque_trace_state()
"""JAX's trace state while it traces nothing."""
_TESTED = ((0, 10), (0, 12))
"""Versions of JAX that the tests run with: those that pyproject.toml requires."""


if jax.__version_info__[:2] not in _TESTED:  # before a crash, however the package is used
    tested = " and ".join(".".join(map(str, version)) for version in _TESTED)
    warn(
        f"found jax {jax.__version__}, tested with {tested}: results are not checked, and 0.11 "
        "crashes on several devices; pip install --upgrade 'jax>=0.12,<0.13'"
    )


def compiler_options(
    *, runs_long: bool = False, compute_dtype: str | None = None
) -> dict[str, bool | str]:
    """Return XLA's options for a program: none, except on a CPU with a tested version of JAX.

    Another version may lack an option, or crash with it; without options, a program is as correct,
    but may be slower. A program that `runs_long`, such as a training step, is not scheduled for the
    least memory, which would make it 6 % slower. The options depend on the processor, and on the
    `compute_dtype` of the program's model, None without a model.
    """
    if target().platform != "cpu" or jax.__version_info__[:2] not in _TESTED:
        return {}
    by_eigen = compute_dtype == "float32" and _AMX in processor_flags()
    return ({} if runs_long else _LEAST_MEMORY) | (_BY_EIGEN if by_eigen else {})


class Jitted(Protocol[_P, _R]):
    """A compiled function."""

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        """Call the function."""
        ...

    def lower(self, *args: Any, **kwargs: Any) -> jax.stages.Lowered:
        """Lower the function for `target()`; arguments may be `jax.ShapeDtypeStruct`."""
        ...


def jit(function: Callable[_P, _R], *, runs_long: bool = False, **options: Any) -> Jitted[_P, _R]:
    """Wrap a function in `jax.jit`, with `compiler_options` in addition to the given `options`.

    Inside another transformation, such as `jax.grad`, compiler options are those of the outermost
    `jit`: JAX accepts no others. On accelerators, float32 products have the `precision` of a
    configuration among the arguments; on all platforms, numbers have the types of `number_types`.
    The returned function also has `lower`, which lowers for `target()`.
    """
    inner = jax.jit(function, **options)

    @functools.cache
    def with_options(chosen: tuple[tuple[str, bool | str], ...]) -> Any:
        return jax.jit(function, compiler_options=dict(chosen), **options) if chosen else inner

    def outermost(leaves: Sequence[Any]) -> Any:
        dtypes = (getattr(leaf, "compute_dtype", None) for leaf in leaves)
        dtype = next((each for each in dtypes if isinstance(each, str)), None)
        return with_options(
            tuple(compiler_options(runs_long=runs_long, compute_dtype=dtype).items())
        )

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        leaves = jax.tree.leaves((args, kwargs))
        if get_opaque_trace_state() != _AT_REST:
            with number_types(leaves), _precision_of(leaves):
                return inner(*args, **kwargs)
        with number_types(leaves), _precision_of(leaves), over_devices_of(leaves):
            jitted = outermost(leaves)
            if not runs_long and target() == machine():
                static = options.get("static_argnames", ())
                program = cached_executable(function, jitted, args, kwargs, static)
                if program is not None:
                    return program()
            return jitted(*args, **kwargs)

    def lower(*args: Any, **kwargs: Any) -> Any:
        leaves = jax.tree.leaves((args, kwargs))
        with number_types(leaves), _precision_of(leaves), over_devices_of(leaves):
            traced = outermost(leaves).trace(*args, **kwargs)
            return traced.lower(lowering_platforms=lowering_platforms())

    call.__dict__["lower"] = lower
    return cast(Jitted[_P, _R], call)


@contextlib.contextmanager
def number_types(leaves: Sequence[Any] = ()) -> Iterator[None]:
    """Compute in JAX's 32-bit mode, unless a configuration among the `leaves` is of float64.

    The calling program may enable 64-bit mode for another package. Numbers without an explicit
    type, as in `jnp.zeros` or an optimiser's schedule, would then be float64, and results would
    differ. It may also forbid type promotion or compilation, which this package relies on.
    """
    wide = any(getattr(leaf, "compute_dtype", None) == "float64" for leaf in leaves)
    with (
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        jax.disable_jit(False),
        contextlib.nullcontext() if wide else jax.enable_x64(False),
    ):
        yield


def _precision_of(leaves: Sequence[Any]) -> contextlib.AbstractContextManager[None]:
    """Compute float32 products at the `precision` of a configuration, if there is one.

    A CPU has one precision, the highest.
    """
    words = (getattr(leaf, "precision", None) for leaf in leaves)
    word = next((word for word in words if isinstance(word, str)), None)
    if word is None or target().platform == "cpu":
        return contextlib.nullcontext()
    return jax.default_matmul_precision(word)


class Session(NamedTuple):
    """What JAX computes on, and where it caches compiled programs."""

    platform: str
    """cpu, gpu or tpu."""
    devices: int
    """Number of devices; a CPU counts as one for each core."""
    cache: str | None
    """Folder of compiled programs; None if no folder can be written to."""

    def __repr__(self) -> str:
        """Return one line for a notebook."""
        cached = f"compiled programs in {self.cache}" if self.cache else "no compile cache"
        return f"{counted(self.devices, f'{self.platform} device')}; {cached}"


def set_up() -> Session:
    """Set up devices and the compile cache, as the command line does.

    Call it first in a notebook or a program, before JAX is used. The CPU becomes one device for
    each core, which `describe` shards a batch over: that is faster than using all cores for every
    product. Programs that took long to compile are stored in the folder that CRISALAD_CACHE names
    (by default `~/.cache/crisalad-jax`), if it is writable, so that the next start loads them from
    there. The environment variables JAX_NUM_CPU_DEVICES, XLA_FLAGS and JAX_COMPILATION_CACHE_DIR
    take precedence.

    Returns:
        The devices and the cache; once JAX has been used, the devices no longer change.

    Example:
        >>> session = set_up()
        >>> session.devices >= 1
        True
    """
    configure()
    devices = jax.devices()
    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore
    return Session(devices[0].platform, len(devices), cache)


def configure(devices: int | None = None) -> None:
    """Configure devices and the compile cache as `set_up` does, without starting a device.

    Args:
        devices: number of devices that the CPU becomes; None is one for each core.
    """
    is_set = "host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if not is_set and jax.config.jax_num_cpu_devices < 1:  # pyright: ignore
        with contextlib.suppress(RuntimeError):  # JAX has been used already
            jax.config.update("jax_num_cpu_devices", devices or usable_cores())
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore
        with contextlib.suppress(OSError, RuntimeError):  # no permission, or no home folder
            cache = user_cache() / "xla"
            cache.mkdir(parents=True, exist_ok=True)
            if os.access(cache, os.W_OK):
                jax.config.update("jax_compilation_cache_dir", str(cache))
        # Programs that compile faster than this take as long to load from the cache.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
