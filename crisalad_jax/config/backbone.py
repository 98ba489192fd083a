"""The vision transformer and its adapters."""

import dataclasses
from typing import Literal

from crisalad_jax.config.checks import (
    choose,
    require,
    require_positive,
)

PATCH_SIZE = 14


ADAPTERS = ("depthwise", "multi-resolution", "mlp", "none")


@dataclasses.dataclass(frozen=True)
class AdapterConfig:
    """The adapter beside the MLP of every block (paper section 3.2, and its Table 2's others)."""

    kind: Literal["depthwise", "multi-resolution", "mlp", "none"] = "depthwise"
    """The paper's depthwise-separable convolution, CricaVPR's multi-resolution one, or a plain MLP;
    none leaves it out."""
    bottleneck: float = 0.5
    """Width of the adapter over the width of the backbone."""
    kernel_size: int = 3
    """Side of the depthwise filter."""
    alpha: float = 0.2
    """Weight of the adapter's output (paper Eq. 2)."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        choose("AdapterConfig.kind", self.kind, dict.fromkeys(ADAPTERS))
        require_positive(self, "bottleneck", "kernel_size")
        require(
            self.kernel_size % 2 == 1,
            f"AdapterConfig.kernel_size: found {self.kernel_size}, expected an odd number",
        )


@dataclasses.dataclass(frozen=True)
class ViTConfig:
    """A DINOv2 vision transformer with patches of 14 x 14 (Oquab et al. 2023)."""

    dim: int = 768
    depth: int = 12
    heads: int = 12
    mlp_ratio: float = 4.0
    ffn: Literal["mlp", "swiglu"] = "mlp"
    registers: int = 0
    position_grid: int = 37
    """Side of the stored grid of position embeddings (37 in the public checkpoints: 518 / 14)."""
    position_start: Literal["random", "sincos"] = "random"
    """How position embeddings start where no weights are loaded."""
    layer_scale_start: float = 1.0
    adapter: AdapterConfig = AdapterConfig()

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "dim", "depth", "heads", "mlp_ratio", "position_grid")
        require(
            self.registers >= 0,
            f"ViTConfig.registers: found {self.registers}, expected at least 0",
        )
        require(
            self.dim % self.heads == 0,
            f"ViTConfig.dim: found {self.dim}, expected a multiple of the {self.heads} heads",
        )
        require(
            self.position_start != "sincos" or self.dim % 4 == 0,
            f"ViTConfig.dim: found {self.dim}, expected a multiple of 4 for a sin-cos start",
        )
        require(
            self.hidden >= 1,
            f"ViTConfig.mlp_ratio: found {self.mlp_ratio}, expected a hidden width of at least 1",
        )
        require(
            self.adapter.kind == "none" or self.adapter_dim >= 1,
            f"AdapterConfig.bottleneck: found {self.adapter.bottleneck}, expected a width of at "
            f"least 1 for dim {self.dim}",
        )
        require(
            self.adapter.kind != "multi-resolution" or self.adapter_dim % 16 == 0,
            f"AdapterConfig.bottleneck: found {self.adapter.bottleneck}, which is a width of "
            f"{self.adapter_dim} for dim {self.dim}; expected a multiple of 16, for the branches "
            "of a multi-resolution adapter take 1/2, 1/4 and 1/16 of it",
        )
        choose("ViTConfig.ffn", self.ffn, {"mlp": 0, "swiglu": 0})
        choose("ViTConfig.position_start", self.position_start, {"random": 0, "sincos": 0})

    @property
    def hidden(self) -> int:
        """Hidden width of the feed-forward network; SwiGLU's 2/3 go up to a multiple of 8."""
        hidden = int(self.dim * self.mlp_ratio)
        return (int(hidden * 2 / 3) + 7) // 8 * 8 if self.ffn == "swiglu" else hidden

    @property
    def adapter_dim(self) -> int:
        """Width of the adapter's bottleneck."""
        return int(self.dim * self.adapter.bottleneck)
