"""All formats of public checkpoints, by name.

Names and shapes are those of each family's public code, and of the torch reference in `parity/`,
which can hold any model of this package over DINOv2 or a CNN.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.formats import cnn, heads, vit
from crisalad_jax.checkpoints.formats.cnn import CnnNames
from crisalad_jax.checkpoints.formats.format import (
    Format,
    Head,
    Images,
    Reader,
    State,
    encoder_lines,
)
from crisalad_jax.checkpoints.formats.forms import LINEAR, POINTWISE, Extra, Lines, affine
from crisalad_jax.config.preprocessing import PreprocessingConfig
from crisalad_jax.nn.aggregators import Aggregator
from crisalad_jax.nn.aggregators.backbone_tokens import ClassTokenConfig
from crisalad_jax.nn.aggregators.conv_ap import ConvApConfig
from crisalad_jax.nn.backbones.base import Backbone
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.backbones.vit import ViTConfig
from crisalad_jax.nn.config import ModelConfig

VOCABULARY = "anyloc-words"
"""Name of the format of AnyLoc's vocabularies (Keetha et al., RA-L 2023): the words alone."""
REFERENCE = "reference"
"""Name of the format of our torch reference."""


_NATIVE = PreprocessingConfig(size_rule="native")
# Tensors at a torchvision that does not antialias them unasked: before 0.17.
_PLAIN = PreprocessingConfig(antialias=False, pixels="floats")
_ROUNDED = PreprocessingConfig(pixels="floats", round_to_patch=True)
_BICUBIC = PreprocessingConfig(filter="bicubic", pixels="floats")


_BICUBIC_322, _ROUNDED_322 = (Images((322, 322), chain) for chain in (_BICUBIC, _ROUNDED))
_PLAIN_224, _PLAIN_504 = (Images((side, side), _PLAIN) for side in (224, 504))
# Sides of at most 1,024, and pixels of 0 to 255 less the mean of VGG-16 of MatConvNet, from which
# NetVLAD starts.
_HLOC = PreprocessingConfig(
    size_rule="longer-side",
    filter="area",
    pixels="floats",
    mean=(123.68 / 255, 116.779 / 255, 103.939 / 255),
    deviation=(1 / 255, 1 / 255, 1 / 255),
)
_NATIVE_512 = Images((512, 512), _NATIVE)


_VIT = vit.DINOV2.under("backbone.")
_MODEL_VIT = vit.DINOV2.under("backbone.model.")
_RESNET, _VGG = (ResNetConfig,), (VggConfig,)
_NUMBERED = CnnNames("backbone.", True, (ResNetConfig, VggConfig))
_LU_FENG: dict[str, Any] = {"module": "module.", "under": "model_state_dict"}
"""Where CricaVPR's files, and those of code that began from it, have the state."""


class _ReferenceNames(NamedTuple):
    """The names of any backbone in our torch reference."""

    kinds: tuple[type[Backbone], ...] = (ViTConfig, *_NUMBERED.kinds)
    marks: tuple[str, ...] = _VIT.marks

    def lines(self, config: Any) -> Lines:
        """Yield the table, in the public order."""
        names = _VIT if isinstance(config, ViTConfig) else _NUMBERED
        yield from names.lines(config)

    def infer(self, state: State) -> Backbone:
        """Infer a transformer; of another backbone our files have the configuration."""
        return _VIT.infer(state)


class _Reference(Format):
    """The format of our torch reference, for any head. Our files have their configuration."""

    def accepts(self, config: ModelConfig) -> bool:
        """Return whether it has the backbone."""
        return isinstance(config.backbone, self.backbone.kinds)

    def lines(self, config: ModelConfig) -> Lines:
        """Yield the table, in the public order."""
        yield from self.backbone.lines(config.backbone)
        yield from heads.head_lines(config)
        yield from encoder_lines(config.cross_image)
        if config.projection.dim:
            yield from affine("projection", "projection", LINEAR)


def _infer_reference_head(read: Reader) -> Aggregator:
    """Infer SALAD or a class token; of another head our files have the configuration."""
    salad = heads.SALAD
    return salad.infer(read) if read.has(str(salad.mark)) else ClassTokenConfig()


class _NoBackbone(NamedTuple):
    """A backbone that is in another file."""

    kinds: tuple[type[Backbone], ...] = (Backbone,)
    marks: tuple[str, ...] = ()

    def lines(self, config: Backbone) -> Lines:
        """Yield nothing."""
        return iter(())

    def infer(self, state: State) -> Backbone:
        """Refuse: no file is detected as one."""
        raise NotImplementedError


def _with_squares(state: State, config: ModelConfig) -> ModelConfig:
    """Set MixVPR's image size, whose patches are as many as its rows' numbers."""
    name = "aggregator.row_proj.weight"
    size = cnn.square_image(state, name, config.backbone.patch_size)
    return dataclasses.replace(config, image_size=size)


def _conv_ap_filter(state: State, config: ModelConfig) -> ModelConfig:
    """Set the filter by the README: bicubic for the model of 4,096 numbers alone."""
    assert isinstance(config.aggregator, ConvApConfig)
    name = "bicubic" if config.aggregator.channels == 1024 else "bilinear"
    return dataclasses.replace(config, preprocessing=PreprocessingConfig(filter=name))


def _all_stages(state: State, config: ModelConfig) -> ModelConfig:
    """Set that torchvision's ResNets have all their stages."""
    return dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, stages=4))


def _classifier(layers: Mapping[str, tuple[int, int | None]]) -> Callable[[ModelConfig], Lines]:
    """Return a function that yields torchvision's classifier, whose first layer takes features."""

    def lines(config: ModelConfig) -> Lines:
        for name, (outputs, inputs) in layers.items():
            shape = (outputs, inputs or config.backbone.dim)
            yield Extra(f"classifier.{name}.weight", f"{name}.weight", shape, np.float32)
            yield Extra(f"classifier.{name}.bias", f"{name}.bias", shape[:1], np.float32)

    return lines


def _affine(name: str) -> tuple[str, str]:
    return f"{name}.weight", f"{name}.bias"


# Before DINOv2 comes DINOv3, which has some of its names.
_FORMATS = (
    Format(
        VOCABULARY,
        "AnyLoc c_centers.pt",
        _NoBackbone(),
        heads.ANYLOC,
        adapter=None,
        encoder=None,
        bare=True,
    ),
    Format(
        "boq-dinov2", "BoQ-DINOv2 .pth", vit.DINOV2.under("backbone.dino."), heads.BOQ, _BICUBIC_322
    ),
    Format(
        "boq-resnet50",
        "BoQ-ResNet50 .pth",
        CnnNames("backbone.net.", True, _RESNET),
        heads.BOQ,
        Images((384, 384), _BICUBIC),
    ),
    Format(
        "conv-ap",
        "Conv-AP .ckpt",
        CnnNames("backbone.model.", False, _RESNET),
        heads.CONV_AP,
        Images((320, 320)),
        adjust=_conv_ap_filter,
    ),
    Format("cosplace", "CosPlace and EigenPlaces .pth", _NUMBERED, heads.COSPLACE, _NATIVE_512),
    Format(
        "cricavpr",
        "CricaVPR .pth",
        _VIT,
        heads.GEM_PYRAMID,
        _PLAIN_224,
        adapter="multi-resolution",
        encoder=True,
        **_LU_FENG,
    ),
    Format(
        "mixvpr",
        "MixVPR .ckpt",
        CnnNames("backbone.model.", False, _RESNET),
        heads.MIXVPR,
        adjust=_with_squares,
    ),
    # The chain of its evaluation. Its training validates on Pillow's images.
    Format(
        "dino-mix",
        "DINO-Mix .ckpt",
        vit.DINOV2.under("backbone.dino_model.", norm=None),
        heads.DINO_MIX,
        _PLAIN_224,
        under="state_dict",
    ),
    Format("dino-salad", "DINO-SALAD .ckpt", _MODEL_VIT, heads.SALAD, Images((322, 322))),
    Format("dinov3", "DINOv3 .pth", vit.DINOV3, heads.CLASS_TOKEN),
    Format("dinov2", "DINOv2 .pth", vit.DINOV2, heads.CLASS_TOKEN),
    Format(
        "huggingface-dinov3",
        "Hugging Face DINOv3 .safetensors",
        vit.HUGGING_FACE_DINOV3,
        heads.CLASS_TOKEN,
        stored="safetensors",
    ),
    Format(
        "huggingface",
        "Hugging Face Dinov2 .safetensors",
        vit.HUGGING_FACE,
        heads.CLASS_TOKEN,
        stored="safetensors",
    ),
    Format(
        "edtformer",
        "EDTformer .pth",
        _VIT,
        heads.EDTFORMER,
        _ROUNDED_322,
        first=1,
        adapter="side",
        **_LU_FENG,
    ),
    Format("fol", "FoL .pth", _MODEL_VIT, heads.PUBLISHED_FOL, _PLAIN_504, **_LU_FENG),
    Format(
        "image",
        "ImAge .pth",
        vit.DINOV2.under("backbone.", fields={"position_resize": "plain"}),
        heads.AGGREGATION_TOKENS,
        _ROUNDED_322,
        first=1,
        **_LU_FENG,
    ),
    # Indoor-VPR's files are those of SALAD and EigenPlaces within a module `model`; SALAD's images
    # are prepared in another way.
    Format(
        "salad-indoor",
        "SALAD-indoor .pth",
        vit.DINOV2.under("model.backbone.model."),
        heads.SALAD,
        _ROUNDED_322,
        prefix="model.aggregator.",
    ),
    Format(
        "megaloc",
        "MegaLoc model.safetensors",
        vit.DINOV2.under("backbone.", mask_token=False),
        heads.SALAD,
        _ROUNDED_322,
        prefix="aggregator.agg.",
        projection=_affine("aggregator.linear"),
        stored="safetensors",
    ),
    Format(
        "megaloc-v1",
        "MegaLoc v1 .torch",
        _MODEL_VIT,
        heads.SALAD,
        _ROUNDED_322,
        prefix="aggregator.agg.",
        projection=_affine("aggregator.linear"),
    ),
    Format(
        "netvlad",
        "pytorch-NetVlad .pth.tar",
        CnnNames("encoder.", True, _VGG),
        heads.NETVLAD,
        Images((480, 640), _NATIVE),
        prefix="pool.",
        under="state_dict",
    ),
    Format(
        "netvlad-hloc",
        "NetVLAD .mat, or hloc's .pth",
        CnnNames("backbone.", True, _VGG),
        heads.NETVLAD_HLOC,
        Images((768, 1024), _HLOC),
        projection=_affine("whiten"),
        projection_form=heads.HLOC_WHITENING,
    ),
    Format(
        "patch-netvlad",
        "Patch-NetVLAD WPCA .pth.tar",
        CnnNames("encoder.", True, _VGG),
        heads.NETVLAD,
        Images((480, 640)),
        prefix="pool.",
        projection=_affine("WPCA.0"),
        projection_form=POINTWISE,
        under="state_dict",
    ),
    _Reference(
        REFERENCE,
        "our torch reference",
        _ReferenceNames(),
        Head("any", heads.SALAD.lines, _infer_reference_head, None),
        adapter=None,
        encoder=None,
        under="state_dict",
    ),
    Format(
        "selavpr",
        "SelaVPR .pth",
        _VIT,
        heads.SELAVPR,
        _PLAIN_224,
        adapter="serial-parallel",
        **_LU_FENG,
    ),
    Format(
        "supervlad", "SuperVLAD .pth", _VIT, heads.SUPERVLAD, _ROUNDED_322, encoder=None, **_LU_FENG
    ),
    # From torchvision's ImageNet weights training starts. As a model they are described by the
    # generalised mean of their last features.
    Format(
        "torchvision-resnet",
        "torchvision's ResNet .pth",
        CnnNames("", False, _RESNET),
        heads.WITHOUT_EXPONENT._replace(mark="fc.weight"),
        extras=_classifier({"fc": (1000, None)}),
        adjust=_all_stages,
    ),
    Format(
        "torchvision-vgg",
        "torchvision's VGG-16 .pth",
        CnnNames("features.", True, _VGG),
        heads.WITHOUT_EXPONENT._replace(mark="classifier.0.weight"),
        extras=_classifier(
            {
                "classifier.0": (4096, 512 * 7 * 7),
                "classifier.3": (4096, 4096),
                "classifier.6": (1000, 4096),
            }
        ),
    ),
    Format(
        "transvpr", "TransVPR .pth", cnn.TransVprNames(), heads.TRANSVPR, Images((480, 640), _PLAIN)
    ),
    Format(
        "vlad-buff",
        "VLAD-BuFF .ckpt",
        _MODEL_VIT,
        heads.VLAD_BUFF,
        Images((322, 322)),
        projection=_affine("WPCA_{dim}.0"),
        projection_form=POINTWISE,
        under="state_dict",
    ),
)
FORMATS: dict[str, Format] = {each.name: each for each in _FORMATS}
"""Formats by name, in the order in which they try to detect a state."""
