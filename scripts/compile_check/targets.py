"""Machines to compile for: topologies for XLA, and what their makers say of the cards.

Every figure is of one device, as JAX counts them. Rates are peaks, in operations or bytes a second.
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
    "TPU_SKIP_MDS_QUERY": "1",  # else libtpu asks the cloud which machine this is
    "TPU_ACCELERATOR_TYPE": "v5litepod-8",
    "TPU_WORKER_HOSTNAMES": "localhost",
    "ALLOW_MULTIPLE_LIBTPU_LOAD": "1",  # else one process at a time
}
_H100 = pathlib.Path(__file__).with_name("h100_sxm.txtpb")


@dataclasses.dataclass(frozen=True)
class Card:
    """One accelerator."""

    name: str
    peaks: Mapping[str, float]
    """Operations a second of products by the type of their operands, as `counts.Work.flops`."""
    bandwidth: float
    """Bytes a second of HBM."""
    memory: float
    """Bytes of HBM."""
    link: float
    """Bytes a second to other devices of the same machine or slice, in one direction."""
    source: str
    """Where the figures are published."""
    clock: float | None = None
    """Cycles a second of a TPU, which its compiler's estimates are in; None of a GPU."""

    def seconds(self, flops: Mapping[str, int], moved: float) -> float:
        """Return the roofline of an operation: the longer of its products and its traffic."""
        products = sum(n / self.peaks.get(kind, self.peaks["f32"]) for kind, n in flops.items())
        return max(products, moved / self.bandwidth)


def _tpu(name: str, peak: float, per_cycle: int, **facts: Any) -> Card:
    """Make a TPU's card: products of float32 are one, three or six of bfloat16, by precision."""
    peaks = {"bf16": peak, "f32": peak, "f32:high": peak / 3, "f32:highest": peak / 6}
    page = f"https://cloud.google.com/tpu/docs/{name.removeprefix('TPU ')}"
    return Card(name, MappingProxyType(peaks), source=page, clock=peak / per_cycle, **facts)


# The operations of a cycle are those that libtpu's estimate of a large product comes near to: v5e
# 0.88, v6e 0.70 of them. Divided into the published peak, they give the clock.
V4 = _tpu("TPU v4", 275e12, 262144, bandwidth=1200e9, memory=32 * 2**30, link=300e9)
V5E = _tpu("TPU v5e", 197e12, 131072, bandwidth=819e9, memory=16e9, link=200e9)
V5P = _tpu("TPU v5p", 459e12, 262144, bandwidth=2765e9, memory=95e9, link=600e9)
V6E = _tpu("TPU v6e", 918e12, 524288, bandwidth=1638e9, memory=32e9, link=400e9)
H100 = Card(
    "H100 SXM 80 GB",
    # Dense. float32 is TF32 by default, three such products at "high", and no tensor core at
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
    """As libtpu, or XLA's compiler for GPUs, names it."""
    devices: int
    """How many of its devices share a batch."""
    chip_config: str | None = None
    """libtpu's name of how the two cores of a chip work together; None is its default."""

    def check_batch(self, images: int) -> None:
        """Raise InputError where the devices cannot share so many images equally."""
        require(images > 0, f"batch size: found {images} images, expected at least 1")
        require(
            images % self.devices == 0,
            f"batch size: found {images} images for {self.devices} devices, expected a multiple of "
            f"{self.devices}",
        )


MACHINES: Mapping[str, Machine] = {
    # libtpu has no slice of one chip: the others are left out.
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
"""Machines by name, with the number of devices, or of one host."""

COMPILER_OPTIONS: Mapping[str, dict[str, Any]] = {
    "tpu": {},
    # Tuning runs kernels on the card, which is not here.
    "cuda": {"xla_gpu_enable_triton_gemm": False, "xla_gpu_autotune_level": 0},
}
"""XLA's options by platform."""
_COMPILERS = {"tpu": ("libtpu",), "cuda": ("jax_plugins.xla_cuda12", "jax_plugins.xla_cuda13")}
_PACKAGES = {"tpu": f"jax[tpu]=={jax.__version__}", "cuda": f"jax-cuda12-plugin=={jax.__version__}"}
"""What brings them, of the version of JAX that they belong to. On Linux alone."""


def compile_on_cpu() -> None:
    """Let JAX look for no GPU, before it is first used: nothing runs, and the plug-in would fail.

    An environment that names platforms is left as it is.
    """
    if not jax.config.jax_platforms:  # pyright: ignore
        jax.config.update("jax_platforms", "cpu")


def check_compiler(machine: Machine, name: str) -> None:
    """Check that XLA's compiler for a machine is installed.

    Raises:
        InputError: it is not installed; the message names the package that brings it.
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
    """Return devices of a machine that is not here, which programs can be compiled for.

    Raises:
        InputError: the installed compiler does not know it.
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
    except Exception as error:  # jaxlib's own class, which differs by version
        raise InputError(
            f"{machine.card.name}: found that the installed compiler has no topology "
            f"{machine.topology} ({error}), expected that of {_PACKAGES[machine.platform]}, "
            "and JAX_PLATFORMS=cpu or not set"
        ) from error
    return topology.devices[: machine.devices]
