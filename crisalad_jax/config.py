"""Frozen configurations: what a model is, how it trains, the presets, and their validation.

Every field is hashable: a configuration is a static argument of jit and names a compiled program.
The values of the presets are the paper's (Xu et al., Appl. Sci. 2025, 15, 5287, section 4.2) unless
a comment says otherwise.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar, get_args, get_type_hints

from crisalad_jax.errors import InputError

PATCH_SIZE = 14

_T = TypeVar("_T")


def choose(what: str, name: str, choices: Mapping[str, _T]) -> _T:
    """Look `name` up in `choices`.

    Raises:
        InputError: no such name; the message lists the valid ones.
    """
    if name not in choices:
        raise InputError(f"{what}: found {name!r}, expected one of {', '.join(sorted(choices))}")
    return choices[name]


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise InputError(message)


def _require_positive(config: object, *names: str) -> None:
    """Whole numbers too, where fields are annotated `int`."""
    hints = get_type_hints(type(config))
    for name in names:
        value = getattr(config, name)
        _require(
            hints[name] is not int or isinstance(value, int),
            f"{type(config).__name__}.{name}: found {value}, expected a whole number",
        )
        _require(
            0 < value < math.inf,
            f"{type(config).__name__}.{name}: found {value}, expected more than 0, and finite",
        )


def _require_choice(config: object, *names: str) -> None:
    """Fields annotated `Literal` hold one of its values."""
    hints = get_type_hints(type(config))
    for name in names:
        choices = dict.fromkeys(get_args(hints[name]))
        choose(f"{type(config).__name__}.{name}", getattr(config, name), choices)


def _require_fraction(config: object, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        _require(
            0 <= value < 1,
            f"{type(config).__name__}.{name}: found {value}, expected at least 0 and less than 1",
        )


ADAPTERS = ("depthwise", "multi-resolution", "mlp", "none")
AGGREGATORS = ("salad", "gem-pyramid", "class-token")
PYRAMID_LEVELS = (2, 3)
"""The GeM pyramid's cuts of a side, as CricaVPR's: 4 and 9 regions."""


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
        _require_positive(self, "bottleneck", "kernel_size")
        _require(
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
        _require_positive(self, "dim", "depth", "heads", "mlp_ratio", "position_grid")
        _require(
            self.registers >= 0,
            f"ViTConfig.registers: found {self.registers}, expected at least 0",
        )
        _require(
            self.dim % self.heads == 0,
            f"ViTConfig.dim: found {self.dim}, expected a multiple of the {self.heads} heads",
        )
        _require(
            self.position_start != "sincos" or self.dim % 4 == 0,
            f"ViTConfig.dim: found {self.dim}, expected a multiple of 4 for a sin-cos start",
        )
        _require(
            self.hidden >= 1,
            f"ViTConfig.mlp_ratio: found {self.mlp_ratio}, expected a hidden width of at least 1",
        )
        _require(
            self.adapter.kind == "none" or self.adapter_dim >= 1,
            f"AdapterConfig.bottleneck: found {self.adapter.bottleneck}, expected a width of at "
            f"least 1 for dim {self.dim}",
        )
        _require(
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
        _require_choice(self, "method", "dustbin", "domain", "gradient")
        _require_positive(self, "iterations", "epsilon")
        if self.tolerance is not None:
            _require_positive(self, "tolerance")
        for name in ("row_tau", "column_tau"):
            value = getattr(self, name)
            _require(
                0 < value <= 1,
                f"SinkhornConfig.{name}: found {value}, expected more than 0 and at most 1",
            )
        _require(
            1 <= self.relaxation < 2,
            f"SinkhornConfig.relaxation: found {self.relaxation}, expected from 1 to less than 2",
        )
        _require(
            isinstance(self.anderson, int) and (self.anderson == 0 or self.anderson > 1),
            f"SinkhornConfig.anderson: found {self.anderson}, expected 0 or a whole number from 2",
        )
        self._check_pairs()

    def _check_pairs(self) -> None:
        converges = self.gradient in ("implicit", "optimistix")
        _require(
            not converges or self.tolerance is not None,
            f"SinkhornConfig.gradient: found {self.gradient!r} with a fixed number of iterations, "
            "expected a tolerance: it is the gradient of the converged plan",
        )
        _require(
            self.gradient != "unrolled" or self.tolerance is None,
            "SinkhornConfig.gradient: found 'unrolled' with a tolerance, expected 'implicit', "
            "'optimistix' or 'stop': a loop of unknown length cannot be unrolled",
        )
        _require(
            not self.must_converge or self.tolerance is not None,
            "SinkhornConfig.must_converge: found no tolerance to converge to",
        )
        plain = self.relaxation == 1 and not self.anderson
        if self.method == "newton":
            _require(
                self.balanced and plain and self.gradient in ("implicit", "stop"),
                "SinkhornConfig.method: found 'newton' with relaxation, acceleration, relaxed "
                f"marginals or gradient {self.gradient!r}, expected none of these and gradient "
                "'implicit' or 'stop'",
            )
        if self.method in ("softmax", "dual-softmax"):
            _require(
                self.balanced and plain and self.gradient == "unrolled",
                f"SinkhornConfig.method: found {self.method!r} with relaxation, acceleration, "
                f"relaxed marginals or gradient {self.gradient!r}, expected none of these and "
                "gradient 'unrolled': it does not iterate",
            )
        _require(
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
        _require_positive(self, "clusters", "cluster_dim", "token_dim", "hidden")
        _require_fraction(self, "dropout")

    @property
    def scores(self) -> int:
        """Scores of a patch: one a cluster, and one for a dustbin that the network scores."""
        return self.clusters + (self.sinkhorn.dustbin == "token")


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
        _require_positive(self, "heads", "feedforward")
        _require(
            self.layers >= 0, f"CrossImageConfig.layers: found {self.layers}, expected at least 0"
        )
        _require_fraction(self, "dropout")


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """CriSALAD: backbone, aggregation, cross-image encoder. And those it is measured against:

    DINO-SALAD has no adapter and no encoder; CricaVPR the multi-resolution adapter and the GeM
    pyramid; DINOv2 by itself gives its class token.
    """

    image_size: tuple[int, int] = (224, 224)
    """Height and width that images are resized to, multiples of 14."""
    normalisation: Literal["imagenet", "local-contrast"] = "imagenet"
    """What 8-bit pixels are normalised by: ImageNet or local mean and deviation."""
    backbone: ViTConfig = ViTConfig()
    aggregator: Literal["salad", "gem-pyramid", "class-token"] = "salad"
    """SALAD; CricaVPR's class token and generalised means over 13 regions; the class token."""
    salad: SaladConfig = SaladConfig()
    encoder: CrossImageConfig = CrossImageConfig()
    compute_dtype: Literal["float32", "bfloat16", "float64"] = "float32"
    """Type of the matrix products; normalisations, softmax and transport are float32 at least.
    float64 is for numerical studies, under JAX's 64-bit mode."""
    keeps: Literal["products", "blocks", "everything"] = "products"
    """What of a block's work stays in memory for the gradient: the results of its large products,
    its input alone (the least memory, a forward pass more), or all of it. Results are the same."""

    def __post_init__(self) -> None:
        """Check that the parts fit each other."""
        choose(
            "ModelConfig.normalisation", self.normalisation, {"imagenet": 0, "local-contrast": 0}
        )
        choose(
            "ModelConfig.compute_dtype",
            self.compute_dtype,
            {"float32": 0, "bfloat16": 0, "float64": 0},
        )
        _require_choice(self, "keeps")
        choose("ModelConfig.aggregator", self.aggregator, dict.fromkeys(AGGREGATORS))
        self.check_image_size(self.image_size)
        if self.encoder.layers:
            width = self.token_dim
            name = "SaladConfig.cluster_dim" if self.aggregator == "salad" else "ViTConfig.dim"
            _require(
                width % self.encoder.heads == 0,
                f"{name}: found {width}, expected a multiple of the cross-image encoder's "
                f"{self.encoder.heads} heads",
            )
            _require(
                not self.encoder.global_token or self.global_dim % width == 0,
                f"SaladConfig.token_dim: found {self.salad.token_dim}, expected a multiple of "
                f"cluster_dim {width} so that the global token can enter the cross-image encoder "
                "(or CrossImageConfig.global_token False)",
            )

    @property
    def global_dim(self) -> int:
        """Width of the global token."""
        return self.salad.token_dim if self.aggregator == "salad" else self.backbone.dim

    @property
    def token_dim(self) -> int:
        """Width of a cluster's or region's token, and of the cross-image encoder."""
        return self.salad.cluster_dim if self.aggregator == "salad" else self.backbone.dim

    @property
    def local_tokens(self) -> int:
        """How many clusters or regions there are."""
        regions = sum(level**2 for level in PYRAMID_LEVELS)
        return {"salad": self.salad.clusters, "gem-pyramid": regions, "class-token": 0}[
            self.aggregator
        ]

    @property
    def descriptor_dim(self) -> int:
        """Numbers in one descriptor."""
        return self.global_dim + self.local_tokens * self.token_dim

    def check_image_size(self, image_size: tuple[int, int]) -> None:
        """Check that this model can describe images of this height and width.

        Raises:
            InputError: a side is no multiple of 14, or there are too few patches for the
                aggregator.
        """
        if self.aggregator == "salad":
            # Where the dustbin's mass is what patches are more than clusters.
            differs = self.salad.sinkhorn.dustbin in ("column", "token")
            check_image_size(image_size, self.salad.clusters if differs else 0)
            return
        _check_sides(image_size)
        side = PATCH_SIZE * max(PYRAMID_LEVELS)
        _require(
            self.aggregator != "gem-pyramid" or min(image_size) >= side,
            f"image size: found {image_size[0]} x {image_size[1]}, expected at least {side} x "
            f"{side}, a patch for every region of the GeM pyramid",
        )


def check_image_size(image_size: tuple[int, int], clusters: int) -> None:
    """Check that images of this size make whole patches, and more of them than clusters.

    Raises:
        InputError: a side is no multiple of 14, or there are too few patches.
    """
    _check_sides(image_size)
    height, width = image_size
    patches = (height // PATCH_SIZE) * (width // PATCH_SIZE)
    side = next(s for s in range(1, clusters + 2) if s * s > clusters) * PATCH_SIZE
    _require(
        patches > clusters,
        f"image size: found {height} x {width}, which is {patches} patches for {clusters} "
        "clusters; expected more patches than clusters (the smallest square that works: "
        f"{side} x {side})",
    )


def _check_sides(image_size: tuple[int, int]) -> None:
    height, width = image_size
    _require(
        height > 0 and width > 0 and height % PATCH_SIZE == 0 and width % PATCH_SIZE == 0,
        f"image size: found {height} x {width}, expected sides that are multiples of {PATCH_SIZE} "
        f"(nearest: {_nearest_side(height)} x {_nearest_side(width)})",
    )


def _nearest_side(side: int) -> int:
    return max(PATCH_SIZE, round(side / PATCH_SIZE) * PATCH_SIZE)


@dataclasses.dataclass(frozen=True)
class MultiSimilarityConfig:
    """Multi-similarity loss (Wang et al., CVPR 2019), the constants of GSV-Cities."""

    alpha: float = 1.0
    beta: float = 50.0
    base: float = 0.0
    """Similarity around which pairs are weighed. From a cold start 0.5 learns where 0 does not."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require_positive(self, "alpha", "beta")


@dataclasses.dataclass(frozen=True)
class ContrastiveConfig:
    """Contrastive loss (Hadsell et al., CVPR 2006), the margins of GSV-Cities."""

    positive_margin: float = 0.0
    """Distance up to which a pair of one place costs nothing; unit vectors are at most 2 apart."""
    negative_margin: float = 1.0
    """Distance from which a pair of two places costs nothing."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("positive_margin", "negative_margin"):
            value = getattr(self, name)
            _require(0 <= value <= 2, f"ContrastiveConfig.{name}: found {value}, expected 0 to 2")


@dataclasses.dataclass(frozen=True)
class TripletConfig:
    """Triplet margin loss (Schroff et al., CVPR 2015), the margin of GSV-Cities."""

    margin: float = 0.1
    """By how much a positive's distance must be smaller than a negative's."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require_positive(self, "margin")


@dataclasses.dataclass(frozen=True)
class CircleConfig:
    """Circle loss (Sun et al., CVPR 2020), the constants of GSV-Cities."""

    margin: float = 0.4
    """The paper's m."""
    scale: float = 80.0
    """The paper's gamma."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require_positive(self, "scale")
        _require_fraction(self, "margin")


@dataclasses.dataclass(frozen=True)
class SupConConfig:
    """Supervised contrastive loss (Khosla et al., NeurIPS 2020), GSV-Cities' temperature."""

    temperature: float = 0.07

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require_positive(self, "temperature")


@dataclasses.dataclass(frozen=True)
class FastAPConfig:
    """FastAP (Cakir et al., CVPR 2019), GSV-Cities' number of bins."""

    bins: int = 30
    """Of the histogram of squared distances, from 0 to 4."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require_positive(self, "bins")


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Which loss is taken, of which pairs, and the constants of each."""

    kind: Literal["multi-similarity", "contrastive", "triplet", "circle", "supcon", "fast-ap"] = (
        "multi-similarity"
    )
    """The paper's multi-similarity loss, or another that the field trains with."""
    miner: Literal["multi-similarity", "none"] = "multi-similarity"
    """Which pairs enter it: those that the multi-similarity loss's miner finds hard, or all."""
    epsilon: float = 0.1
    """Margin of the miner."""
    library_quirk: bool = False
    """Return 0, as pytorch-metric-learning does, where at most one positive and at most one
    negative pair enter in the whole batch (its triplet loss does not)."""
    multi_similarity: MultiSimilarityConfig = MultiSimilarityConfig()
    contrastive: ContrastiveConfig = ContrastiveConfig()
    triplet: TripletConfig = TripletConfig()
    circle: CircleConfig = CircleConfig()
    supcon: SupConConfig = SupConConfig()
    fast_ap: FastAPConfig = FastAPConfig()

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require_choice(self, "kind", "miner")
        _require(
            self.epsilon >= 0, f"LossConfig.epsilon: found {self.epsilon}, expected at least 0"
        )
        _require(
            self.kind != "fast-ap" or self.miner == "none",
            f"LossConfig.miner: found {self.miner!r} with the loss 'fast-ap', expected 'none': it "
            "ranks all images",
        )


@dataclasses.dataclass(frozen=True)
class RandAugmentConfig:
    """RandAugment (Cubuk et al. 2020), torchvision's 14 operations, GSV-Cities' strength."""

    operations: int = 3
    magnitude: int = 9
    """Which of 31 bins of strength."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require(
            self.operations >= 0,
            f"RandAugmentConfig.operations: found {self.operations}, expected at least 0",
        )
        _require(
            0 <= self.magnitude < 31,
            f"RandAugmentConfig.magnitude: found {self.magnitude}, expected 0 to 30",
        )


@dataclasses.dataclass(frozen=True)
class LightAugmentConfig:
    """One small warp and mild changes of light, for training from scratch on fixed cameras."""

    crop: float = 0.1
    """Largest share of the side that a crop removes."""
    shift: float = 0.05
    """Largest shift, as a share of the side."""
    rotation: float = 2.0
    """Largest rotation in degrees."""
    flip: float = 0.0
    """Probability of a mirror image. All images of one place in a batch are mirrored alike."""
    blur: float = 1.0
    """Largest standard deviation of a Gaussian blur, in pixels."""
    colour: float = 0.2
    """Largest relative change of brightness, of contrast and of saturation."""
    grey: float = 0.2
    """Probability of dropping the colour."""
    gamma: float = 0.0
    """Largest change of the logarithm of an exponent on intensities."""
    illumination: float = 0.0
    """Largest change of log brightness in a smooth field over the image: uneven light."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require_fraction(self, "crop", "shift", "colour")
        for name in ("rotation", "blur", "gamma", "illumination"):
            value = getattr(self, name)
            _require(value >= 0, f"LightAugmentConfig.{name}: found {value}, expected at least 0")
        for name in ("flip", "grey"):
            value = getattr(self, name)
            _require(
                0 <= value <= 1,
                f"LightAugmentConfig.{name}: found {value}, expected a probability from 0 to 1",
            )


AugmentConfig = RandAugmentConfig | LightAugmentConfig


@dataclasses.dataclass(frozen=True)
class OptimiserConfig:
    """AdamW or Adam with an optional warm-up and a learning rate that falls."""

    kind: Literal["adamw", "adam"] = "adamw"
    """In Adam the weight decay is part of the gradient."""
    learning_rate: float = 6e-5
    schedule: Literal["linear", "step"] = "linear"
    """Linear decay step by step, or one step down every few epochs."""
    final_fraction: float = 0.0
    """Share of the learning rate that is left at the end of a linear decay."""
    decay_steps: int | None = None
    """Length of a linear decay, after which the learning rate stays; None is the whole run."""
    drop_epochs: int = 3
    """Epochs from one step down to the next (CricaVPR's)."""
    drop_factor: float = 0.5
    """What a step down multiplies the learning rate by (CricaVPR's)."""
    warmup_steps: int = 0
    weight_decay: float = 0.01
    """Torch's default for AdamW; the paper names none."""
    b1: float = 0.9
    b2: float = 0.999
    clip_norm: float | None = None
    """Largest norm of the whole gradient."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        _require_choice(self, "kind", "schedule")
        _require_positive(self, "learning_rate", "drop_epochs", "drop_factor")
        if self.decay_steps is not None:
            _require(
                self.decay_steps > 0,
                f"OptimiserConfig.decay_steps: found {self.decay_steps}, expected more than 0, or "
                "None",
            )
        for name in ("final_fraction", "warmup_steps", "weight_decay"):
            value = getattr(self, name)
            _require(value >= 0, f"OptimiserConfig.{name}: found {value}, expected at least 0")
        _require_fraction(self, "b1", "b2")
        if self.clip_norm is not None:
            _require_positive(self, "clip_norm")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A whole training run, apart from where its files lie."""

    model: ModelConfig = ModelConfig()
    loss: LossConfig = LossConfig()
    optimiser: OptimiserConfig = OptimiserConfig()
    trains: str = "adapters+head"
    """What is not frozen: adapters+head (the paper), last-N-blocks+head (SALAD), or all."""
    augment: Literal["rand-augment", "light", "none"] = "rand-augment"
    rand_augment: RandAugmentConfig = RandAugmentConfig()
    light_augment: LightAugmentConfig = LightAugmentConfig()
    places_per_batch: int = 48
    images_per_place: int = 4
    micro_batch: int | None = None
    """So many images' activations are in memory at a time: a step takes less of it and a forward
    pass longer, and is the same. None is the whole batch."""
    min_images: int = 4
    """Places with fewer images are left out."""
    batch_order: Literal["within-city", "shuffled"] = "within-city"
    """A batch of one city's places (hard negatives; the public loaders) or of all cities'."""
    cities: tuple[str, ...] | None = None
    """Which cities; None takes all."""
    epochs: int = 8
    """The paper converged within five, and stopped after three without gain."""
    validate_every: int = 1
    """Epochs from one validation to the next."""
    patience: int | None = 3
    """Validations without a better Recall@5 after which training stops; None never stops early."""
    keep_best: int = 1
    """So many validations' weights are kept, those of the best Recall@5."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        choose("TrainConfig.augment", self.augment, {"rand-augment": 0, "light": 0, "none": 0})
        choose("TrainConfig.batch_order", self.batch_order, {"within-city": 0, "shuffled": 0})
        _require_positive(self, "places_per_batch", "epochs", "validate_every", "keep_best")
        _require(
            self.images_per_place >= 2,
            f"TrainConfig.images_per_place: found {self.images_per_place}, expected at least 2: "
            "the loss needs pairs of one place",
        )
        batch = self.places_per_batch * self.images_per_place
        _require(
            self.micro_batch is None or (self.micro_batch > 0 and batch % self.micro_batch == 0),
            f"TrainConfig.micro_batch: found {self.micro_batch}, expected a divisor of the batch's "
            f"{batch} images, or None",
        )
        _require(
            self.min_images >= self.images_per_place,
            f"TrainConfig.min_images: found {self.min_images}, expected at least images_per_place "
            f"({self.images_per_place})",
        )
        _require(
            re.fullmatch(r"adapters\+head|last-\d+-blocks\+head|all", self.trains) is not None,
            f"TrainConfig.trains: found {self.trains!r}, expected adapters+head, "
            "last-N-blocks+head or all",
        )
        _require(
            self.trains != "adapters+head" or self.model.backbone.adapter.kind != "none",
            "TrainConfig.trains: found adapters+head for a model without adapters, expected "
            "last-N-blocks+head or all",
        )
        _require(
            self.patience is None or self.patience > 0,
            f"TrainConfig.patience: found {self.patience}, expected more than 0, or None",
        )
        _require(self.seed >= 0, f"TrainConfig.seed: found {self.seed}, expected at least 0")

    @property
    def augmentation(self) -> AugmentConfig | None:
        """The configuration of the augmentation that `augment` names."""
        return {
            "rand-augment": self.rand_augment,
            "light": self.light_augment,
            "none": None,
        }[self.augment]


def _preset(dim: int, depth: int, heads: int, **backbone: Any) -> ModelConfig:
    return ModelConfig(backbone=ViTConfig(dim=dim, depth=depth, heads=heads, **backbone))


# The widths of DINOv2's four sizes; b14 is the paper's model. tiny is for training from nothing.
PRESETS: Mapping[str, ModelConfig] = {
    "tiny": ModelConfig(
        image_size=(98, 98),
        normalisation="local-contrast",
        backbone=ViTConfig(
            dim=128,
            depth=4,
            heads=4,
            position_grid=7,
            position_start="sincos",
        ),
        salad=SaladConfig(clusters=16, cluster_dim=32, token_dim=64, hidden=128, dropout=0.0),
        encoder=CrossImageConfig(heads=4, feedforward=128, dropout=0.0),
    ),
    "s14": _preset(384, 12, 6),
    "b14": _preset(768, 12, 12),
    "l14": _preset(1024, 24, 16),
    "g14": _preset(1536, 40, 24, ffn="swiglu"),
}


def recipe(preset: str, name: str | None = None) -> TrainConfig:
    """How a model is trained, and which parts it has for that.

    Args:
        preset: the size of the model (PRESETS).
        name: what to reproduce (RECIPES); None is the paper's way, except for `tiny`, which starts
            from nothing.

    Raises:
        InputError: no such preset or recipe, or one that does not fit the preset.
    """
    model = choose("preset", preset, PRESETS)
    default = "scratch" if preset == "tiny" else "crisalad"
    return choose("recipe", default if name is None else name, RECIPES)(model)


def _crisalad(model: ModelConfig) -> TrainConfig:
    """The paper's section 4.2."""
    return TrainConfig(model=model)


def _varied(**optimiser: Any) -> Callable[[ModelConfig], TrainConfig]:
    """A row of the paper's Table 2 with another optimiser."""
    return lambda model: TrainConfig(model=model, optimiser=OptimiserConfig(**optimiser))


def _salad(model: ModelConfig) -> TrainConfig:
    """serizba/salad: no adapter and no encoder, the last four blocks train, mixed precision."""
    backbone = dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="none"))
    return TrainConfig(
        model=dataclasses.replace(
            model,
            backbone=backbone,
            encoder=dataclasses.replace(model.encoder, layers=0),
            compute_dtype="bfloat16",
        ),
        optimiser=OptimiserConfig(weight_decay=9.5e-9, final_fraction=0.2, decay_steps=4000),
        trains="last-4-blocks+head",
        places_per_batch=60,
        epochs=4,
        patience=None,
    )


def _cricavpr(model: ModelConfig) -> TrainConfig:
    """Lu-Feng/CricaVPR: multi-resolution adapters, a GeM pyramid, Adam that steps down."""
    adapter = AdapterConfig(kind="multi-resolution")
    return TrainConfig(
        model=dataclasses.replace(
            model,
            backbone=dataclasses.replace(model.backbone, adapter=adapter),
            aggregator="gem-pyramid",
        ),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-4, schedule="step", weight_decay=0.0
        ),
        places_per_batch=72,
    )


def _scratch(model: ModelConfig) -> TrainConfig:
    """From random weights, all of the model: ours, for `tiny`."""
    return TrainConfig(
        model=model,
        # base 0.5: from a cold start base 0 drives all similarities to 0 together.
        loss=LossConfig(multi_similarity=MultiSimilarityConfig(base=0.5)),
        optimiser=OptimiserConfig(
            learning_rate=1e-3,
            final_fraction=0.02,
            warmup_steps=30,
            weight_decay=0.05,
            b2=0.99,
            clip_norm=1.0,
        ),
        trains="all",
        augment="light",
        light_augment=LightAugmentConfig(colour=0.4, gamma=0.5, illumination=0.6),
        images_per_place=2,
        min_images=2,
        batch_order="shuffled",
        epochs=150,
        validate_every=10,
        patience=None,
    )


RECIPES: Mapping[str, Callable[[ModelConfig], TrainConfig]] = {
    "crisalad": _crisalad,
    "crisalad-1e-4": _varied(learning_rate=1e-4),
    "crisalad-step": _varied(schedule="step"),
    "salad": _salad,
    "cricavpr": _cricavpr,
    "scratch": _scratch,
}
"""Named by what they reproduce. Table 2's other rows are one flag of `crisalad` each."""
