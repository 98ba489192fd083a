"""What makes descriptors of a backbone's features."""

import dataclasses
from typing import Literal, NamedTuple

from crisalad_jax.config.checks import (
    require,
    require_choice,
    require_fraction,
    require_positive,
)


class TokenShape(NamedTuple):
    """What an aggregator makes of an image: a global token, and local ones."""

    global_dim: int
    """Width of the global token; 0 where there is none."""
    tokens: int
    """How many local tokens."""
    token_dim: int
    """Width of each, and of the cross-image encoder."""


PYRAMID_LEVELS = (2, 3)
"""The GeM pyramid's cuts of a side, as CricaVPR's: 4 and 9 regions."""


@dataclasses.dataclass(frozen=True)
class SinkhornConfig:
    """How the transport is solved; by default as SALAD was published. See `docs/sinkhorn.md`."""

    method: Literal["sinkhorn", "newton", "softmax", "dual-softmax"] = "sinkhorn"
    """Alternating projections; Newton on the semi-dual; or baselines that transport nothing."""
    dustbin: Literal["none", "column", "row and column", "token", "mass"] = "column"
    """What takes the patches that belong nowhere: nothing; a column of one learnt score (as
    published, which changes nothing in plain iterations); the same beside a row of it (SuperGlue);
    a score that the network gives each patch; or a column of learnt mass."""
    epsilon: float = 1.0
    """Entropic regularisation: scores are divided by it."""
    iterations: int = 3
    """How many; with a tolerance, at most how many."""
    tolerance: float | None = None
    """Stop where no potential changes more: the relative marginal error that the last step found,
    and plain steps do not make it larger. float32 may never get below 1e-5."""
    must_converge: bool = False
    """Raise where the tolerance is not met, in place of only saying so in the result."""
    domain: Literal["scaling", "log"] = "scaling"
    """Scaling takes exponentials once; scores too far apart fall back to the log domain."""
    relaxation: float = 1.0
    """Each half step goes so many times as far, 1 to 2, where the dual does not lose by it: faster
    where convergence is slow."""
    anderson: int = 0
    """Anderson acceleration over so many past steps; 0 for none."""
    row_tau: float = 1.0
    """Below 1, rows' masses are not fixed but drawn to their marginals by a Kullback-Leibler
    penalty of epsilon * tau / (1 - tau). With both sides free, high scores make masses that only
    their logarithms can hold."""
    column_tau: float = 1.0
    """The same for columns."""
    gradient: Literal["unrolled", "implicit", "optimistix", "stop"] = "unrolled"
    """Through the iterations; by the converged plan's conditions, in closed form; by optimistix's
    fixed point and adjoint; or potentials taken for constants."""

    def __post_init__(self) -> None:
        """Check the ranges, and that the parts go together."""
        require_choice(self, "method", "dustbin", "domain", "gradient")
        require_positive(self, "iterations", "epsilon")
        if self.tolerance is not None:
            require_positive(self, "tolerance")
        for name in ("row_tau", "column_tau"):
            value = getattr(self, name)
            require(
                0 < value <= 1,
                f"SinkhornConfig.{name}: found {value}, expected more than 0 and at most 1",
            )
        require(
            1 <= self.relaxation < 2,
            f"SinkhornConfig.relaxation: found {self.relaxation}, expected from 1 to less than 2",
        )
        require(
            isinstance(self.anderson, int) and (self.anderson == 0 or self.anderson > 1),
            f"SinkhornConfig.anderson: found {self.anderson}, expected 0 or a whole number from 2",
        )
        self._check_pairs()

    def _check_pairs(self) -> None:
        converges = self.gradient in ("implicit", "optimistix")
        require(
            not converges or self.tolerance is not None,
            f"SinkhornConfig.gradient: found {self.gradient!r} with a fixed number of iterations, "
            "expected a tolerance: it is the gradient of the converged plan",
        )
        require(
            self.gradient != "unrolled" or self.tolerance is None,
            "SinkhornConfig.gradient: found 'unrolled' with a tolerance, expected 'implicit', "
            "'optimistix' or 'stop': a loop of unknown length cannot be unrolled",
        )
        require(
            not self.must_converge or self.tolerance is not None,
            "SinkhornConfig.must_converge: found no tolerance to converge to",
        )
        plain = self.relaxation == 1 and not self.anderson
        if self.method == "newton":
            require(
                self.balanced and plain and self.gradient in ("implicit", "stop"),
                "SinkhornConfig.method: found 'newton' with relaxation, acceleration, relaxed "
                f"marginals or gradient {self.gradient!r}, expected none of these and gradient "
                "'implicit' or 'stop'",
            )
        if self.method in ("softmax", "dual-softmax"):
            require(
                self.balanced and plain and self.gradient == "unrolled",
                f"SinkhornConfig.method: found {self.method!r} with relaxation, acceleration, "
                f"relaxed marginals or gradient {self.gradient!r}, expected none of these and "
                "gradient 'unrolled': it does not iterate",
            )
        require(
            self.gradient != "optimistix" or not self.anderson,
            "SinkhornConfig.anderson: found with gradient 'optimistix', expected 0: give "
            "`sinkhorn` a solver that accelerates",
        )

    @property
    def balanced(self) -> bool:
        """Whether both sides meet their marginals exactly at convergence."""
        return self.row_tau == self.column_tau == 1


@dataclasses.dataclass(frozen=True)
class SaladConfig:
    """SALAD aggregation (Izquierdo and Civera, CVPR 2024)."""

    clusters: int = 64
    cluster_dim: int = 128
    token_dim: int = 256
    """Width of the global token."""
    hidden: int = 512
    dropout: float = 0.3
    sinkhorn: SinkhornConfig = SinkhornConfig()

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "clusters", "cluster_dim", "token_dim", "hidden")
        require_fraction(self, "dropout")

    @property
    def scores(self) -> int:
        """Scores of a patch: one a cluster, and one for a dustbin that the network scores."""
        return self.clusters + (self.sinkhorn.dustbin == "token")

    def shape(self, dim: int) -> TokenShape:
        """Its tokens, of whatever backbone."""
        return TokenShape(self.token_dim, self.clusters, self.cluster_dim)


@dataclasses.dataclass(frozen=True)
class ClassTokenConfig:
    """The backbone's class token, by itself (Oquab et al. 2023)."""

    def shape(self, dim: int) -> TokenShape:
        """A global token as wide as the backbone."""
        return TokenShape(dim, 0, dim)


@dataclasses.dataclass(frozen=True)
class GemPyramidConfig:
    """CricaVPR's class token and generalised means over 13 regions (Lu et al., CVPR 2024)."""

    def shape(self, dim: int) -> TokenShape:
        """Tokens as wide as the backbone."""
        return TokenShape(dim, sum(level**2 for level in PYRAMID_LEVELS), dim)


@dataclasses.dataclass(frozen=True)
class GemConfig:
    """Generalised mean of all patches (Radenovic et al., TPAMI 2018)."""

    def shape(self, dim: int) -> TokenShape:
        """A global token as wide as the backbone."""
        return TokenShape(dim, 0, dim)


@dataclasses.dataclass(frozen=True)
class NetVladConfig:
    """NetVLAD (Arandjelovic et al., CVPR 2016)."""

    clusters: int = 64

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "clusters")
        require(
            self.clusters > 1,
            f"NetVladConfig.clusters: found {self.clusters}, expected at least 2 to choose from",
        )

    def shape(self, dim: int) -> TokenShape:
        """A sum of residuals for each cluster."""
        return TokenShape(0, self.clusters, dim)


@dataclasses.dataclass(frozen=True)
class ConvApConfig:
    """Conv-AP, the baseline of GSV-Cities (Ali-bey et al., Neurocomputing 2022)."""

    channels: int = 1024
    """Of the 1 x 1 convolution."""
    side: int = 2
    """Means are taken over side x side regions."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "channels", "side")

    def shape(self, dim: int) -> TokenShape:
        """A mean for each region."""
        return TokenShape(0, self.side**2, self.channels)


@dataclasses.dataclass(frozen=True)
class CosPlaceConfig:
    """The head of CosPlace (Berton et al., CVPR 2022) and EigenPlaces (ICCV 2023)."""

    dim: int = 512
    """Numbers in the descriptor: CosPlace's 512, EigenPlaces' 2,048."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "dim")

    def shape(self, dim: int) -> TokenShape:
        """A global token."""
        return TokenShape(self.dim, 0, self.dim)


@dataclasses.dataclass(frozen=True)
class MixVprConfig:
    """MixVPR (Ali-bey et al., WACV 2023)."""

    channels: int = 1024
    """Channels that are left of the backbone's."""
    rows: int = 4
    """Numbers that are left of each channel."""
    depth: int = 4
    """Feature mixers, as wide inside as there are patches."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "channels", "rows", "depth")

    def shape(self, dim: int) -> TokenShape:
        """A token for each row."""
        return TokenShape(0, self.rows, self.channels)


@dataclasses.dataclass(frozen=True)
class AnyLocConfig:
    """AnyLoc: hard VLAD of a facet of one layer, nothing learnt (Keetha et al., RA-L 2023)."""

    clusters: int = 32
    """Words of the vocabulary, which `crisalad vocabulary` builds."""
    layer: int = -9
    """Block whose attention gives the facet, from 0; from the end where negative: -9 is 31 of
    ViT-g's 40, AnyLoc's choice."""
    facet: Literal["query", "key", "value", "token"] = "value"
    """Queries, keys or values of that block's attention, or the patch tokens that it leaves."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "clusters")
        require_choice(self, "facet")

    def block(self, depth: int) -> int:
        """Which of `depth` blocks the facet is of, from 0.

        Raises:
            InputError: there is no such block.
        """
        require(
            -depth <= self.layer < depth,
            f"AnyLocConfig.layer: found {self.layer}, expected {-depth} to {depth - 1} for a "
            f"backbone of {depth} blocks",
        )
        return self.layer % depth

    def shape(self, dim: int) -> TokenShape:
        """A sum of residuals for each word."""
        return TokenShape(0, self.clusters, dim)


@dataclasses.dataclass(frozen=True)
class BoqConfig:
    """Bag of queries (Ali-bey et al., CVPR 2024)."""

    channels: int = 384
    """Channels that a 3 x 3 convolution leaves of the backbone's."""
    queries: int = 64
    """Learnt queries of a block."""
    layers: int = 2
    """Blocks, of an encoder layer and its queries each."""
    rows: int = 32
    """Rows that a linear layer leaves of all blocks' answers."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "channels", "queries", "layers", "rows")
        require(
            self.channels % self.heads == 0,
            f"BoqConfig.channels: found {self.channels}, expected a multiple of its heads, "
            f"{self.heads}: one for every 64 channels",
        )

    @property
    def heads(self) -> int:
        """Heads of every attention, as the public code has them."""
        return max(1, self.channels // 64)

    def shape(self, dim: int) -> TokenShape:
        """A token for each row."""
        return TokenShape(0, self.rows, self.channels)


@dataclasses.dataclass(frozen=True)
class TransVprConfig:
    """TransVPR: patches of several layers, weighed by attention (Wang et al., CVPR 2022)."""

    levels: int = 3
    """Layers of the backbone, evenly apart, the last among them."""
    dim: int = 256
    """Numbers in the descriptor."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "levels", "dim")

    def depths(self, depth: int) -> tuple[int, ...]:
        """After how many of a backbone's `depth` blocks each level is taken."""
        return tuple(depth * (level + 1) // self.levels for level in range(self.levels))

    def shape(self, dim: int) -> TokenShape:
        """A global token."""
        return TokenShape(self.dim, 0, self.dim)


@dataclasses.dataclass(frozen=True)
class CrossImageConfig:
    """The transformer encoder that attends across the images of a batch (paper section 3.4)."""

    layers: int = 2
    """0 leaves the encoder out: an image's descriptor then never depends on other images."""
    heads: int = 16
    feedforward: int = 2048
    dropout: float = 0.1
    global_token: bool = True
    """Whether the global token enters too, cut into tokens of the clusters' width."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_positive(self, "heads", "feedforward")
        require(
            self.layers >= 0, f"CrossImageConfig.layers: found {self.layers}, expected at least 0"
        )
        require_fraction(self, "dropout")
