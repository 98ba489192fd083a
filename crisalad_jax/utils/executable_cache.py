"""Compiled programs on disk, which are neither traced nor lowered again.

JAX's own compile cache is keyed by the lowered program, so every start has to trace and lower
first, which takes most of the time to a first descriptor. The key here covers all that a trace
depends on: the code of this package, library versions, settings, configuration and shapes.
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import inspect
import os
import pathlib
import pickle
import platform
import stat
import sys
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any

import jax
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.files import atomic_path, user_cache
from crisalad_jax.utils.target import jax_setting
from crisalad_jax.utils.version import VERSION

_MOST = 128
"""Largest number of files that are cached: the most recently used."""
_DIGEST = 32
"""Bytes of the digest that a file begins with."""
_TRACED_WITH = ("jax", "jaxlib", "numpy", "optimistix", "lineax", "equinox")
_ENABLED = "jax_enable_compilation_cache"
"""JAX's setting: whether its own cache is read and written."""
_SETTINGS = ("JAX_", "XLA_")
"""Prefixes of the environment variables that a program depends on."""


class _Folder:
    """The folder of cached programs; None, and nothing is cached, until `cache_executables`."""

    path: pathlib.Path | None = None


def cache_executables() -> None:
    """Cache compiled programs from now on, in a folder that only the user can write to.

    Call it only in a program that runs nothing but this package: code that is changed at run time,
    as in a notebook, is not part of the key. If no such folder can be made, nothing is cached.
    """
    with contextlib.suppress(OSError, RuntimeError):  # no permission, or no home folder
        folder = user_cache() / "programs"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # What is read from it is executed, so nobody else may write there.
        if _is_ones_own(folder):
            _Folder.path = folder


def cached_executable(
    function: Callable[..., Any],
    jitted: Any,
    args: Sequence[Any],
    kwargs: Mapping[str, Any],
    static_argnames: str | Sequence[str] = (),
) -> Callable[[], Any] | None:
    """Find the compiled program for a call, in this process or on disk, or else compile it.

    Args:
        function: the function, called outside of other transformations, for this machine.
        jitted: the same function under `jax.jit`.
        args: positional arguments of the call.
        kwargs: keyword arguments of the call.
        static_argnames: names of the arguments whose values are compiled into the program.

    Returns:
        A function that runs the program; None without a cache, on accelerators, with several
        processes, and for lambdas and nested functions, whose closure the key does not cover.
    """
    if _Folder.path is None or jax.default_backend() != "cpu" or jax.process_count() > 1:
        return None
    if "<" in function.__qualname__:  # <locals>, <lambda>
        return None
    given = _signature(function).bind(*args, **kwargs).arguments
    names = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
    static = {name: given.pop(name) for name in sorted(names) if name in given}
    leaves, tree = jax.tree.flatten(((), given))  # positional arguments, and those by name
    arrays = [x if isinstance(x, jax.Array) else jax.device_put(x) for x in leaves]
    _, given = jax.tree.unflatten(tree, arrays)
    described = tuple((leaf.aval, leaf.sharding, leaf.committed) for leaf in arrays)
    signature = (function, tuple(static.items()), tree, described)
    program = _programs.get(signature)
    if program is None:
        ids = [sorted(each.id for each in leaf.sharding.device_set) for leaf in arrays]
        fixed = {name: _whole(value) for name, value in static.items()}
        name = f"{function.__module__}.{function.__qualname__}"
        words = repr((_surroundings(), name, tree, fixed, described, ids))
        path = _Folder.path / hashlib.sha256(words.encode()).hexdigest()
        program = _read(path, tree, _devices(arrays))
        if program is None:
            with _without_jaxs_cache():
                program = jitted.lower(**given, **static).compile()
            _write(path, program, tree)
        _programs[signature] = program
    return functools.partial(program, **given)


@contextlib.contextmanager
def _without_jaxs_cache() -> Iterator[None]:
    """Bypass JAX's own cache: programs loaded from it lack their functions when cached again."""
    try:
        with jax_setting(_ENABLED, False):
            compilation_cache.reset_cache()
            yield
    finally:
        compilation_cache.reset_cache()


_signature = functools.cache(inspect.signature)
_programs: dict[Hashable, Any] = {}
"""Programs of this process, by all that they depend on."""


def _devices(arrays: Sequence[jax.Array]) -> list[Any]:
    """Return the devices that a program of these arguments runs on, in their order."""
    committed = (leaf.sharding.device_set for leaf in arrays if leaf.committed)
    chosen = next(committed, jax.local_devices()[:1])
    return sorted(chosen, key=lambda device: device.id)


def _whole(value: Any) -> str:
    """Describe a static argument by all its fields: its repr may leave some out."""
    kind = f"{type(value).__module__}.{type(value).__qualname__}"
    if dataclasses.is_dataclass(value):
        words = [f"{f.name}={_whole(getattr(value, f.name))}" for f in dataclasses.fields(value)]
        return f"{kind}({', '.join(words)})"
    if isinstance(value, tuple | list):
        return f"{kind}({', '.join(map(_whole, value))})"
    return f"{kind} {value!r}"


@functools.cache
def _surroundings() -> str:
    """Digest what all programs of a process depend on: code, versions, settings, processor."""
    code = pathlib.Path(__file__).parent.parent
    words = [f"{path.relative_to(code)} {sha256_of(path)}" for path in sorted(code.rglob("*.py"))]
    words += [VERSION, sys.version, *(importlib.metadata.version(name) for name in _TRACED_WITH)]
    words += [f"{k}={v}" for k, v in sorted(os.environ.items()) if k.startswith(_SETTINGS)]
    words += [f"{k}={v}" for k, v in sorted(jax.config.values.items(), key=lambda pair: pair[0])]
    words += [str(jax.devices()), platform.system(), platform.machine(), platform.processor()]
    with contextlib.suppress(OSError):  # the processor that machine code is for
        lines = pathlib.Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        words += [line for line in lines if line.startswith(("model name", "flags", "Features"))]
    return hashlib.sha256("\n".join(words).encode()).hexdigest()


def _is_ones_own(path: pathlib.Path) -> bool:
    """Return whether only this user can write to a file or folder."""
    status = path.stat()
    return status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _read(path: pathlib.Path, tree: Any, devices: list[Any]) -> Any:
    """Load a cached program; None if it is absent, damaged or not this user's."""
    try:
        data = path.read_bytes()
        if not _is_ones_own(path) or hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
            return None
        payload, out_tree = pickle.loads(data[_DIGEST:])
        program = serialize_executable.deserialize_and_load(
            payload, tree, out_tree, execution_devices=devices
        )
        os.utime(path)
    except Exception:  # of another jaxlib, truncated, or removed meanwhile: it is compiled again
        return None
    return program


def _write(path: pathlib.Path, program: Any, tree: Any) -> None:
    """Cache a program for the next process, and remove the least recently used ones."""
    try:
        payload, in_tree, out_tree = serialize_executable.serialize(program)
        if in_tree != tree:
            return
        data = pickle.dumps((payload, out_tree))
        with atomic_path(path) as temporary:
            pathlib.Path(temporary).write_bytes(hashlib.sha256(data).digest() + data)
        others = sorted(path.parent.glob("*"), key=lambda each: each.stat().st_mtime)
        for each in others[:-_MOST]:
            each.unlink(missing_ok=True)
    except Exception:  # it cannot be cached, or the disk is full: it is compiled the next time
        return
