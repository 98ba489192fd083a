"""Layouts of published place-recognition models, random weights for them, and public outputs.

`layouts/NAME.json` has names and shapes as in the published file; `goldens/NAME.npz` has images and
the outputs of the public code with the weights of `random_state`. The weights of a name depend only
on the name, the shape and the seed.
"""

import json
import pathlib
import re
import zlib

import numpy as np

HERE = pathlib.Path(__file__).parent
ANYLOC = "anyloc_dinov2_vitb14_l9_value_c32"
"""A vocabulary, separate from the backbone's file."""
NAMES = tuple(sorted(path.stem for path in (HERE / "goldens").glob("*.npz") if path.stem != ANYLOC))
SEED = 11
CHANGED: tuple[tuple[str, str, float], ...] = (
    ("^megaloc", r"aggregator\.linear\.bias$", 0.02),
    ("^supervlad", r"aggregation\.conv\.weight$", 100.0),
    ("^cosplace", r"aggregation\.3\.bias$", 0.1),
    ("^cosplace_vgg16|netvlad", r"(backbone|encoder)\.\d+\.weight$", 2**0.5),
    ("netvlad", r"(pool\.conv|score_proj)\.weight$", 100.0),
    ("netvlad", r"(pool\.centroids|netvlad\.centers)$", 0.4),
    ("netvlad", r"(whiten|WPCA\.0)\.bias$", 0.02),
    ("^fol", r"aggregator\.score\.3\.weight$", 5.0),
    ("^sage", r"encoder\.layers\.\d\.self_attn\.(in_proj_bias|out_proj\.bias)$", 0.02),
    ("^selavprpp", r"linear[24]\.bias$", 0.05),
    ("^sfrs", r"base_model\.base\.\d+\.weight$", 2**0.5),
    ("^sfrs", r"net_vlad\.conv\.weight$", 100.0),
    ("^sfrs", r"net_vlad\.centroids$", 0.4),
    ("^sfrs", r"pca_layer\.bias$", 0.02),
    ("^apgem", r"layer\d\.\d+\.bn3\.(weight|bias)$", 0.3),
    ("^apgem", r"^mean_$", 0.05),
    ("^anyloc", r"c_centers$", 0.36),
    ("^transvpr", r"pool\.fc\.1\.bias$", 0.1),
    ("^vladbuff", r"aggregator\.conv\.weight$", 100.0),
    ("^vladbuff", r"aggregator\.(centroids|pca_mean)$", 0.5),
    ("^vladbuff", r"WPCA_\d+\.0\.bias$", 0.02),
)
"""Weights with another scale than the rest: a pattern of models, one of names, and a factor. They
make a descriptor depend on the image more than on a bias."""
POSITIVE = ("^apgem", r"^explained_variance_$", 0.005)
"""Like `CHANGED`, for variances: positive, as large as the draws plus a little."""
FIXED = {
    r"(aggregation(_hashing)?\.1|adpool)\.p$": 3.0,
    r"aggregator\.ab_params$": (8.0, 7.0, 1.0),
}
"""Fixed weights by a pattern of names: GeM's exponent, VLAD-BuFF's constants."""


def layout(name: str) -> dict[str, tuple[int, ...]]:
    """Return the shapes by name; "outer/inner" is a name within the file's dictionary `outer`."""
    shapes = json.loads((HERE / "layouts" / f"{name}.json").read_text(encoding="utf-8"))
    return {key: tuple(shape) for key, shape in shapes.items()}


def random_vocabulary(seed: int = SEED) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return AnyLoc's random words, and the backbone's random weights by name."""
    words = _array(ANYLOC, "c_centers", layout(ANYLOC)["c_centers"], seed)
    path = HERE.parent / "layouts" / "dinov2_vitb14.json"
    shapes = json.loads(path.read_text(encoding="utf-8"))
    return words, {key: _array("dinov2", key, tuple(s), seed) for key, s in shapes.items()}


def golden(name: str) -> dict[str, np.ndarray]:
    """Return the images and the public code's outputs."""
    with np.load(HERE / "goldens" / f"{name}.npz") as file:
        return dict(file)


def random_state(name: str, seed: int = SEED) -> dict[str, np.ndarray]:
    """Return random weights by name, without outer dictionaries' names and torch's `module.`."""
    shapes = {key.rpartition("/")[2]: shape for key, shape in layout(name).items()}
    arrays = {key: _array(name, key, shape, seed) for key, shape in shapes.items()}
    return {key.removeprefix("module."): array for key, array in arrays.items()}


def _array(model: str, key: str, shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Draw an array so that activations stay finite through many layers."""
    generator = np.random.default_rng([seed, zlib.crc32(key.encode())])
    last = key.rpartition(".")[2]
    if last == "num_batches_tracked":
        return np.array(3, np.int64)
    if last == "running_var":
        return (generator.random(shape) + 0.5).astype(np.float32)
    array = generator.standard_normal(shape)
    if "gamma" in last:
        array = 0.3 + 0.1 * array
    elif last == "weight" and len(shape) == 1:
        array = 1 + 0.2 * array
    elif len(shape) > 1 and ("weight" in last or "in_proj" in last):
        array *= int(np.prod(shape[1:])) ** -0.5
    else:
        array *= 0.1
    for models, names, factor in CHANGED:
        if re.search(models, model) and re.search(names, key):
            array *= factor
    models, names, factor = POSITIVE
    if re.search(models, model) and re.search(names, key):
        array = factor * (0.05 + abs(array))
    for names, value in FIXED.items():
        if re.search(names, key):
            array = np.full(shape, value)
    return array.astype(np.float32)
