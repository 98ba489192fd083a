"""SelaVPR, as Lu-Feng/SelaVPR trains it (Lu et al., ICLR 2024)."""

import dataclasses

from crisalad_jax.data.augmentations import NoAugmentation
from crisalad_jax.losses import LossConfig
from crisalad_jax.losses.pairwise import SelaVprLoss
from crisalad_jax.nn.adapter import AdapterConfig
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.training.config import MiningConfig, OptimiserConfig, TrainConfig
from crisalad_jax.training.recipes.base import register_recipe, with_resizing
from crisalad_jax.training.recipes.crisalad import without_encoder


@register_recipe("selavpr")
def selavpr(model: ModelConfig, preset: str) -> TrainConfig:
    """Make SelaVPR's recipe, of preset l14 as published: tuples mined in MSLS.

    4 tuples of a query, a positive and 2 negatives make a batch; the loss compares descriptors and
    local features. An epoch has 30,000 queries, in rounds of 1,000. For Pitts30k, which follows
    from the weights of MSLS, it has 5,000: `--mining.queries-per-epoch 5000`. The code validates
    with re-ranking, here without.
    """
    backbone = dataclasses.replace(model.backbone, adapter=AdapterConfig(kind="serial-parallel"))
    mining = MiningConfig(kind="sample", negatives=2, queries_per_epoch=30_000)
    config = TrainConfig(
        model=without_encoder(
            model, backbone=backbone, aggregator=AGGREGATORS.make("selavpr", preset)
        ),
        loss=LossConfig(kind=SelaVprLoss(), miner="none"),
        optimiser=OptimiserConfig(
            kind="adam", learning_rate=1e-5, end_lr_fraction=1.0, weight_decay=0.0
        ),
        augmentation=NoAugmentation(),
        mining=mining,
        places_per_batch=4,
        images_per_place=2 + mining.negatives,
        epochs=50,
        patience=3,
    )
    return with_resizing(config, antialias=False, pixels="floats")
