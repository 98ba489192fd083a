"""What differs by platform: the compiler's options, virtual devices of a CPU, the compile cache."""

import contextlib
import functools
import os
import pathlib
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

# By default jaxlib gives attention as a whole, and other products, to a library (YNN) that takes
# longer than Eigen's products do, one by one (docs/performance.md).
_CPU_OPTIONS: dict[str, bool | str] = {"xla_cpu_experimental_ynn_fusion_type": ""}
# oneDNN's take a few percent less again where matrices are large (and half as long again where they
# are small), but a program with them cannot be kept in a file.
_ONEDNN_OPTIONS: dict[str, bool | str] = {
    "xla_cpu_use_onednn": True,
    "xla_cpu_experimental_onednn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT",
}
_SMALL = 2**23
"""So many numbers in all arguments: `tiny` is an eighth of that, `s14` three times as much."""
_Tree = TypeVar("_Tree")


@functools.cache
def compiler_options(*, onednn: bool) -> dict[str, bool | str]:
    """Options of XLA that make this package's programs faster on the default platform.

    Those are left out that this version of jaxlib does not know.
    """
    if jax.default_backend() != "cpu":
        return {}
    known = {}
    for name, value in (_CPU_OPTIONS | _ONEDNN_OPTIONS if onednn else _CPU_OPTIONS).items():
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        except Exception:  # jaxlib's own class, and which one has changed
            continue
        known[name] = value
    return known


def jit(
    function: Callable[..., Any], *, runs_long: bool = False, **options: Any
) -> Callable[..., Any]:
    """`jax.jit` with `compiler_options`, where the call is not inside of another transformation.

    There the options of the outermost `jit` hold, and JAX takes no others. What `runs_long`, and is
    not small, is compiled for the shortest run even where the compile cache is on, which it then
    cannot enter. What comes back has `lower` too.
    """
    inner = jax.jit(function, **options)

    @functools.cache
    def with_options(onednn: bool) -> Any:
        return jax.jit(function, compiler_options=compiler_options(onednn=onednn), **options)

    def outermost(leaves: Sequence[Any]) -> Any:
        caches = jax.config.jax_compilation_cache_dir is not None  # pyright: ignore
        small = sum(getattr(leaf, "size", 1) for leaf in leaves) < _SMALL
        return with_options(not small and (runs_long or not caches))

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        leaves = jax.tree.leaves((args, kwargs))
        # What is made inside of a trace is traced, whatever the arguments are.
        traced = any(isinstance(leaf, Tracer) for leaf in (*leaves, jax.lax.full((), 0)))
        return (inner if traced else outermost(leaves))(*args, **kwargs)

    def lower(*args: Any, **kwargs: Any) -> Any:
        return outermost(jax.tree.leaves((args, kwargs))).lower(*args, **kwargs)

    call.__dict__["lower"] = lower
    return call


def set_up() -> None:
    """For a program of its own, before JAX is used: virtual devices and the compile cache.

    The CPU becomes as many devices as it has cores, so that `over_devices` may spread images over
    them: that is faster than all cores on every product. Compiled programs are kept in
    `~/.cache/crisalad-jax` (or under XDG_CACHE_HOME). What the environment says of either
    (JAX_NUM_CPU_DEVICES, XLA_FLAGS, JAX_COMPILATION_CACHE_DIR) holds.
    """
    told = "JAX_NUM_CPU_DEVICES" in os.environ or "host_platform_device_count" in os.environ.get(
        "XLA_FLAGS", ""
    )
    if not told and jax.config.jax_num_cpu_devices < 1:  # pyright: ignore
        with contextlib.suppress(RuntimeError):  # JAX has been used already
            jax.config.update("jax_num_cpu_devices", _cores())
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore
        root = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(pathlib.Path(root) / "crisalad-jax"))
        # What takes less is compiled as soon as it is read.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    warnings.filterwarnings("ignore", "Error writing .* onednn-fusion")  # see `jit`


def _cores() -> int:
    """Those that this process may use, where the system says."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _mesh(count: int) -> Mesh:
    """As many local devices as share `count` images alike."""
    devices = jax.local_devices()
    most = max(n for n in range(1, len(devices) + 1) if count % n == 0)
    return Mesh(np.array(devices[:most]), ("image",))


def over_devices(images: np.ndarray) -> jax.Array:
    """A batch of images on the devices, each having as many (or on one, where it cannot be)."""
    return jax.device_put(images, NamedSharding(_mesh(len(images)), PartitionSpec("image")))


def on_every_device(tree: _Tree, count: int) -> _Tree:
    """Arrays that programs on batches of `count` images read: on all the devices of such a batch.

    The virtual devices of a CPU share one copy: that of a numpy array must stay as it is.
    """
    sharding = NamedSharding(_mesh(count), PartitionSpec())

    def put(leaf: Any) -> jax.Array:
        host = np.asarray(leaf) if jax.default_backend() == "cpu" else leaf
        return jax.device_put(host, sharding, may_alias=True)

    return jax.tree.map(put, tree)
