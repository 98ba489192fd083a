"""The table of published models against the layouts of their files."""

import dataclasses
import functools
import json
import pathlib
import re
from typing import Any
from urllib.parse import urlsplit

import jax
import numpy as np
import pytest

from crisalad_jax.checkpoints.formats import FORMATS, VOCABULARY, infer, public_shapes
from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.public import vocabulary_model
from crisalad_jax.checkpoints.published import PUBLISHED, published_model
from crisalad_jax.nn.backbones.dinov3 import DinoV3Config, rotary_periods
from crisalad_jax.nn.backbones.resnet import ResNetConfig
from crisalad_jax.nn.backbones.vgg import VggConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import parameter_shapes
from crisalad_jax.training.recipes import recipe
from crisalad_jax.utils.errors import InputError
from tests.random_checkpoints import bare_vit, blank

PARITY = pathlib.Path(__file__).parents[2] / "parity"
# The stored names and shapes of published files, by the models that have them.
STORED = {
    **{name: f"layouts/{name.replace('-', '_')}" for name in PUBLISHED if "dinov2-vit" in name},
    "salad": "layouts/dino_salad",
    "cricavpr": "layouts/CricaVPR",
    "salad-cm": "zoo/layouts/salad_cm",
    "megaloc": "zoo/layouts/megaloc",
    "megaloc-v1": "zoo/layouts/megaloc_v1_torch",
    "boq-dinov2": "zoo/layouts/boq_dinov2_12288",
    "boq-resnet50": "zoo/layouts/boq_resnet50_16384",
    "dino-mix": "zoo/layouts/dinomix_vitb14",
    "supervlad": "zoo/layouts/supervlad",
    "supervlad-crossimage": "zoo/layouts/supervlad_crossimage",
    "supervlad-1-cluster": "zoo/layouts/supervlad",
    "cosplace-vgg16-512": "zoo/layouts/cosplace_vgg16_512",
    "cosplace-resnet18-512": "zoo/layouts/cosplace_resnet18_512",
    "cosplace-resnet50-2048": "zoo/layouts/cosplace_resnet50_2048",
    "mixvpr-4096": "zoo/layouts/mixvpr_resnet50_4096",
    "conv-ap-4096": "zoo/layouts/convap_resnet50_4096",
    "netvlad-nanne": "zoo/layouts/netvlad_vgg16_nanne",
    "netvlad-hloc": "zoo/layouts/netvlad_vgg16_hloc",
    "netvlad-hloc-tokyo": "zoo/layouts/netvlad_vgg16_hloc",
    "ap-gem-resnet101": "zoo/layouts/apgem_resnet101",
    "ap-gem-resnet101-lm18": "zoo/layouts/apgem_resnet101",
    "sage-vitb14": "zoo/layouts/sage_vitb14",
    "sage-vitl14": "zoo/layouts/sage_vitl14",
    "sage-vitl14-crossimage": "zoo/layouts/sage_vitl14_crossimage",
    **{
        f"selavprpp-vit{size[0]}14{kind}": f"zoo/layouts/selavprpp_{size}{kind.replace('-', '_')}"
        for size in ("base", "large")
        for kind in ("", "-rerank")
    },
    "sfrs": "zoo/layouts/sfrs_vgg16_pca4096",
    "pairvpr-vitb14": "zoo/layouts/pairvpr_vitb",
    "patch-netvlad-mapillary-4096": "zoo/layouts/patchnetvlad_mapillary_WPCA4096",
    "patch-netvlad-pittsburgh-512": "zoo/layouts/patchnetvlad_pittsburgh_WPCA512",
    "tetra-boq": "zoo/layouts/tetra_boq",
    "tetra-salad": "zoo/layouts/tetra_salad",
    "transvpr-msls": "zoo/layouts/transvpr",
    "transvpr-pitts30k": "zoo/layouts/transvpr",
    "edtformer": "zoo/layouts/edtformer",
    "image": "zoo/layouts/image_merged",
    "image-gsv": "zoo/layouts/image_merged",
    "vlad-buff-8192": "zoo/layouts/vladbuff_192_wpca4096",
    "vlad-buff-4096": "zoo/layouts/vladbuff_192_wpca4096",
    "selavpr-msls": "zoo/layouts/selavpr",
    "selavpr-pitts30k": "zoo/layouts/selavpr",
    **{
        name: "zoo/layouts/cosplace_resnet50_2048"
        if "eigenplaces" in name
        else "layouts/dino_salad"
        for name in PUBLISHED
        if "-indoor-" in name
    },
    "fol-large": "zoo/layouts/fol_vitl14",
    "fol-base": "zoo/layouts/fol_vitb14",
}
CHANGED: dict[str, dict[str, tuple[int, ...] | None]] = {
    # The README's one cluster and two ghosts.
    "supervlad-1-cluster": {"aggregation.conv.weight": (3, 768, 1, 1)},
    # Without a projection of features; 8,192 components of 64 x 768.
    "vlad-buff-8192": {
        "aggregator.pca_mean": None,
        "aggregator.pca_rot": None,
        "aggregator.centroids": (64, 768),
        "aggregator.conv.weight": (64, 768, 1, 1),
        "WPCA_4096.0.weight": None,
        "WPCA_4096.0.bias": None,
        "WPCA_8192.0.weight": (8192, 49152, 1, 1),
        "WPCA_8192.0.bias": (8192,),
    },
}
"""Shapes that differ from the stored ones; None has no such name."""
SIZED = {
    **{
        f"mixvpr-{c * r}": ("mixvpr-4096", {"channels": c, "rows": r})
        for c, r in ((64, 2), (256, 2))
    },
    **{f"conv-ap-{4 * c}": ("conv-ap-4096", {"channels": c}) for c in (128, 512, 2048)},
}
"""Models without stored shapes: the ones that they resemble, and the settings of their heads."""


VGG_MEAN = (123.68, 116.779, 103.939)
"""MatConvNet's mean of red, green and blue for VGG-16, of pixels from 0 to 255."""
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
FROM_255 = (tuple(value / 255 for value in VGG_MEAN), (1 / 255,) * 3)

_BYTES = ("bilinear", True, "bytes", False, IMAGENET)
_PLAIN = ("bilinear", False, "floats", False, IMAGENET)
_WRAPPER = ("bilinear", True, "floats", True, IMAGENET)
_BICUBIC = ("bicubic", True, "floats", False, IMAGENET)
PREPROCESSING: dict[str, tuple[Any, ...]] = {
    # Backbones alone have no chain of place recognition: the library's default.
    "dinov2": ((224, 224), "fixed", *_BYTES),
    "dinov3": ((224, 224), "fixed", *_BYTES),
    # serizba/salad eval.py and cliquemining: Resize of Pillow's image, ToTensor, Normalize.
    "dino-salad": ((322, 322), "fixed", *_BYTES),
    # OliverGrainge/TeTRA-VPR: the same.
    "tetra-boq": ((322, 322), "fixed", *_BYTES),
    "tetra-salad": ((322, 322), "fixed", *_BYTES),
    # csiro-robotics/Pair-VPR: the same.
    "pair-vpr": ((322, 322), "fixed", *_BYTES),
    # Ahmedest61/VLAD-BuFF eval.py, input_transform: the same.
    "vlad-buff": ((322, 322), "fixed", *_BYTES),
    # amaralibey/MixVPR and gsv-cities, their data loaders; Conv-AP's demo.py of 4,096 is bicubic.
    "mixvpr": ((320, 320), "fixed", *_BYTES),
    "conv-ap": ((320, 320), "fixed", *_BYTES),
    "conv-ap-4096": ((320, 320), "fixed", "bicubic", True, "bytes", False, IMAGENET),
    # QVPR/Patch-NetVLAD: Resize of Pillow's image.
    "patch-netvlad": ((480, 640), "fixed", *_BYTES),
    # gmberton/CosPlace and EigenPlaces, Indoor-VPR, Nanne/pytorch-NetVlad, AP-GeM: not resized.
    "ap-gem": ((512, 512), "native", *_BYTES),
    "cosplace": ((512, 512), "native", *_BYTES),
    "netvlad": ((480, 640), "native", *_BYTES),
    # amaralibey/Bag-of-Queries: the tensor is resized, bicubic and antialiased.
    "boq-dinov2": ((322, 322), "fixed", *_BICUBIC),
    "boq-resnet50": ((384, 384), "fixed", *_BICUBIC),
    # gmberton/VPR-methods-evaluation: the tensor is resized antialiased, and again to multiples.
    "megaloc": ((322, 322), "fixed", *_WRAPPER),
    "megaloc-v1": ((322, 322), "fixed", *_WRAPPER),
    "salad-indoor": ((322, 322), "fixed", *_WRAPPER),
    "supervlad": ((322, 322), "fixed", *_WRAPPER),
    "edtformer": ((322, 322), "fixed", *_WRAPPER),
    # Lu-Feng/ImAge: its torchvision, 0.21, antialiases tensors by default.
    "image": ((322, 322), "fixed", *_WRAPPER),
    # datasets_ws.py of Lu-Feng/CricaVPR and SelaVPR (torchvision 0.15.0) and of chenshunpeng/FoL
    # (0.15.1): tensors, which these do not antialias unless asked.
    "cricavpr": ((224, 224), "fixed", *_PLAIN),
    "selavpr": ((224, 224), "fixed", *_PLAIN),
    "fol": ((504, 504), "fixed", *_PLAIN),
    # Lu-Feng/SelaVPRplusplus names no antialias and pins no torchvision: today's.
    "selavprpp": ((322, 322), "fixed", *_WRAPPER),
    "selavprpp-hash": ((322, 322), "fixed", *_WRAPPER),
    # chenshunpeng/SAGE (torchvision 0.16): tensors, not antialiased.
    "sage": ((322, 322), "fixed", *_PLAIN),
    # GaoShuang98/DINO-Mix, eval_files (torchvision 0.14.1), and TransVPR's code of 2022: the same.
    "dino-mix": ((224, 224), "fixed", *_PLAIN),
    "transvpr": ((480, 640), "fixed", *_PLAIN),
    # cvg/Hierarchical-Localization: OpenCV's INTER_AREA; pixels of 0 to 255 less a mean.
    "netvlad-hloc": ((768, 1024), "longer-side", "area", True, "floats", False, FROM_255),
    # yxgeee/OpenIBL: Resize of Pillow's image; pixels of 0 to 255 less the same mean.
    "sfrs": ((480, 640), "fixed", *_BYTES[:-1], FROM_255),
    # Ours: the demo of AnyLoc crops to multiples of 14 where we resize (docs/resizing.md).
    VOCABULARY: ((224, 224), "native", "bilinear", True, "floats", False, IMAGENET),
}
"""By name or else layout: size, rule, filter, antialias, pixels, round, (mean, deviation)."""


@functools.cache
def stored(name: str) -> tuple[str, ModelConfig]:
    """The layout and configuration of a published file."""
    shapes = json.loads((PARITY / f"{STORED[name]}.json").read_text(encoding="utf-8"))
    plain = {key.rpartition("/")[2].removeprefix("module."): shapes[key] for key in shapes}
    if "-indoor-" in name:  # another file's names, within a module `model`
        plain = {f"model.{key}": shape for key, shape in plain.items()}
    plain |= CHANGED.get(name, {})
    plain = {key: shape for key, shape in plain.items() if shape is not None}
    return infer(blank(plain), source=name)


def parameters(config: ModelConfig) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(parameter_shapes(config)))


@pytest.mark.parametrize(
    ("name", "published"),
    [
        *((name, name) for name in ("salad", "cricavpr", "dino-mix", "supervlad", "edtformer")),
        *(("boq", "boq-dinov2"), ("boq-resnet50", "boq-resnet50"), ("image", "image-gsv")),
        *(("vlad-buff", "vlad-buff-4096"), ("mixvpr", "mixvpr-4096"), ("conv-ap", "conv-ap-4096")),
        *(("cosplace", "cosplace-resnet18-512"), ("eigenplaces-turns", "cosplace-resnet18-512")),
    ],
)
def test_a_recipes_model_resizes_as_the_published_weights_do(name: str, published: str) -> None:
    """The published ones are held to each author's code by the test of their images below."""
    assert recipe("b14", name).model.preprocessing == stored(published)[1].preprocessing


def test_names_say_the_length_of_descriptors():
    families = ("cosplace-", "eigenplaces-")
    of_family = [n for n in PUBLISHED if n.startswith(families) and "-indoor-" not in n]
    assert len(of_family) == 30 + 11
    of_family += [n for n in PUBLISHED if n.startswith("patch-netvlad-")]
    for name in of_family:
        assert published_model(name).descriptor == int(name.rpartition("-")[2])


def test_anylocs_vocabularies_have_their_backbone():
    for name, model in PUBLISHED.items():
        assert bool(model.backbone) == (model.format == VOCABULARY) == name.startswith("anyloc-")
        if model.backbone:
            depth = stored(model.backbone)[1].backbone.depth
            # The file's name has 31, counted from 0.
            assert inferred(name)[1].aggregator.features(depth).levels == (32,)


def resized(name: str, **settings: Any) -> tuple[str, ModelConfig]:
    """The layout and configuration inferred from a file like a stored one, with other parts."""
    layout, config = stored(name)
    config = dataclasses.replace(config, **settings)
    return infer(blank(public_shapes(config, layout)), source=name)


@functools.cache
def inferred(name: str) -> tuple[str, ModelConfig]:
    """The layout and configuration of a published model by its shapes."""
    model = published_model(name)
    if name in STORED:
        return stored(name)
    if name in SIZED:
        like, settings = SIZED[name]
        head = stored(like)[1].aggregator
        return resized(like, aggregator=dataclasses.replace(head, **settings))
    if model.format == "patch-netvlad":
        like = "mapillary-4096" if "mapillary" in name else "pittsburgh-512"
        whitening = stored(f"patch-netvlad-{like}")[1].projection
        return resized(
            f"patch-netvlad-{like}",
            projection=dataclasses.replace(whitening, dim=model.descriptor),
        )
    if model.format == "cosplace":
        layers = re.search(r"resnet(\d+)", name)
        backbone = ResNetConfig(layers=int(layers[1])) if layers else VggConfig()
        head = dataclasses.replace(
            stored("cosplace-resnet50-2048")[1].aggregator, dim=model.descriptor
        )
        return resized("cosplace-resnet50-2048", backbone=backbone, aggregator=head)
    if model.format == VOCABULARY:
        words = np.broadcast_to(np.float32(0), (32, 1536))
        return VOCABULARY, vocabulary_model(len(words), stored(model.backbone)[1], {})
    assert model.format == "dinov3"
    # The chain is the same for all sizes.
    backbone = DinoV3Config(adapter="none")
    alone = dataclasses.replace(bare_vit(), backbone=backbone)
    state = blank(public_shapes(alone, "dinov3"))
    periods = rotary_periods(alone.backbone.dim // alone.backbone.heads)
    return infer(state | {"rope_embed.periods": periods.astype(np.float32)}, source=name)


FIRST = {published_model(name).format: name for name in reversed(PUBLISHED)}
"""The first model of each format; the others take minutes in all."""


# DINOv3's are checked beside transformers, in parity/test_dinov3.py.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in FIRST.values() else pytest.mark.slow)
        for name in PUBLISHED
        if not name.startswith("dinov3-")
    ],
)
def test_a_models_facts_are_those_of_its_file(name):
    model, (layout, config) = published_model(name), inferred(name)
    found = (model.format, model.descriptor, model.parameters)
    assert found == (layout, config.descriptor_dim, parameters(config))


@pytest.mark.parametrize("name", PUBLISHED)
def test_images_are_prepared_as_the_authors_do(name):
    _, config = inferred(name)
    chain = config.preprocessing
    found = (
        config.image_size,
        chain.size_rule,
        chain.filter,
        chain.antialias,
        chain.pixels,
        chain.round_to_patch,
        (chain.mean, chain.deviation),
    )
    assert found == PREPROCESSING.get(name, PREPROCESSING[published_model(name).format])
    assert chain.normalisation == "mean-deviation"


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_models_words_are_those_of_its_chain(name):
    _, config = inferred(name)
    chain = config.preprocessing
    if chain.size_rule == "native":
        multiple = config.side_multiple
        words = "any, not resized" if multiple == 1 else f"any, to multiples of {multiple}"
    else:
        words = chain.in_words(config.image_size).split(",")[0]
    if chain.size_rule != "native" or config.side_multiple > 1:
        words += f", {chain.filter}"
        words += " (Pillow)" if chain.pixels == "bytes" else ""
        words += "" if chain.antialias else ", not antialiased"
    assert published_model(name).images == words


def test_the_table_is_sound():
    for name, model in PUBLISHED.items():
        assert model.name == name
        assert re.fullmatch("[a-z0-9][a-z0-9-]*", name)
        assert model.format in FORMATS
        assert urlsplit(model.repository).scheme == "https"
        assert model.url is None or urlsplit(model.url).scheme == "https"
        assert model.url is not None or model.note
        # In a model's folder of the cache stand both this file and the weights made of it.
        assert pathlib.PurePath(model.file).name == model.file != f"{name}.safetensors"
    files = [model.file for model in PUBLISHED.values()]
    assert len(set(files)) == len(files)  # a mirror has them in one folder
    urls = [model.url for model in PUBLISHED.values() if model.url is not None]
    assert len(set(urls)) == len(urls)


@pytest.mark.parametrize(
    ("asked", "nearest"),
    [
        ("megalok", "^megaloc, megaloc-v1"),
        ("MegaLoc", "^megaloc, megaloc-v1"),
        ("supervlad-cross-image", "^supervlad-crossimage, "),
        ("startr", r"\bstarter\b"),  # of the package
        ("cliquemining", r"\bsalad-cm\b"),  # the name of its file
        ("hloc", r"\bnetvlad-hloc\b"),  # a part of a name
        ("Indoor-VPR", r"\bsalad-indoor-gb1-10-25\b"),  # a repository
        ("cosplace", r"^cosplace-resnet50-2048\b"),  # a family: its longest descriptors
    ],
)
def test_an_unknown_name_is_told_with_the_nearest(asked: str, nearest: str) -> None:
    for look_up in (published_model, find_weights, lambda name: find_weights(f"{name}.pth")):
        with pytest.raises(InputError, match=f"^{asked}.*: found no ") as error:
            look_up(asked)
        assert re.search(nearest, str(error.value).partition("nearest: ")[2])


def test_a_name_like_no_other_has_no_nearest():
    with pytest.raises(InputError, match=r"expected one of `crisalad models`$"):
        published_model("zzz")
