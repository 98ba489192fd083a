"""Platform settings: compiler options, virtual devices of a CPU, and the compile cache."""

import contextlib
import functools
import os
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import get_opaque_trace_state

from crisalad_jax.utils.files import user_cache
from crisalad_jax.utils.host import usable_cores
from crisalad_jax.utils.kept import kept, remembered
from crisalad_jax.utils.notes import tell
from crisalad_jax.utils.target import lowering_platforms, machine, over_devices_of, target

_FUSIONS = "xla_cpu_experimental_ynn_fusion_type"
LIBRARIES: dict[str, dict[str, bool | str]] = {
    # Half as fast as the others where a row of the result is a multiple of 4,096 bytes, as `b14`'s
    # widest is: the rows that it writes at once then share one place of the first cache.
    "Eigen": {_FUSIONS: ""},
    # As fast as YNN for large matrices, and slower for small ones. A program with its products
    # cannot be stored in the compile cache.
    "oneDNN": {
        _FUSIONS: "",
        "xla_cpu_use_onednn": True,
        "xla_cpu_experimental_onednn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT",
    },
    # At the processor's own rate for all shapes, and the only one that uses its bfloat16
    # instructions. By default jaxlib compiles a whole attention to it, which is slower than its
    # single products.
    "YNN": {_FUSIONS: "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"},
}
BRIEF: dict[str, bool | str] = {
    # By default XLA copies all weights of a layer out of their stack before the layer runs, which
    # takes up to a third more memory.
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
    # Sums in windows of windows: as fast in what describes, and a quarter of the compile time. A
    # training step is slower without them.
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
}
"""Options of a program that does not run long."""
_SMALL = 2**23
"""Number of parameters of a large model: `tiny` has an eighth of it, `s14` three times as many."""
_AT_REST = get_opaque_trace_state()
"""What JAX traces while it traces nothing."""
_TESTED = ((0, 10), (0, 12))
"""Versions of JAX that the tests run with: those that pyproject.toml requires."""


def warn_if_untested() -> None:
    """Warn in one line if the tests do not run with this version of JAX."""
    if jax.__version_info__[:2] not in _TESTED:
        tested = " and ".join(".".join(map(str, version)) for version in _TESTED)
        tell(
            f"found jax {jax.__version__}, tested are {tested}: results are not checked, and 0.11 "
            "crashes on several devices; pip install --upgrade 'jax>=0.12,<0.13'"
        )


# Where the first program is made: before a crash, whichever way the package is used.
warn_if_untested()


def compiler_options(library: str, *, brief: bool = False) -> dict[str, bool | str]:
    """Return the XLA options that give a CPU's matrix products to "Eigen", "oneDNN" or "YNN".

    `brief` is for a program that does not run long: operations are scheduled for the least memory,
    and it compiles sooner. A training step would be slower by both. Options that this jaxlib does
    not know are left out, and all for other targets.
    """
    return _known_options(library, brief) if target().platform == "cpu" else {}


@functools.cache
def _known_options(library: str, brief: bool) -> dict[str, bool | str]:
    wanted = LIBRARIES[library] | (BRIEF if brief else {})
    return {name: value for name, value in wanted.items() if _is_known(name, value)}


@functools.cache
def _is_known(name: str, value: bool | str) -> bool:
    """Try an option on a program of nothing, which takes a fiftieth of a second."""

    def compiles() -> bool:
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        except Exception:  # jaxlib's own class, which differs by version
            return False
        return True

    return remembered(f"option {name} {value}", compiles)


def jit(
    function: Callable[..., Any], *, runs_long: bool = False, **options: Any
) -> Callable[..., Any]:
    """Wrap a function in `jax.jit` with `compiler_options`, outside of other transformations.

    Inside another transformation the outermost `jit` decides, because JAX takes no other options.
    YNN computes the products, but for a float32 model that `runs_long`: oneDNN computes those of a
    large one, which the compile cache does not store, and Eigen those of a small one. Nothing else
    decides, so results have the same bits with and without a compile cache. A function that does
    not run long has the `brief` options.
    On accelerators float32 products have the `precision` of a configuration among the arguments.
    The returned function has `lower` too, which lowers for the `target`.
    """
    inner = jax.jit(function, **options)

    @functools.cache
    def with_options(chosen: tuple[tuple[str, bool | str], ...]) -> Any:
        return jax.jit(function, compiler_options=dict(chosen), **options) if chosen else inner

    def outermost(leaves: Sequence[Any]) -> Any:
        narrow = any(getattr(leaf, "compute_dtype", None) == "bfloat16" for leaf in leaves)
        if narrow or not runs_long:
            library = "YNN"
        else:
            library = "oneDNN" if _numbers(leaves) >= _SMALL else "Eigen"
        chosen = compiler_options(library, brief=not runs_long)
        return with_options(tuple(chosen.items()))

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        leaves = jax.tree.leaves((args, kwargs))
        if get_opaque_trace_state() != _AT_REST:
            with _precision_of(leaves):
                return inner(*args, **kwargs)
        with _precision_of(leaves), over_devices_of(leaves):
            jitted = outermost(leaves)
            if not runs_long and target() == machine():

                def compile(*args: Any, **kwargs: Any) -> Any:
                    return jitted.lower(*args, **kwargs).compile()

                static = options.get("static_argnames", ())
                program = kept(function, compile, args, kwargs, static)
                if program is not None:
                    return program()
            return jitted(*args, **kwargs)

    def lower(*args: Any, **kwargs: Any) -> Any:
        leaves = jax.tree.leaves((args, kwargs))
        with _precision_of(leaves), over_devices_of(leaves):
            traced = outermost(leaves).trace(*args, **kwargs)
            return traced.lower(lowering_platforms=lowering_platforms())

    call.__dict__["lower"] = lower
    return call


def _precision_of(leaves: Sequence[Any]) -> contextlib.AbstractContextManager[None]:
    """Compute float32 products at the `precision` of a configuration, if there is one.

    A CPU has one precision, the highest.
    """
    words = (getattr(leaf, "precision", None) for leaf in leaves)
    word = next((word for word in words if isinstance(word, str)), None)
    if word is None or target().platform == "cpu":
        return contextlib.nullcontext()
    return jax.default_matmul_precision(word)


def _numbers(leaves: Sequence[Any]) -> int:
    """Count the floating-point numbers of arrays: a model's parameters, not 8-bit images."""
    arrays = (leaf for leaf in leaves if hasattr(leaf, "dtype"))
    return sum(leaf.size for leaf in arrays if jnp.issubdtype(leaf.dtype, jnp.floating))


def set_up() -> None:
    """Set up virtual devices and the compile cache of a program, before it uses JAX.

    The CPU becomes one device for each core, so that a batch can be sharded over them
    (`devices_for`). That is faster than using all cores for every product. Compiled programs are
    stored in `~/.cache/crisalad-jax` (or under XDG_CACHE_HOME), if it is writable. The environment
    variables JAX_NUM_CPU_DEVICES, XLA_FLAGS and JAX_COMPILATION_CACHE_DIR take precedence.
    """
    told = "JAX_NUM_CPU_DEVICES" in os.environ or "host_platform_device_count" in os.environ.get(
        "XLA_FLAGS", ""
    )
    if not told and jax.config.jax_num_cpu_devices < 1:  # pyright: ignore
        with contextlib.suppress(RuntimeError):  # JAX has been used already
            jax.config.update("jax_num_cpu_devices", usable_cores())
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore
        with contextlib.suppress(OSError, RuntimeError):  # no permission, or no home folder
            cache = user_cache() / "crisalad-jax"
            cache.mkdir(parents=True, exist_ok=True)
            if os.access(cache, os.W_OK):
                jax.config.update("jax_compilation_cache_dir", str(cache))
        # Programs that compile faster than this take as long to load from the cache.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    warnings.filterwarnings("ignore", "Error writing .* onednn-fusion")  # see `jit`
