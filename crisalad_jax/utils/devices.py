"""Devices that share a batch of images."""

import contextlib
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import jax
import numpy as np
from jax.core import Tracer
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec

from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.target import machine, target

SHARD_FROM = 2**14
"""Minimum number of elements to shard an array: gathering smaller ones costs too much."""


IMAGE = "image"
"""Name of the mesh's only axis, over which images are sharded."""
_Tree = TypeVar("_Tree")
_F = TypeVar("_F", bound=Callable[..., Any])


class Devices(NamedTuple):
    """The mesh of devices that a batch of images is sharded over; see `devices_for`."""

    mesh: Mesh

    def shard_batch(self, rows: np.ndarray) -> jax.Array:
        """Shard a batch over the devices, with the same number of rows on each.

        Each process gives the rows of its own devices, in the order of the processes.
        """
        sharding = NamedSharding(self.mesh, PartitionSpec(IMAGE))
        return jax.make_array_from_process_local_data(sharding, rows)

    def replicate(self, tree: _Tree) -> _Tree:
        """Replicate arrays on all devices; every process must give the same arrays.

        A CPU's virtual devices may share the buffer of a numpy array: do not change the array.
        """
        here = Mesh(np.array(self.mesh.local_devices), (IMAGE,))

        def put(leaf: Any) -> jax.Array:
            host = np.asarray(leaf) if machine().platform == "cpu" else leaf
            alike = NamedSharding(here, PartitionSpec())
            array = jax.device_put(host, alike, may_alias=True)
            if here == self.mesh:
                return array
            everywhere = NamedSharding(self.mesh, PartitionSpec())
            parts = [shard.data for shard in array.addressable_shards]
            return jax.make_array_from_single_device_arrays(array.shape, everywhere, parts)

        return jax.tree.map(put, tree)

    def shard(self, tree: _Tree) -> _Tree:
        """Shard arrays over devices by `shard_spec`; all processes pass the same full arrays."""

        def put(leaf: Any) -> jax.Array:
            host = np.array(leaf)
            return jax.make_array_from_callback(
                host.shape, shard_spec(self.mesh, host.shape), host.__getitem__
            )

        return jax.tree.map(put, tree)

    def gather(self, tree: _Tree) -> _Tree:
        """Gather arrays: replicated ones on one device, sharded ones in full on the host.

        Arrays are gathered one after the other, so that no device holds all of them. All processes
        must call it if any array is sharded.
        """
        alike = NamedSharding(self.mesh, PartitionSpec())

        def gather(leaf: jax.Array) -> Any:
            if leaf.is_fully_replicated:
                return leaf.addressable_data(0)
            return np.asarray(jax.device_put(leaf, alike).addressable_data(0))

        return jax.tree.map(gather, tree)


def shard_spec(mesh: Mesh, shape: tuple[int, ...]) -> NamedSharding:
    """Return the sharding of an array, along the longest axis that the device count divides.

    Small arrays, and arrays without such an axis, are replicated.
    """
    lengths = [size if size % mesh.size == 0 else 0 for size in shape]
    if math.prod(shape) < SHARD_FROM or not any(lengths):
        return NamedSharding(mesh, PartitionSpec())
    longest = lengths.index(max(lengths))
    return NamedSharding(mesh, PartitionSpec(*[None] * longest, mesh.axis_names[0]))


def devices_for(count: int, *, processes: bool = False) -> Devices:
    """Choose the most devices that share `count` images equally, of this process or of all.

    Raises:
        InputError: the processes cannot share the images equally.
    """
    groups = [jax.local_devices()]
    if processes:
        groups = [jax.local_devices(process_index=i) for i in range(jax.process_count())]
    if count % len(groups):
        raise InputError(f"processes: found {len(groups)}, expected a divisor of {count} images")
    each = count // len(groups)
    fewest = min(map(len, groups))
    most = max(n for n in range(1, fewest + 1) if each % n == 0)
    return Devices(Mesh(np.array([group[:most] for group in groups]).ravel(), (IMAGE,)))


def parts_for_caches(images: int, at_once: int) -> int:
    """Return the number of parts in which a CPU computes a batch, one after the other.

    Activations of a few images fit into its caches. Other platforms do not split the batch.

    Args:
        images: number of images, which may be spread over devices as `devices_for` chooses them.
        at_once: maximum number of images that a device computes at once; lowered to a divisor of
            the device's share.
    """
    if not images or target().platform != "cpu":
        return 1
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.axis_names == (IMAGE,) and mesh.axis_types == (AxisType.Manual,):
        share = images  # within `jax.shard_map` they are a device's own
    else:
        together = images % jax.process_count() == 0
        share = images // devices_for(images, processes=together).mesh.size
    return share // max(n for n in range(1, max(1, at_once) + 1) if share % n == 0)


def over_images(argument: str, position: int) -> Callable[[_F], _F]:
    """Make a decorator that gives a compiled function the devices its images are sharded over.

    The traced function gets the mesh from `image_mesh`. The sharding of an argument is known before
    tracing, not during it.

    Args:
        argument: name of an argument with a leading image axis.
        position: its place among the arguments.

    Returns:
        The decorator; the decorated function still has `lower`.
    """

    def decorate(function: _F) -> _F:
        def with_mesh(call: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(call)
            def within(*args: Any, **options: Any) -> Any:
                images = args[position] if len(args) > position else options.get(argument)
                with _shared(images):
                    return call(*args, **options)

            return within

        wrapped = with_mesh(function)
        wrapped.__dict__["lower"] = with_mesh(getattr(function, "lower"))  # noqa: B009
        return cast(_F, wrapped)

    return decorate


def _shared(images: Any) -> contextlib.AbstractContextManager[Any]:
    """Return a context in which `image_mesh` is that of an array outside of a trace."""
    where = None if isinstance(images, Tracer) else getattr(images, "sharding", None)
    if (
        not isinstance(where, NamedSharding)
        or where.mesh.axis_names != (IMAGE,)
        or where.mesh.size == 1
        or where.spec[:1] != (IMAGE,)
    ):
        return contextlib.nullcontext()
    return jax.sharding.use_abstract_mesh(where.mesh.abstract_mesh)


def image_mesh() -> AbstractMesh | None:
    """Return the devices that the traced function's images are sharded over; None for just one.

    It is also None within `jax.shard_map`, where a device sees only its own images.
    """
    mesh = jax.sharding.get_abstract_mesh()
    return mesh if mesh.axis_names == (IMAGE,) and mesh.axis_types == (AxisType.Auto,) else None


def whole_on_each(function: Callable[..., _Tree]) -> Callable[..., _Tree]:
    """Wrap a function of gathered arrays so that every device computes all of it.

    XLA would otherwise split it, and exchange its parts. On one device the function is unchanged.
    """
    mesh = image_mesh()
    if mesh is None:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=PartitionSpec(), out_specs=PartitionSpec())


def gather_images(tree: _Tree) -> _Tree:
    """Gather arrays whose first axis counts images, so that every device has all images.

    XLA would otherwise split what follows, and exchange its parts. On one device it does nothing.
    """
    mesh = image_mesh()
    if mesh is None:
        return tree
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, PartitionSpec()))
