"""Set up JAX for a notebook or a program: devices and the compile cache."""

from typing import NamedTuple

import jax

from crisalad_jax.utils import compiler


class Session(NamedTuple):
    """What JAX computes on, and where it keeps compiled programs."""

    platform: str
    """cpu, gpu or tpu."""
    devices: int
    """Number of devices; a CPU is one for each core."""
    cache: str | None
    """Folder of compiled programs; None where none can be written."""

    def __repr__(self) -> str:
        """Return one line for a notebook."""
        kept = f"compiled programs in {self.cache}" if self.cache else "no compile cache"
        plural = "" if self.devices == 1 else "s"
        return f"{self.devices} {self.platform} device{plural}; {kept}"


def set_up() -> Session:
    """Set up devices and the compile cache, as the command line does.

    Call it first in a notebook or a program, before JAX is used. The CPU becomes one device for
    each core, which `describe` shards a batch over. Programs that took long to compile are kept in
    the folder that CRISALAD_CACHE names (by default `~/.cache/crisalad-jax`), so that the next
    start takes them from there. The environment variables JAX_NUM_CPU_DEVICES, XLA_FLAGS and
    JAX_COMPILATION_CACHE_DIR take precedence.

    Returns:
        The devices and the cache; once JAX is used, devices stay as they are.

    Example:
        >>> session = set_up()
        >>> session.devices >= 1
        True
    """
    compiler.set_up()
    devices = jax.devices()
    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore
    return Session(devices[0].platform, len(devices), cache)
