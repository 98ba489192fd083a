"""Recipes for methods over DINOv2, after the authors' training code where it is published.

Only CricaVPR's has a cross-image encoder. If a method's code validates at a larger image size than
it trains at, so does its recipe, except for preset tiny, which validates at the training size.
"""

import dataclasses
from typing import Any

from crisalad_jax.data.augmentations import NoAugmentation
from crisalad_jax.data.augmentations.rand_augment import RandAugmentConfig
from crisalad_jax.data.samplers.viewpoints import Viewpoints
from crisalad_jax.nn.adapters import Adapter
from crisalad_jax.nn.adapters.bottleneck import SideConfig, SideMultiResolutionConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.training.config import MiningConfig, MixtureSet, OptimiserConfig, TrainConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.pairwise import SelaVprLoss
from crisalad_jax.training.recipes.base import model_of, register_recipe, validation_size
from crisalad_jax.training.schedules import MilestonesSchedule, StepSchedule
from crisalad_jax.training.trainable import ADAPTERS_AND_HEAD

ADAM_STEP = OptimiserConfig(kind="adam", learning_rate=5e-5, schedule="step", weight_decay=0.0)
"""Optimiser of CricaVPR's code and of the code derived from it."""
BOQ_TRAINING: dict[str, Any] = {
    "optimiser": OptimiserConfig(
        learning_rate=1e-4,
        schedule=MilestonesSchedule((10, 20), gamma=0.1),
        warmup_epochs=10,
        weight_decay=1e-4,
    ),
    "trainable": "last-2-blocks,norm,head",
    "augmentation": RandAugmentConfig(magnitude=15),
    "places_per_batch": 128,
    "epochs": 40,
    "monitor": "R@1",
    "patience": None,
}
"""Settings of BoQ's code for all its backbones."""
MIXVPR_OPTIMISER = OptimiserConfig(
    kind="sgd",
    learning_rate=0.05,
    schedule=MilestonesSchedule((5, 10, 15, 25, 45), gamma=0.3),
    warmup_steps=650,
    weight_decay=1e-3,
)
"""Optimiser of amaralibey/MixVPR, for batches of 120 places."""


_HALF_FLOATS: dict[str, Any] = {
    "compute_dtype": "bfloat16",
    "pixels": "floats",
    "round_to_patch": True,
}
"""Precision and image preparation in the code of several methods."""


def _vit(model: ModelConfig, *, adapter: Adapter | str = "none", **fields: Any) -> Any:
    """Change a preset's backbone; methods other than CriSALAD have no adapter, or their own."""
    return dataclasses.replace(model.backbone, adapter=adapter, **fields)


@register_recipe("anyloc")
def anyloc(model: ModelConfig, preset: str) -> TrainConfig:
    """Make AnyLoc's recipe (Keetha et al., RA-L 2023), in which nothing trains."""
    return TrainConfig(model=model_of(model, preset, _vit(model), "anyloc"), trainable="head")


@register_recipe("salad")
def salad(model: ModelConfig, preset: str) -> TrainConfig:
    """Make SALAD's recipe, from serizba/salad (Izquierdo and Civera, CVPR 2024).

    There is no adapter or cross-image encoder; the last four blocks train in mixed precision.

    SALAD's code also advances the schedule by one step at the end of each epoch. That is left out:
    it lowers the learning rate by less than 1 part in 1,000.
    """
    return TrainConfig(
        model=model_of(model, preset, _vit(model), None, compute_dtype="bfloat16"),
        optimiser=dataclasses.replace(TrainConfig.optimiser, weight_decay=9.5e-9),
        trainable="last-4-blocks,norm,head",
        places_per_batch=60,
        epochs=4,
        monitor="R@1",
        patience=None,
    )


@register_recipe("vlad-buff")
def vlad_buff(model: ModelConfig, preset: str) -> TrainConfig:
    """Make VLAD-BuFF's recipe, from Ahmedest61/VLAD-BuFF (Khaliq et al., ECCV 2024).

    It is SALAD's training with another head, which starts from principal components and centroids
    of 500 training images. The authors' code takes images of London instead; its published weights
    are those of the last epoch.
    """
    whole = model_of(model, preset, _vit(model), "vlad-buff", compute_dtype="bfloat16")
    return dataclasses.replace(salad(model, preset), model=whole)


@register_recipe("cricavpr")
def cricavpr(model: ModelConfig, preset: str) -> TrainConfig:
    """Make CricaVPR's recipe, from Lu-Feng/CricaVPR (Lu et al., CVPR 2024).

    It has multi-resolution adapters, a GeM pyramid, and Adam with step decay. The code's README
    sets 10 epochs, too few for its patience of 10 to take effect. The best weights are those
    with the best R@5, as in the current code; its first version took the sum of R@1 and R@5.
    """
    backbone = _vit(model, adapter="multi-resolution")
    alone = model_of(model, preset, backbone, "gem-pyramid", antialias=False, pixels="floats")
    return TrainConfig(
        model=dataclasses.replace(alone, cross_image=model.cross_image),
        optimiser=dataclasses.replace(ADAM_STEP, learning_rate=1e-4),
        places_per_batch=72,
        epochs=10,
        patience=10,
    )


@register_recipe("selavpr")
def selavpr(model: ModelConfig, preset: str) -> TrainConfig:
    """Make SelaVPR's recipe, from Lu-Feng/SelaVPR (ICLR 2024): preset l14, tuples mined in MSLS.

    A batch is 4 tuples of a query, a positive and 2 negatives; the loss compares descriptors and
    local features. An epoch has 30,000 queries, in rounds of 1,000. Training on Pitts30k starts
    from the MSLS weights, with 5,000 queries per epoch (`--mining.queries-per-epoch 5000`). The
    code validates with re-ranking; this recipe does not.
    """
    backbone = _vit(model, adapter="serial-parallel")
    return TrainConfig(
        model=model_of(model, preset, backbone, "selavpr", antialias=False, pixels="floats"),
        loss=LossConfig(kind=SelaVprLoss(), miner="none"),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-5, schedule="constant", weight_decay=0.0
        ),
        augmentation=NoAugmentation(),
        mining=MiningConfig(kind="sample", negatives=2, queries_per_epoch=30_000),
        places_per_batch=4,
        images_per_place=4,
        epochs=50,
        patience=3,
    )


@register_recipe("selavprpp")
def selavprpp(model: ModelConfig, preset: str) -> TrainConfig:
    """Make SelaVPR++'s recipe, from Lu-Feng/SelaVPRplusplus (Lu et al. 2025): its first stage.

    The head trains, and so do adapters on a path parallel to the frozen blocks (for preset l14, to
    the last 16). The authors train on GSV-Cities and parts of other sets, as places in one layout.
    The second stage, which trains another path for the signs of the descriptor, is not included.
    """
    is_large = preset == "l14"
    adapter = SideMultiResolutionConfig(last=16 if is_large else None)
    return TrainConfig(
        model=model_of(
            *(model, preset, _vit(model, adapter=adapter), "selavprpp"),
            head={"dim": 4096} if is_large else {},
            **_HALF_FLOATS,
        ),
        optimiser=dataclasses.replace(ADAM_STEP, learning_rate=4e-4),
        places_per_batch=120,
        epochs=25,
        monitor="R@1+R@5",
        patience=12,
        validation_size=validation_size(preset, 322),
    )


@register_recipe("edtformer")
def edtformer(model: ModelConfig, preset: str) -> TrainConfig:
    """Make EDTformer's recipe, from Tong-Jin01/EDTformer (Jin et al. 2025).

    It has adapters of width 4 parallel to the blocks, a decoder, and Adam with step decay.
    """
    adapter = SideConfig(bottleneck=4 / model.backbone.dim, alpha=0.5)
    backbone = _vit(model, adapter=adapter)
    return TrainConfig(
        model=model_of(model, preset, backbone, "edtformer", pixels="floats", round_to_patch=True),
        optimiser=dataclasses.replace(
            ADAM_STEP, learning_rate=1e-4, schedule=StepSchedule(gamma=0.7)
        ),
        places_per_batch=72,
        epochs=15,
        patience=15,
        validation_size=validation_size(preset, 322),
    )


@register_recipe("supervlad")
def supervlad(model: ModelConfig, preset: str) -> TrainConfig:
    """Make SuperVLAD's recipe, from Lu-Feng/SuperVLAD (NeurIPS 2024): no cross-image encoder.

    The last four blocks train. The score layer starts from k-means centroids of 5,000 training
    images; the authors' code takes images of MSLS instead, at 322 x 322. (In that code, the encoder
    of the cross-image model has its own optimiser, which gets no gradient after the first step.)
    """
    return TrainConfig(
        model=model_of(
            model, preset, _vit(model), "supervlad", pixels="floats", round_to_patch=True
        ),
        optimiser=ADAM_STEP,
        trainable="last-4-blocks,head",
        places_per_batch=120,
        epochs=20,
        monitor="R@1+R@5",
        validation_size=validation_size(preset, 322),
    )


@register_recipe("image")
def image(model: ModelConfig, preset: str) -> TrainConfig:
    """Make ImAge's recipe, from Lu-Feng/ImAge (NeurIPS 2025): DINOv2 with registers.

    The block where the aggregation tokens enter and all later ones train. The tokens start from
    centroids of the last block's features of 5,000 training images; the authors' code takes images
    of MSLS instead by default, at 322 x 322.
    """
    config = model_of(
        model,
        preset,
        _vit(model, registers=4, position_resize="plain"),
        "aggregation-tokens",
        **_HALF_FLOATS,
    )
    tokens: Any = config.aggregator
    return dataclasses.replace(
        supervlad(model, preset),
        model=config,
        trainable=f"last-{-tokens.insertion}-blocks,head",
        patience=20,
    )


@register_recipe("boq")
def boq(model: ModelConfig, preset: str) -> TrainConfig:
    """Make BoQ's recipe over DINOv2, from amaralibey/Bag-of-Queries (Ali-bey et al., CVPR 2024).

    The last two blocks train. The head is that of the published weights, with 12,288 dimensions;
    the default head of the code is wider, but has 8,192 dimensions.
    """
    return TrainConfig(
        model=model_of(
            *(model, preset, _vit(model), "boq"),
            compute_dtype="bfloat16",
            filter="bicubic",
            pixels="floats",
        ),
        validation_size=validation_size(preset, 322),
        **BOQ_TRAINING,
    )


@register_recipe("dino-mix")
def dino_mix(model: ModelConfig, preset: str) -> TrainConfig:
    """Make DINO-Mix's recipe (GaoShuang98/DINO-Mix, Huang et al. 2024): two mixers over DINOv2.

    The last four blocks train. So do the class token and the position embeddings, because the
    authors' code freezes only the other parameters before the blocks. That code chooses the best
    weights on the test set of Pitts30k; here they are chosen on `--val`.
    """
    return TrainConfig(
        model=model_of(
            *(model, preset, _vit(model), "mixvpr"),
            head={"depth": 2, "last_norm": False},
            compute_dtype="bfloat16",
            antialias=False,
            pixels="floats",
        ),
        optimiser=dataclasses.replace(
            MIXVPR_OPTIMISER, learning_rate=0.005, accumulate=4, clip_value=0.5
        ),
        trainable="last-4-blocks,norm,positions,head",
        places_per_batch=80,
        epochs=60,
        monitor="R@1",
        patience=None,
    )


@register_recipe("salad-cm")
def salad_cm(model: ModelConfig, preset: str) -> TrainConfig:
    """Make SALAD-CM's recipe, from serizba/cliquemining (Izquierdo and Civera, ECCV 2024).

    It is SALAD's, but half of the places are cliques of MSLS: `--data gsv=DIR msls=DIR`. The code
    computes descriptors of MSLS once, with a trained SALAD, and draws all cliques in advance; here
    the model that is being trained computes them again before each epoch.
    """
    sets = MixtureSet("gsv"), MixtureSet("msls", sampler="cliques")
    return dataclasses.replace(salad(model, preset), mixture=sets)


@register_recipe("sage")
def sage(model: ModelConfig, preset: str) -> TrainConfig:
    """Make a recipe for SAGE (Chen et al., ICLR 2026), whose training code is not published.

    The model, the frozen backbone and the kind of sampler are the paper's. The sampler
    (`geo-visual`) grows cliques in a graph of image positions and visual similarity, which the
    model rebuilds before each epoch. Everything else is our choice and follows SALAD-CM: the sets
    (`--data gsv=DIR msls=DIR`), the batches, the loss, the optimiser and the training size.
    `sage+sage-encoder` has the cross-image encoder.
    """
    backbone = _vit(model, adapter="dynamic-power")
    whole = model_of(model, preset, backbone, "sage", antialias=False, pixels="floats")
    return dataclasses.replace(
        salad(model, preset),
        model=dataclasses.replace(whole, compute_dtype="bfloat16"),
        trainable=ADAPTERS_AND_HEAD,
        mixture=(MixtureSet("gsv"), MixtureSet("msls", sampler="geo-visual")),
        validation_size=validation_size(preset, 322),
    )


@register_recipe("megaloc")
def megaloc(model: ModelConfig, preset: str) -> TrainConfig:
    """Make an open recipe for MegaLoc (Berton and Masone 2025), whose code is not published.

    Its paper adds the losses of six sub-batches of 32 places: GSV-Cities, MSLS (cliques),
    MegaScenes, ScanNet, and San Francisco XL twice (EigenPlaces' lateral and frontal classes). Pass
    all or some: `--data gsv=DIR msls=DIR megascenes=DIR scannet=DIR lateral=DIR frontal=DIR`.
    In the paper, a place of MegaScenes or ScanNet is four images with overlapping views; here you
    list these places in a table. Optimiser, trainable parameters and epochs are SALAD's.
    """
    whole = model_of(
        *(model, preset, _vit(model), "salad"),
        head={} if preset == "tiny" else {"cluster_dim": 256},
        **_HALF_FLOATS,
    )
    projection = ProjectionConfig(dim=256 if preset == "tiny" else 8448)
    return dataclasses.replace(
        salad(model, preset),
        model=dataclasses.replace(whole, projection=projection),
        mixture=(
            MixtureSet("gsv"),
            MixtureSet("msls", sampler="cliques"),
            MixtureSet("megascenes", sampler="shuffled"),
            MixtureSet("scannet", sampler="shuffled"),
            MixtureSet("lateral", sampler=Viewpoints()),
            MixtureSet("frontal", sampler=Viewpoints(side="frontal")),
        ),
        places_per_batch=6 * 32,
        validation_size=validation_size(preset, 322),
    )
