"""What differs by platform: the compiler's options, virtual devices of a CPU, the compile cache."""

import contextlib
import contextvars
import functools
import math
import os
import pathlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from crisalad_jax.cores import usable_cores
from crisalad_jax.errors import InputError

_FUSIONS = "xla_cpu_experimental_ynn_fusion_type"
_LIBRARIES: dict[str, dict[str, bool | str]] = {
    # By default jaxlib gives attention as a whole to a library (YNN) that takes longer than Eigen's
    # products do, one by one; of a single product the two are as fast (docs/performance.md).
    "Eigen": {_FUSIONS: ""},
    # Takes a few percent less again where matrices are large, and longer where they are small; but
    # a program with its products cannot be kept in a file.
    "oneDNN": {
        _FUSIONS: "",
        "xla_cpu_use_onednn": True,
        "xla_cpu_experimental_onednn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT",
    },
    # The only one that uses a processor's products of bfloat16.
    "YNN": {_FUSIONS: "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"},
}
# By default all weights of a layer are copied out of their stack before its work begins, which
# takes up to a third more memory.
_LEAST_MEMORY = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
_SMALL = 2**23
"""So many numbers in all parameters: `tiny` has an eighth of that, `s14` three times as many."""
SPLIT_FROM = 2**14
"""Arrays of fewer numbers are never split over devices: to gather them would take longer."""
_Tree = TypeVar("_Tree")
_PORTABLE = contextvars.ContextVar("portable", default=False)


@functools.cache
def compiler_options(library: str, *, least_memory: bool = False) -> dict[str, bool | str]:
    """Options of XLA for a CPU's matrix products to be those of "Eigen", "oneDNN" or "YNN".

    `least_memory` orders all operations for that; a training step it makes longer, and no smaller.
    Options are left out that this version of jaxlib does not know; on other platforms, all.
    """
    if jax.default_backend() != "cpu":
        return {}
    known = {}
    wanted = _LIBRARIES[library] | (_LEAST_MEMORY if least_memory else {})
    for name, value in wanted.items():
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
        except Exception:  # jaxlib's own class, and which one has changed
            continue
        known[name] = value
    return known


@contextlib.contextmanager
def portable() -> Iterator[None]:
    """What is traced in here is for any platform: no choice is made by the one that traces."""
    token = _PORTABLE.set(True)
    try:
        yield
    finally:
        _PORTABLE.reset(token)


def has_fused_attention() -> bool:
    """Whether cuDNN's attention, which never writes the scores to memory, can be compiled here."""
    return not _PORTABLE.get() and _compiles_fused_attention()


@functools.cache
def _compiles_fused_attention() -> bool:
    if jax.default_backend() != "gpu":
        return False
    token = jax.ShapeDtypeStruct((1, 64, 1, 64), jnp.bfloat16)
    attention = functools.partial(jax.nn.dot_product_attention, implementation="cudnn")
    try:
        jax.jit(attention).lower(token, token, token).compile()
    except Exception:  # no cuDNN, one too old, or a GPU too old: each says so in its own way
        return False
    return True


def product_dtype(dtype: Any) -> Any:
    """In which type a product of matrices of `dtype` costs least, before it is rounded to it.

    On a CPU only products that stay in float32 run in its units for bfloat16; a GPU rounds as it
    writes.
    """
    widens = _PORTABLE.get() or jax.default_backend() == "cpu"
    return jnp.promote_types(dtype, jnp.float32) if widens else dtype


def jit(
    function: Callable[..., Any], *, runs_long: bool = False, **options: Any
) -> Callable[..., Any]:
    """`jax.jit` with `compiler_options`, where the call is not inside of another transformation.

    There the options of the outermost `jit` hold, and JAX takes no others. Products are Eigen's;
    of a large model oneDNN's, where the program `runs_long` or there is no compile cache that it
    would have to enter; YNN's where a configuration among the arguments says bfloat16, by its
    `compute_dtype`. What does not run long is ordered for the least memory. What comes back has
    `lower` too.
    """
    inner = jax.jit(function, **options)

    @functools.cache
    def with_products_of(library: str) -> Any:
        chosen = compiler_options(library, least_memory=not runs_long)
        return jax.jit(function, compiler_options=chosen, **options)

    def outermost(leaves: Sequence[Any]) -> Any:
        if any(getattr(leaf, "compute_dtype", None) == "bfloat16" for leaf in leaves):
            return with_products_of("YNN")
        caches = jax.config.jax_compilation_cache_dir is not None  # pyright: ignore
        if (runs_long or not caches) and _numbers(leaves) >= _SMALL:
            return with_products_of("oneDNN")
        return with_products_of("Eigen")

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        leaves = jax.tree.leaves((args, kwargs))
        # What is made inside of a trace is traced, whatever the arguments are.
        traced = any(isinstance(leaf, Tracer) for leaf in (*leaves, jax.lax.full((), 0)))
        if traced and _PORTABLE.get():
            return function(*args, **kwargs)  # what `inner` has traced before may not be portable
        return (inner if traced else outermost(leaves))(*args, **kwargs)

    def lower(*args: Any, **kwargs: Any) -> Any:
        return outermost(jax.tree.leaves((args, kwargs))).lower(*args, **kwargs)

    call.__dict__["lower"] = lower
    return call


def _numbers(leaves: Sequence[Any]) -> int:
    """Of floating point: a model's, and not the images as they are read."""
    arrays = (leaf for leaf in leaves if hasattr(leaf, "dtype"))
    return sum(leaf.size for leaf in arrays if jnp.issubdtype(leaf.dtype, jnp.floating))


def set_up() -> None:
    """For a program of its own, before JAX is used: virtual devices and the compile cache.

    The CPU becomes as many devices as it has cores, so that images may be spread over them
    (`devices_for`): that is faster than all cores on every product. Compiled programs are kept in
    `~/.cache/crisalad-jax` (or under XDG_CACHE_HOME), where that can be written. What the
    environment says of either (JAX_NUM_CPU_DEVICES, XLA_FLAGS, JAX_COMPILATION_CACHE_DIR) holds.
    """
    told = "JAX_NUM_CPU_DEVICES" in os.environ or "host_platform_device_count" in os.environ.get(
        "XLA_FLAGS", ""
    )
    if not told and jax.config.jax_num_cpu_devices < 1:  # pyright: ignore
        with contextlib.suppress(RuntimeError):  # JAX has been used already
            jax.config.update("jax_num_cpu_devices", usable_cores())
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore
        with contextlib.suppress(OSError, RuntimeError):  # no such right, or no home
            cache = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
            cache /= "crisalad-jax"
            cache.mkdir(parents=True, exist_ok=True)
            if os.access(cache, os.W_OK):
                jax.config.update("jax_compilation_cache_dir", str(cache))
        # What takes less is compiled as soon as it is read.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    warnings.filterwarnings("ignore", "Error writing .* onednn-fusion")  # see `jit`


class Devices(NamedTuple):
    """What a batch of images is spread over; see `devices_for`."""

    mesh: Mesh

    def spread(self, rows: np.ndarray) -> jax.Array:
        """A batch on the devices, each having as many rows of it.

        Of several processes each gives the rows of its own devices, the first process the first.
        """
        sharding = NamedSharding(self.mesh, PartitionSpec("image"))
        return jax.make_array_from_process_local_data(sharding, rows)

    def share(self, tree: _Tree) -> _Tree:
        """Arrays on all the devices alike; every process gives the same.

        The virtual devices of a CPU share one copy: that of a numpy array must stay as it is.
        """
        here = Mesh(np.array(self.mesh.local_devices), ("image",))

        def put(leaf: Any) -> jax.Array:
            host = np.asarray(leaf) if jax.default_backend() == "cpu" else leaf
            alike = NamedSharding(here, PartitionSpec())
            array = jax.device_put(host, alike, may_alias=True)
            if here == self.mesh:
                return array
            everywhere = NamedSharding(self.mesh, PartitionSpec())
            parts = [shard.data for shard in array.addressable_shards]
            return jax.make_array_from_single_device_arrays(array.shape, everywhere, parts)

        return jax.tree.map(put, tree)

    def split(self, tree: _Tree) -> _Tree:
        """Arrays in parts, one a device, by `split_on`; every process gives the same, whole."""

        def put(leaf: Any) -> jax.Array:
            host = np.array(leaf)
            return jax.make_array_from_callback(
                host.shape, split_on(self.mesh, host.shape), host.__getitem__
            )

        return jax.tree.map(put, tree)

    def whole(self, tree: _Tree) -> _Tree:
        """Arrays that are shared, on one device; those that are split, whole on the host.

        One after the other, so that no device has all of them. Of several processes all call it, if
        any array is split.
        """
        alike = NamedSharding(self.mesh, PartitionSpec())

        def gather(leaf: jax.Array) -> Any:
            if leaf.is_fully_replicated:
                return leaf.addressable_data(0)
            return np.asarray(jax.device_put(leaf, alike).addressable_data(0))

        return jax.tree.map(gather, tree)


def split_on(mesh: Mesh, shape: tuple[int, ...]) -> NamedSharding:
    """How an array is split over devices: along its longest axis of those that they divide.

    Small ones, and those without such an axis, are whole on every device.
    """
    lengths = [size if size % mesh.size == 0 else 0 for size in shape]
    if math.prod(shape) < SPLIT_FROM or not any(lengths):
        return NamedSharding(mesh, PartitionSpec())
    longest = lengths.index(max(lengths))
    return NamedSharding(mesh, PartitionSpec(*[None] * longest, mesh.axis_names[0]))


def devices_for(count: int, *, processes: bool = False) -> Devices:
    """As many devices as share `count` images alike: of this process, or of all, each as many.

    Raises:
        InputError: the processes cannot share them.
    """
    groups = [jax.local_devices()]
    if processes:
        groups = [jax.local_devices(process_index=i) for i in range(jax.process_count())]
    if count % len(groups):
        raise InputError(f"processes: found {len(groups)}, expected a divisor of {count} images")
    each = count // len(groups)
    fewest = min(map(len, groups))
    most = max(n for n in range(1, fewest + 1) if each % n == 0)
    return Devices(Mesh(np.array([group[:most] for group in groups]).ravel(), ("image",)))
