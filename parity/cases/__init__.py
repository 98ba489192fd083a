"""Cases to compare: layers, whole models and training runs, all tiny."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from crisalad_jax.nn.adapters import ADAPTERS
from crisalad_jax.nn.aggregators import Aggregator
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.aggregators.gem import CosPlaceConfig, GemConfig, GemPyramidConfig
from crisalad_jax.nn.aggregators.mixvpr import MixVprConfig
from crisalad_jax.nn.aggregators.queries import BoqConfig
from crisalad_jax.nn.aggregators.salad import SaladConfig
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from crisalad_jax.nn.aggregators.vlad import AnyLocConfig, NetVladConfig, SuperVladConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.cross_image import CrossImageConfig
from crisalad_jax.sinkhorn import SinkhornConfig
from parity.cases import parts
from parity.cases.case import Case, Draw, check_case
from parity.cases.run import Run, check_run
from parity.compare import Row

BATCH = 4
PATCHES = parts.GRID[0] * parts.GRID[1]
SIZE = (14 * parts.GRID[0], 14 * parts.GRID[1])

SALAD = SaladConfig(clusters=5, cluster_dim=16, token_dim=32, hidden=24, dropout=0.0)
AGGREGATORS: Mapping[str, Aggregator] = {
    "anyloc": AnyLocConfig(clusters=5, layer=-1, facet="token", assignment="euclidean"),
    # Two heads.
    "boq": BoqConfig(channels=128, queries=5, rows=3),
    "class-token": ClassTokenConfig(),
    "conv-ap": ConvApConfig(channels=20),
    "cosplace": CosPlaceConfig(dim=20),
    "gem": GemConfig(),
    "gem-pyramid": GemPyramidConfig(),
    "mixvpr": MixVprConfig(channels=20, rows=3, depth=2),
    "netvlad": NetVladConfig(clusters=5),
    "salad": SALAD,
    "supervlad": SuperVladConfig(clusters=3, ghosts=2),
    "transvpr": TransVprConfig(levels=2, dim=24),
}
"""Tiny aggregators by name."""


def _model(
    kind: Any = "none", *, encoder: int = 0, aggregator: str = "salad", **backbone: Any
) -> ModelConfig:
    # With width 64, the multi-resolution adapter's narrow convolutions have 4 channels.
    fields = {"bottleneck": 2.0} if kind == "multi-resolution" else {}
    return ModelConfig(
        image_size=SIZE,
        backbone=ViTConfig(
            dim=32,
            depth=2,
            heads=2,
            position_grid=4,
            adapter=ADAPTERS.make(kind, **fields),
            **backbone,
        ),
        aggregator=AGGREGATORS[aggregator],
        cross_image=CrossImageConfig(encoder, heads=4, feedforward=24, dropout=0.0)
        if encoder
        else "none",
    )


def _transport(iterations: int, epsilon: float) -> ModelConfig:
    sinkhorn = SinkhornConfig(iterations=iterations)
    salad = dataclasses.replace(SALAD, epsilon=epsilon, sinkhorn=sinkhorn)
    return dataclasses.replace(_model(), aggregator=salad)


PLAIN = _model()
REGISTERS = _model(registers=3)
CRISALAD = _model("depthwise", encoder=1)
CRISALAD_REGISTERS = _model("depthwise", encoder=1, registers=3, ffn="swiglu")
DINO_SALAD = _model()
CRICAVPR = _model("multi-resolution", encoder=1, aggregator="gem-pyramid")
TWO_LAYERS = _model(encoder=2)
TRANSVPR = _model(aggregator="transvpr")
NETVLAD = _model(aggregator="netvlad")
ANYLOC = _model(aggregator="anyloc")
CLASS_TOKEN = _model(aggregator="class-token")
HEADS = {
    "GeM": "gem",
    "Conv-AP": "conv-ap",
    "CosPlace's head": "cosplace",
    "MixVPR": "mixvpr",
    "BoQ": "boq",
    "SuperVLAD": "supervlad",
}
"""Their names in the table."""


def normal(*shape: int, scale: float = 1.0) -> Draw:
    """Draw normal numbers."""
    return lambda rng: rng.normal(scale=scale, size=shape).astype(np.float32)


def unit(*shape: int) -> Draw:
    """Draw unit vectors that resemble each other, like descriptors."""

    def draw(rng: np.random.Generator) -> np.ndarray:
        vectors = 1 + rng.normal(size=shape)
        return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)

    return draw


def pixels(*shape: int) -> Draw:
    """Draw bytes."""
    return lambda rng: rng.integers(0, 256, shape, dtype=np.uint8)


def similarities(looks: Sequence[int]) -> Draw:
    """Draw inner products of images that look similar if they have the same number in `looks`.

    An image that looks like another place yields pairs that a miner selects, and others it skips.
    """

    def draw(rng: np.random.Generator) -> np.ndarray:
        vectors = np.eye(max(looks) + 1)[list(looks)]
        vectors += rng.normal(scale=0.2, size=vectors.shape)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        return (vectors @ vectors.T).astype(np.float32)

    return draw


def among(valid: int) -> Draw:
    """Make a mask: the first `valid` images attend to each other, others only to themselves."""
    first = np.arange(BATCH) < valid
    return constant(first[:, None] & first | np.eye(BATCH, dtype=bool))


def earlier() -> Draw:
    """Make an asymmetric mask: each image attends to itself and to earlier ones."""
    return constant(np.tri(BATCH, dtype=bool))


def constant(array: object) -> Draw:
    """Return a constant instead of a random draw."""
    return lambda _: np.asarray(array)


IMAGES = {"images": normal(BATCH, *SIZE, 3)}
# With low variance, so that the epsilon of a layer norm shows.
TOKENS = {"tokens": normal(BATCH, 1 + PATCHES, 32, scale=0.05)}
REGISTER_TOKENS = {"tokens": normal(BATCH, 4 + PATCHES, 32, scale=0.05)}
FEATURES = {"class_token": normal(BATCH, 32), "patches": normal(BATCH, PATCHES, 32)}
SCORES = {"scores": normal(BATCH, PATCHES, 5), "dustbin": constant(np.float32(1.3))}
SEQUENCES = {"tokens": unit(BATCH, 7, 16)}
LABELS = constant(np.array([0, 0, 0, 1, 1, 1, 2, 2, 2, 3], np.int32))
DESCRIPTORS = {"descriptors": unit(10, 24), "labels": LABELS}


def _position_cases() -> list[Case]:
    grids = {
        "as stored": (4, 4),
        "square, up": (7, 7),
        "square, down": (3, 3),
        "not square": (3, 6),
        "not square, up": (5, 9),
        "not square, down": (2, 3),
    }
    return [
        Case(f"positions{kind}: {name}", model, parts.positions(grid), bfloat16=False)
        for kind, model in (("", PLAIN), (" with registers", REGISTERS))
        for name, grid in grids.items()
    ]


def _sinkhorn_cases() -> list[Case]:
    # The published 3 and 1.0; 100 for convergence; epsilon 0.1 is nearly a hard assignment.
    settings = [(1, 1.0), (3, 1.0), (10, 1.0), (100, 1.0), (3, 0.1), (3, 0.5), (3, 2.0), (10, 0.1)]
    return [
        Case(
            f"Sinkhorn: {iterations} iterations, epsilon {epsilon}",
            _transport(iterations, epsilon),
            parts.SINKHORN,
            SCORES,
            bfloat16=False,
        )
        for iterations, epsilon in settings
    ]


CASES: tuple[Case, ...] = (
    Case(
        "pixels to numbers",
        PLAIN,
        parts.PIXELS,
        {"images": pixels(BATCH, *SIZE, 3)},
        bfloat16=False,
    ),
    Case("patch embedding", PLAIN, parts.EMBED, IMAGES),
    Case("patch embedding with registers", REGISTERS, parts.EMBED, IMAGES),
    *_position_cases(),
    Case("attention", PLAIN, parts.ATTENTION, TOKENS),
    Case("MLP", PLAIN, parts.FEED_FORWARD, TOKENS),
    Case("SwiGLU", _model(ffn="swiglu"), parts.FEED_FORWARD, TOKENS),
    Case("block, no adapter", PLAIN, parts.BLOCK, TOKENS),
    *(
        Case(
            f"block, {kind} adapter",
            _model(kind, registers=registers),
            parts.BLOCK,
            tokens,
            smooth=False,
        )
        for kind, registers, tokens in (
            ("depthwise", 3, REGISTER_TOKENS),
            ("multi-resolution", 0, TOKENS),
            ("mlp", 0, TOKENS),
        )
    ),
    *_sinkhorn_cases(),
    Case("SALAD", PLAIN, parts.AGGREGATE, FEATURES, smooth=False),
    Case("GeM pyramid", CRICAVPR, parts.AGGREGATE, FEATURES, bfloat16=False, smooth=False),
    Case("NetVLAD", NETVLAD, parts.AGGREGATE, FEATURES, bfloat16=False),
    Case("AnyLoc", ANYLOC, parts.AGGREGATE, FEATURES, bfloat16=False, smooth=False),
    *(
        Case(
            name,
            _model(aggregator=aggregator),
            parts.AGGREGATE,
            FEATURES,
            bfloat16=aggregator != "gem",
            smooth=aggregator == "conv-ap",
        )
        for name, aggregator in HEADS.items()
    ),
    Case("cross-image encoder", TWO_LAYERS, parts.ENCODER, SEQUENCES),
    Case(
        "TransVPR",
        TRANSVPR,
        parts.AGGREGATE,
        FEATURES | {"patches": normal(BATCH, PATCHES, 2 * 32)},
    ),
    Case(
        "cross-image encoder, masked",
        TWO_LAYERS,
        parts.ENCODER,
        SEQUENCES | {"mask": earlier()},
    ),
    Case(
        "miner",
        PLAIN,
        parts.MINER,
        # One image each of places 1 and 2 is an outlier, none of place 0.
        {"similarities": similarities((0, 0, 0, 1, 1, 2, 2, 2, 3, 3)), "labels": LABELS},
        bfloat16=False,
        exact=True,
    ),
    Case("loss", PLAIN, parts.LOSS_PART, DESCRIPTORS, bfloat16=False),
    Case(
        "loss, padded batch",
        PLAIN,
        parts.LOSS_PART,
        DESCRIPTORS | {"valid": constant(np.arange(10) < 8)},
        bfloat16=False,
    ),
    *(
        Case(
            name,
            model,
            parts.DESCRIPTOR,
            inputs,
            forward="descriptor",
            # If rounding assigns a patch to another word, the descriptor changes.
            bfloat16=model is not ANYLOC,
            smooth=model in (CLASS_TOKEN, NETVLAD, TRANSVPR),
        )
        for name, model, inputs in (
            ("CriSALAD", CRISALAD, IMAGES),
            (
                "CriSALAD, registers, SwiGLU, masked",
                CRISALAD_REGISTERS,
                IMAGES | {"mask": among(3)},
            ),
            ("DINO-SALAD", DINO_SALAD, IMAGES),
            ("CricaVPR", CRICAVPR, IMAGES),
            ("NetVLAD's descriptor", NETVLAD, IMAGES),
            ("AnyLoc's descriptor", ANYLOC, IMAGES),
            ("class token", CLASS_TOKEN, IMAGES),
            ("TransVPR descriptor", TRANSVPR, IMAGES),
        )
    ),
)

RUNS: tuple[Run, ...] = (
    Run("training CriSALAD's adapters and head", CRISALAD, "adapters,head"),
    Run("training CriSALAD's last block and head", CRISALAD, "last-1-blocks,norm,head"),
    Run("training all of CriSALAD", CRISALAD, "all"),
    Run("training CricaVPR's adapters and head", CRICAVPR, "adapters,head"),
)


def checks(precision: str, seed: int) -> dict[str, Callable[[], list[Row]]]:
    """Collect all checks in one precision by name, in the order of the table.

    Layers that always compute in float32 or wider are left out in bfloat16.
    """

    def of_case(case: Case) -> Callable[[], list[Row]]:
        return lambda: check_case(case, precision, seed)

    def of_run(run: Run) -> Callable[[], list[Row]]:
        return lambda: check_run(run, precision, seed)

    cases = [case for case in CASES if case.bfloat16 or precision != "bfloat16"]
    return {case.name: of_case(case) for case in cases} | {run.name: of_run(run) for run in RUNS}
