"""Frozen configurations: what a model is, how it trains, the presets, and their validation.

Every field is hashable: a configuration is a static argument of jit and names a compiled program.
The values of the presets are the paper's (Xu et al., Appl. Sci. 2025, 15, 5287, section 4.2) unless
a comment says otherwise.
"""

from crisalad_jax.config.aggregators import (
    PYRAMID_LEVELS as PYRAMID_LEVELS,
)
from crisalad_jax.config.aggregators import (
    AnyLocConfig as AnyLocConfig,
)
from crisalad_jax.config.aggregators import (
    BoqConfig as BoqConfig,
)
from crisalad_jax.config.aggregators import (
    ClassTokenConfig as ClassTokenConfig,
)
from crisalad_jax.config.aggregators import (
    ConvApConfig as ConvApConfig,
)
from crisalad_jax.config.aggregators import (
    CosPlaceConfig as CosPlaceConfig,
)
from crisalad_jax.config.aggregators import (
    CrossImageConfig as CrossImageConfig,
)
from crisalad_jax.config.aggregators import (
    GemConfig as GemConfig,
)
from crisalad_jax.config.aggregators import (
    GemPyramidConfig as GemPyramidConfig,
)
from crisalad_jax.config.aggregators import (
    MixVprConfig as MixVprConfig,
)
from crisalad_jax.config.aggregators import (
    NetVladConfig as NetVladConfig,
)
from crisalad_jax.config.aggregators import (
    SaladConfig as SaladConfig,
)
from crisalad_jax.config.aggregators import (
    SinkhornConfig as SinkhornConfig,
)
from crisalad_jax.config.aggregators import (
    TokenShape as TokenShape,
)
from crisalad_jax.config.aggregators import (
    TransVprConfig as TransVprConfig,
)
from crisalad_jax.config.backbone import ADAPTERS as ADAPTERS
from crisalad_jax.config.backbone import PATCH_SIZE as PATCH_SIZE
from crisalad_jax.config.backbone import AdapterConfig as AdapterConfig
from crisalad_jax.config.backbone import ViTConfig as ViTConfig
from crisalad_jax.config.checks import choose as choose
from crisalad_jax.config.losses import CircleConfig as CircleConfig
from crisalad_jax.config.losses import ContrastiveConfig as ContrastiveConfig
from crisalad_jax.config.losses import FastAPConfig as FastAPConfig
from crisalad_jax.config.losses import LargeMarginCosineConfig as LargeMarginCosineConfig
from crisalad_jax.config.losses import LossConfig as LossConfig
from crisalad_jax.config.losses import MultiSimilarityConfig as MultiSimilarityConfig
from crisalad_jax.config.losses import SupConConfig as SupConConfig
from crisalad_jax.config.losses import TripletConfig as TripletConfig
from crisalad_jax.config.model import AGGREGATORS as AGGREGATORS
from crisalad_jax.config.model import ModelConfig as ModelConfig
from crisalad_jax.config.model import check_image_size as check_image_size
from crisalad_jax.config.recipes import PRESETS as PRESETS
from crisalad_jax.config.recipes import RECIPES as RECIPES
from crisalad_jax.config.recipes import from_scratch as from_scratch
from crisalad_jax.config.recipes import recipe as recipe
from crisalad_jax.config.training import AugmentConfig as AugmentConfig
from crisalad_jax.config.training import LightAugmentConfig as LightAugmentConfig
from crisalad_jax.config.training import OptimiserConfig as OptimiserConfig
from crisalad_jax.config.training import RandAugmentConfig as RandAugmentConfig
from crisalad_jax.config.training import TrainConfig as TrainConfig
