"""Vocabularies, and initial values of heads such as NetVLAD: k-means centroids of features.

The k-means of unit features is Euclidean, as in VLAD (Jegou et al. 2010) and NetVLAD's
initialisation, or by angle, as in AnyLoc's public code. A centroid is the mean of the features
nearest to it, not a unit vector.
"""

import dataclasses
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32

from crisalad_jax.checkpoints.public import with_backbone_of
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.config.checks import check_count, check_seed, require
from crisalad_jax.config.short_repr import brief
from crisalad_jax.data.images import OnBadImage
from crisalad_jax.data.prepare import Preparation
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.sources import check_frames, open_source
from crisalad_jax.nn.aggregators import AGGREGATORS
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Crisalad, Model, cast_params, init_crisalad, unit_features
from crisalad_jax.retrieval.chunks import sample
from crisalad_jax.training.recipes import RECIPES, mines_tuples, recipe
from crisalad_jax.utils import compiler
from crisalad_jax.utils.devices import devices_for
from crisalad_jax.utils.files import check_target
from crisalad_jax.utils.output import warn
from crisalad_jax.utils.progress import progress_bar

IMAGES = 500
"""Largest number of images to read: with 100 patches of each, the 50,000 features of NetVLAD's
public code."""
PATCHES = 100
"""Largest number of patches to take from an image."""
_ROUNDS = 100
"""Largest number of rounds of k-means, which converges earlier."""


def with_vocabulary(
    model: Model,
    paths: Sequence[pathlib.Path],
    *,
    images: int | None = IMAGES,
    seed: int = 0,
    batch_size: int = 16,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = True,
) -> Crisalad:
    """Fit a model's centroids to the features that its own backbone extracts from images.

    The same arguments give bit-identical results on the same machine. NetVLAD's scores start from
    the centroids too (`netvlad.from_centroids`). AnyLoc's vocabulary is bound to its backbone:
    loading it with another one raises an error.

    Args:
        model: a model with its final backbone, or the one that training starts from, and an
            aggregator that starts from centroids.
        paths: images; not those used for evaluation.
        images: maximum number, drawn at random; None for all, if their features fit in memory.
        seed: seed for drawing images, up to `PATCHES` patches of each, and first centroids.
        batch_size: number of images described at a time.
        on_bad_image: "stop", or "skip" to leave unreadable images out.
        quiet: whether to hide the progress bar.

    Returns:
        The parameters with the centroids.

    Raises:
        InputError: the aggregator has no vocabulary; an argument is out of range; an image (with
            "skip", every image) cannot be read; there are fewer features than clusters or than
            VLAD-BuFF's principal components; or features are not finite, or all equal.
    """
    params, config = model
    aggregator = config.aggregator
    _check_vocabulary(config)
    check_seed("seed", seed)
    if images is not None:
        check_count("images", images)
        if images < len(paths):
            paths = [paths[i] for i in sample(len(paths), images, seed)]
    clusters = aggregator.count_centroids(config.backbone.dim)
    most = len(paths) * min(PATCHES, config.grid[0] * config.grid[1])
    require(
        most >= clusters,
        f"images: found {len(paths)}, which is {most} features, expected at least {clusters}, one "
        "for each cluster",
    )
    reading = Reading(batch_size=batch_size, on_bad_image=on_bad_image).fitted(len(paths))
    by_image = _read_features(model, paths, reading, seed, quiet=quiet)
    features = np.concatenate([np.empty((0, config.backbone.dim), np.float32), *by_image])
    require(
        len(features) >= clusters and bool(np.isfinite(features).all()),
        f"images: found {len(features)} features in those that can be read, expected at least "
        f"{clusters}, one for each cluster, without NaN or infinity",
    )
    with compiler.number_types():
        there = jnp.asarray(features)
        reduced = np.asarray(aggregator.centroid_features(there))
        if config.backbone.binary:
            means = k_majority(reduced, clusters, seed)
        else:
            means = _k_means(reduced, clusters, seed, spherical=aggregator.spherical_centroids)
        learnt = aggregator.from_centroids(jnp.asarray(means), there)
        learnt = aggregator.with_frequencies(learnt, by_image)
    return dataclasses.replace(params, aggregator=learnt)


@brief
class Vocabulary(NamedTuple):
    """A model whose vocabulary was built."""

    params: Crisalad
    """The model's parameters, with the vocabulary."""
    words: int
    """Number of centroids."""
    images: int
    """Number of images selected to extract features from."""


def start_vocabulary(
    aggregator: str = "anyloc",
    preset: str = "b14",
    *,
    backbone: str | os.PathLike[str] | None = None,
    fields: Mapping[str, Any] | None = None,
    image_size: tuple[int, int] | None = None,
    resize: Sequence[str] = (),
    seed: int = 0,
) -> Model:
    """Make a model that lacks only its vocabulary.

    Args:
        aggregator: a registered aggregator that starts from centroids, or a recipe with one.
        preset: the size of the model.
        backbone: a checkpoint from which the backbone is taken; None is a random one.
        fields: settings of the aggregator that differ from the preset's, by name.
        image_size: height and width in pixels; None is the preset's.
        resize: values that change how images are resized; see `ModelConfig.resized`.
        seed: random seed.

    Returns:
        The model.

    Raises:
        InputError: the preset or aggregator does not exist; the aggregator has no vocabulary, or
            lacks one of `fields`; or the checkpoint cannot be read or is of another size.
    """
    # A recipe that mines has another backbone than the preset's: for NetVLAD the head is meant.
    is_head = aggregator in AGGREGATORS and mines_tuples(aggregator)
    own = aggregator in RECIPES and not is_head
    config = recipe(preset, aggregator if own else f"crisalad+{aggregator}").model
    part = config.aggregator
    _check_vocabulary(config)
    known = [field.name for field in dataclasses.fields(part)]
    for name in fields or {}:
        require(
            name in known,
            f"--{name}: found with --aggregator {part.part_name}, which has no such setting, "
            f"expected one of {', '.join(known) or 'none'}",
        )
    part = dataclasses.replace(part, **(fields or {}))
    config = dataclasses.replace(config, aggregator=part).resized(image_size, resize)
    params = init_crisalad(jax.random.key(seed), config)
    if backbone is not None:
        params = with_backbone_of(params, config, backbone)
    return Model(params, config)


def build_vocabulary(
    model: Model,
    images: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    fps: float | None = None,
    topic: str | None = None,
    max_images: int = IMAGES,
    seed: int = 0,
    batch_size: int = 16,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = False,
) -> Vocabulary:
    """Build the vocabulary of a model from a folder of images, and write the model.

    Args:
        model: a model with its final backbone and an aggregator that starts from centroids.
        images: the folder, searched with its subfolders, or another source of images
            (docs/how-to/image-sources.md), or a list of files; not images used for evaluation.
        out: the .safetensors file to write.
        fps: frames per second, if `images` is a video or log; None is 1.
        topic: the image topic of a robot log; None takes the only one.
        max_images: largest number of images to read, drawn at random.
        seed: random seed, as in `with_vocabulary`.
        batch_size: number of images described at a time.
        on_bad_image: "stop" at an unreadable image, or "skip" it.
        quiet: whether to hide the progress bar.

    Returns:
        The parameters, and the numbers of centroids and images.

    Raises:
        InputError: the aggregator has no vocabulary; images are too few or cannot be read; or `out`
            cannot be written.

    Example:
        >>> import jax
        >>> from crisalad_jax import PRESETS, init_crisalad, with_aggregator
        >>> config = with_aggregator(PRESETS["tiny"], "anyloc", "tiny", cross_image="none")
        >>> model = Model(init_crisalad(jax.random.key(0), config), config)
        >>> out = folder / "anyloc.safetensors"
        >>> built = build_vocabulary(model, pictures, out, quiet=True)
        >>> out.exists()
        True
    """
    check_target(out, ".safetensors")
    if isinstance(images, str | os.PathLike):
        paths = open_source(images, fps=fps, topic=topic, on_bad_image=on_bad_image).paths
    else:
        paths = [pathlib.Path(each) for each in images]
    check_frames(paths, fps=fps, topic=topic)
    params = with_vocabulary(
        model,
        paths,
        images=max_images,
        seed=seed,
        batch_size=batch_size,
        on_bad_image=on_bad_image,
        quiet=quiet,
    )
    save_weights(out, Model(params, model.config))
    words = model.config.aggregator.count_centroids(model.config.backbone.dim)
    return Vocabulary(params, words, min(max_images, len(paths)))


def _check_vocabulary(config: ModelConfig) -> None:
    has_one = [name for name in AGGREGATORS if AGGREGATORS.make(name).starts_from_centroids]
    require(
        config.aggregator.starts_from_centroids,
        f"aggregator: found {config.aggregator.part_name}, which has no vocabulary, expected "
        f"one that starts from centroids: {', '.join(has_one)}",
    )


def _read_features(
    model: Model, paths: Sequence[pathlib.Path], reading: Reading, seed: int, *, quiet: bool
) -> list[Float32[np.ndarray, "feature dim"]]:
    """Read unit features of up to `PATCHES` patches of each image, without all-zero ones."""
    config = model.config
    devices = devices_for(reading.batch_size)
    params = devices.replicate(cast_params(model.params, config))
    generator = np.random.default_rng(seed)
    parts: list[np.ndarray] = []
    unreadable: list[pathlib.Path] = []
    with progress_bar("vocabulary", len(paths), "images", quiet=quiet) as bar:
        for batch in reading.batches(paths, Preparation.of(config)):
            features = unit_features(params, devices.shard_batch(batch.images), config)
            for image in jax.device_get(features)[batch.valid]:
                found = image[image.any(axis=1)]
                chosen = np.sort(generator.permutation(len(found))[:PATCHES])
                parts.append(found[chosen].astype(np.float32))
            there = batch.indices >= 0
            unreadable += [paths[i] for i in batch.indices[there & ~batch.valid]]
            bar.advance(int(there.sum()))
    if unreadable:
        warn(f"images: {len(unreadable)} unreadable left out, {unreadable[0]} the first")
    return parts


def k_majority(
    features: Float[np.ndarray, "feature dim"], clusters: int, seed: int
) -> Float32[np.ndarray, "cluster dim"]:
    """Cluster binary features by Hamming distance; a centroid takes each bit by majority vote.

    It is the clustering of Galvez-Lopez and Tardos (T-RO 2012), without a tree: the first centroids
    are drawn as in k-means++, and a bit without a majority stays the same.

    Args:
        features: features whose elements are all +a or -a, for one a; see `Backbone.binary`.
        clusters: number of centroids.
        seed: seed for drawing the first centroids.
    """
    size = np.abs(features).max()
    bits = np.sign(features).astype(np.float32)
    generator = np.random.default_rng(seed)
    chosen = [int(generator.integers(len(bits)))]
    away = np.full(len(bits), np.inf)
    while len(chosen) < clusters:
        away = np.minimum(away, (bits.shape[1] - bits @ bits[chosen[-1]]) / 2)
        weights = np.square(away)
        # Once every feature is a centroid, the rest are drawn uniformly.
        shares = weights / weights.sum() if weights.any() else None
        chosen.append(int(generator.choice(len(bits), p=shares)))
    centroids, nearest = bits[chosen], np.zeros(len(bits), int)
    for _ in range(_ROUNDS):
        before, nearest = nearest, (bits @ centroids.T).argmax(axis=1)
        order = np.argsort(nearest, kind="stable")
        there, starts = np.unique(nearest[order], return_index=True)
        sums = np.zeros_like(centroids)
        sums[there] = np.add.reduceat(bits[order], starts)
        centroids = np.where(sums == 0, centroids, np.sign(sums))
        if (nearest == before).all():
            break
    return (size * centroids).astype(np.float32)


def _k_means(
    features: Float[np.ndarray, "feature dim"], clusters: int, seed: int, *, spherical: bool
) -> Float32[np.ndarray, "cluster dim"]:
    """Return the means of clusters; with `spherical`, of clusters formed by angle."""
    import faiss as _faiss  # imported here: most of training does not need it

    faiss: Any = _faiss
    kmeans = faiss.Kmeans(
        features.shape[1],
        clusters,
        niter=_ROUNDS,
        seed=seed % 2**31,
        spherical=spherical,
        # All features are used, whatever their number.
        min_points_per_centroid=1,
        max_points_per_centroid=len(features),
    )
    features = np.ascontiguousarray(features)
    kmeans.train(features)
    if not spherical:
        return kmeans.centroids
    # faiss scales the means to unit vectors, which moves no feature to another cluster.
    nearest = kmeans.index.search(features, 1)[1][:, 0]
    means = kmeans.centroids.copy()
    for cluster in np.unique(nearest):
        means[cluster] = features[nearest == cluster].mean(axis=0)
    return means
