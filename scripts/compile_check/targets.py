"""Machines to compile for: topologies for XLA, and published figures of the cards.

Every figure is per device, as JAX counts devices. Rates are peaks, in operations or bytes per
second.
"""

import dataclasses
import importlib
import os
import pathlib
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import jax

from crisalad_jax.config.checks import require
from crisalad_jax.utils.errors import InputError
from scripts.compile_check.kernels import dump_folder

_TPU_ENVIRONMENT = {
    "TPU_SKIP_MDS_QUERY": "1",  # otherwise libtpu asks the cloud which machine this is
    "TPU_ACCELERATOR_TYPE": "v5litepod-8",
    "TPU_WORKER_HOSTNAMES": "localhost",
    "ALLOW_MULTIPLE_LIBTPU_LOAD": "1",  # otherwise only one process at a time can load it
}
_H100 = pathlib.Path(__file__).with_name("h100_sxm.txtpb")


@dataclasses.dataclass(frozen=True)
class Card:
    """One accelerator."""

    name: str
    peaks: Mapping[str, float]
    """Operations per second of products, by operand type as in `counts.Work.flops`."""
    bandwidth: float
    """HBM bandwidth in bytes per second."""
    memory: float
    """HBM size in bytes."""
    link: float
    """Bytes per second to other devices of the same machine or slice, in one direction."""
    source: str
    """Source of the figures."""
    clock: float | None = None
    """Cycles per second of a TPU, the unit of its compiler's estimates; None for a GPU."""

    def seconds(self, flops: Mapping[str, int], moved: float) -> float:
        """Return the roofline time of an operation: the larger of its compute and memory time."""
        products = sum(n / self.peaks.get(kind, self.peaks["f32"]) for kind, n in flops.items())
        return max(products, moved / self.bandwidth)


def _tpu(name: str, peak: float, per_cycle: int, **facts: Any) -> Card:
    """Make a TPU: a float32 product takes one, three or six of bfloat16, by precision."""
    peaks = {"bf16": peak, "f32": peak, "f32:high": peak / 3, "f32:highest": peak / 6}
    page = f"https://cloud.google.com/tpu/docs/{name.removeprefix('TPU ')}"
    return Card(name, MappingProxyType(peaks), source=page, clock=peak / per_cycle, **facts)


# Operations per cycle are chosen so that libtpu's estimate of a large product comes close to them:
# 0.88 of them for v5e, 0.70 for v6e. The published peak divided by them gives the clock.
V4 = _tpu("TPU v4", 275e12, 262144, bandwidth=1200e9, memory=32 * 2**30, link=300e9)
V5E = _tpu("TPU v5e", 197e12, 131072, bandwidth=819e9, memory=16e9, link=200e9)
V5P = _tpu("TPU v5p", 459e12, 262144, bandwidth=2765e9, memory=95e9, link=600e9)
V6E = _tpu("TPU v6e", 918e12, 524288, bandwidth=1638e9, memory=32e9, link=400e9)
H100 = Card(
    "H100 SXM 80 GB",
    # Dense. float32 is TF32 by default, three TF32 products at "high", and without tensor cores at
    # "highest".
    MappingProxyType(
        {
            **{"bf16": 989.4e12, "f16": 989.4e12, "f32": 494.7e12, "f64": 66.9e12},
            **{"f32:high": 494.7e12 / 3, "f32:highest": 66.9e12},
        }
    ),
    bandwidth=3352e9,
    memory=84942979072,
    link=450e9,
    source="NVIDIA H100 Tensor Core GPU Architecture (white paper), table of H100 SXM5",
)


@dataclasses.dataclass(frozen=True)
class Machine:
    """Devices to compile for."""

    card: Card
    platform: Literal["tpu", "cuda"]
    topology: str
    """Its name for libtpu or XLA's GPU compiler."""
    devices: int
    """Number of its devices that share a batch."""
    chip_config: str | None = None
    """libtpu's name for the way in which a chip's two cores cooperate; None is its default."""

    def check_batch(self, images: int) -> None:
        """Raise InputError if the devices can't share the images equally."""
        require(images > 0, f"batch size: found {images} images, expected at least 1")
        require(
            images % self.devices == 0,
            f"batch size: found {images} images for {self.devices} devices, expected a multiple of "
            f"{self.devices}",
        )


MACHINES: Mapping[str, Machine] = {
    # libtpu has no slice of one chip, so the other chips stay unused.
    "v5e-1": Machine(V5E, "tpu", "v5e:2x2", 1),
    "v5e-8": Machine(V5E, "tpu", "v5e:2x4", 8),
    "v5e-64": Machine(V5E, "tpu", "v5e:8x8", 64),
    "v5e-256": Machine(V5E, "tpu", "v5e:16x16", 256),
    "v6e-1": Machine(V6E, "tpu", "v6e:2x2", 1),
    "v6e-8": Machine(V6E, "tpu", "v6e:2x4", 8),
    "v4": Machine(V4, "tpu", "v4:2x2x1", 4, "megacore"),
    "v5p": Machine(V5P, "tpu", "v5p:2x2x1", 4, "megacore"),
    "h100": Machine(H100, "cuda", "1x1x1", 1),
    "h100-8": Machine(H100, "cuda", "1x1x8", 8),
}
"""Machines by name, with the number of devices; without a number, one host."""

COMPILER_OPTIONS: Mapping[str, dict[str, Any]] = {
    "tpu": {},
    # Autotuning would run kernels on the absent card.
    "cuda": {"xla_gpu_enable_triton_gemm": False, "xla_gpu_autotune_level": 0},
}
"""XLA options by platform."""
_COMPILERS = {"tpu": ("libtpu",), "cuda": ("jax_plugins.xla_cuda12", "jax_plugins.xla_cuda13")}
_PACKAGES = {"tpu": f"jax[tpu]=={jax.__version__}", "cuda": f"jax-cuda12-plugin=={jax.__version__}"}
"""Packages with the compilers, for the installed version of JAX. Only on Linux."""


def compile_on_cpu() -> None:
    """Restrict JAX to the CPU before its first use, because the GPU plug-in would fail.

    If the environment names platforms, they are left unchanged.
    """
    if not jax.config.jax_platforms:  # pyright: ignore
        jax.config.update("jax_platforms", "cpu")


def check_compiler(machine: Machine, name: str) -> None:
    """Check that XLA's compiler for a machine is installed.

    Raises:
        InputError: it isn't installed; the message names the package to install.
    """
    for module in _COMPILERS[machine.platform]:
        try:
            importlib.import_module(module)
            return
        except ModuleNotFoundError:
            continue
    modules = " or ".join(_COMPILERS[machine.platform])
    raise InputError(
        f"target {name}: found no module {modules}, expected XLA's compiler: "
        f"pip install '{_PACKAGES[machine.platform]}'"
    )


def devices_of(machine: Machine) -> Sequence[Any]:
    """Return devices of an absent machine, to compile programs for.

    Raises:
        InputError: the installed compiler doesn't know the machine.
    """
    from jax.experimental import topologies

    for variable, value in _TPU_ENVIRONMENT.items():
        os.environ.setdefault(variable, value)
    options = {} if machine.chip_config is None else {"chip_config_name": machine.chip_config}
    if machine.platform == "tpu":
        dump_folder()
    if machine.platform == "cuda":
        options |= {"topology": machine.topology, "target_config": _H100.read_text()}
    try:
        topology = topologies.get_topology_desc(
            platform=machine.platform, topology_name=machine.topology, **options
        )
    except Exception as error:  # a class of jaxlib, which differs by version
        raise InputError(
            f"{machine.card.name}: found that the installed compiler has no topology "
            f"{machine.topology} ({error}), expected that of {_PACKAGES[machine.platform]}, "
            "and JAX_PLATFORMS=cpu or not set"
        ) from error
    return topology.devices[: machine.devices]
