"""NetVLAD and Patch-NetVLAD over VGG-16, from Nanne/pytorch-NetVlad and QVPR/Patch-NetVLAD."""

import dataclasses
from typing import Any

from crisalad_jax.data.augmentations import NoAugmentation
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import MiningConfig, OptimiserConfig, TrainConfig
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.pairwise import TripletConfig
from crisalad_jax.training.recipes.base import model_of, register_recipe
from crisalad_jax.training.schedules import MilestonesSchedule, StepSchedule

MARGIN = 0.1**0.5
"""Margin of Euclidean distances: the square root of the code's 0.1 for squared distances."""
_SGD = OptimiserConfig(
    kind="sgd", learning_rate=1e-4, schedule=StepSchedule(epochs=5), weight_decay=1e-3
)


def _model(model: ModelConfig, preset: str, **head: Any) -> ModelConfig:
    """Make NetVLAD's model over VGG-16."""
    return model_of(model, preset, VggConfig(), "netvlad", head=head, image_size=(480, 640))


@register_recipe("netvlad")
def netvlad(model: ModelConfig, preset: str) -> TrainConfig:
    """Make NetVLAD's recipe, from Nanne/pytorch-NetVlad: tuples mined in pitts30k_train.mat.

    The last stage of VGG-16 trains. A batch is 4 tuples of 12 images. Every 1,000 queries, the
    database is described again, and each query takes the 10 hardest of its previous negatives and
    1,000 random ones, if they violate the margin.

    The code's schedule steps before an epoch, not after it, so the first four epochs have the full
    rate. Training stops after more than 10 epochs without gain. The code draws a round's queries
    from a fixed part of the file; here all are shuffled. Its loader processes lose a query's
    previous negatives after each round; the paper reuses them, and so does this recipe.
    """
    return TrainConfig(
        model=_model(model, preset),
        loss=LossConfig(kind=TripletConfig(margin=MARGIN, average="all"), miner="none"),
        optimiser=dataclasses.replace(
            _SGD, schedule=MilestonesSchedule((4, 9, 14, 19, 24, 29), gamma=0.5)
        ),
        trainable="last-1-blocks,head",
        augmentation=NoAugmentation(),
        mining=MiningConfig(kind="whole", negatives=10, margin=MARGIN),
        places_per_batch=4,
        images_per_place=12,
        epochs=30,
        patience=11,
    )


@register_recipe("patch-netvlad")
def patch_netvlad(model: ModelConfig, preset: str) -> TrainConfig:
    """Make the recipe of Patch-NetVLAD's Mapillary weights: NetVLAD's, with 16 clusters, on MSLS.

    Tuples have 5 negatives, the hardest of 1,000 that all queries of a round share. The learning
    rate falls after every fifth epoch.

    The code draws queries with replacement, those at night or sideways more often; here each is
    used in turn. The code leaves out candidates near any query of a round; here, those near the
    tuple's own query. In the code, the sign of inner products lets nearly all queries pass the
    margin test; here all pass. Patch re-ranking learns nothing; `crisalad pca` fits the whitening.
    """
    return dataclasses.replace(
        netvlad(model, preset),
        model=_model(model, preset, **({} if preset == "tiny" else {"clusters": 16})),
        optimiser=_SGD,
        mining=MiningConfig(kind="sample", negatives=5),
        images_per_place=7,
    )


@register_recipe("netvlad-gsv")
def netvlad_gsv(model: ModelConfig, preset: str) -> TrainConfig:
    """Make a recipe of NetVLAD's network and optimiser for places of GSV-Cities.

    Batches, loss and augmentation are CriSALAD's, as for all methods of the paper's Table 1.
    """
    return TrainConfig(
        model=_model(model, preset),
        optimiser=_SGD,
        trainable="last-1-blocks,head",
        epochs=30,
        patience=10,
    )
