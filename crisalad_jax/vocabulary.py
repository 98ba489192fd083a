"""The vocabularies of NetVLAD and AnyLoc: k-means centroids of the features of images.

Euclidean k-means of unit features, as VLAD has it (Jegou et al. 2010) and NetVLAD starts from: a
centroid is the mean of what is nearest to it, and no unit vector. AnyLoc's public code compares by
the angle, which differs from that by the centroids' lengths.
"""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32

from crisalad_jax.config import ModelConfig
from crisalad_jax.data.loader import OnBadImage, image_batches
from crisalad_jax.errors import InputError
from crisalad_jax.model import Crisalad, unit_features
from crisalad_jax.nn.aggregators import anyloc, netvlad
from crisalad_jax.platform import devices_for
from crisalad_jax.progress import progress_bar
from crisalad_jax.rows import sample

IMAGES = 500
"""Images that are read, at most; with as many patches of each as follow, public NetVLAD's 50,000
features."""
PATCHES = 100
"""Patches that are taken of an image, at most."""
_ROUNDS = 100
"""Of k-means; it has converged before."""


def needs_vocabulary(config: ModelConfig) -> bool:
    """Whether a model has centroids that are to be found before it is of use, or trains."""
    return config.aggregator in ("netvlad", "anyloc")


def with_vocabulary(
    params: Crisalad,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    *,
    images: int | None = IMAGES,
    seed: int = 0,
    batch_size: int = 16,
    on_bad_image: OnBadImage = "stop",
    quiet: bool = True,
) -> Crisalad:
    """The model with centroids of the features that its own backbone finds in images.

    The same arguments give the same bits on the same machine. NetVLAD's scores start from the
    centroids too (`netvlad.from_centroids`). AnyLoc's vocabulary remembers its backbone: files of
    weights refuse another one.

    Args:
        params: a model, whose backbone is as it will be used, or as training starts from it.
        config: NetVLAD's or AnyLoc's.
        paths: images; not those that are evaluated on.
        images: at most so many of them, drawn at random; None for all, whose features are in memory
            together.
        seed: draws the images, `PATCHES` patches of each, and the first centroids.
        batch_size: images described at a time.
        on_bad_image: "stop", or "skip" to leave unreadable images out.
        quiet: no progress bar.

    Raises:
        InputError: a model without a vocabulary; an argument out of range; an image that cannot be
            read, or none that can; fewer features than clusters, or features that are not finite
            or all alike.
    """
    if not needs_vocabulary(config):
        raise InputError(
            f"aggregator: found {config.aggregator}, which has no vocabulary, expected netvlad or "
            "anyloc"
        )
    clusters = config.shape.tokens
    _check_counts(config, clusters, len(paths), images, seed)
    if images is not None and images < len(paths):
        paths = [paths[i] for i in sample(len(paths), images, seed)]
    features = _read_features(
        params, config, paths, seed, batch_size, on_bad_image=on_bad_image, quiet=quiet
    )
    if len(features) < clusters:
        raise InputError(
            f"images: found {len(features)} features in those that can be read, expected at least "
            f"{clusters}, one for each cluster"
        )
    if not np.isfinite(features).all():
        raise InputError("features: found NaN or infinity, expected a backbone's finite numbers")
    centroids = jnp.asarray(_k_means(features, clusters, seed))
    if config.aggregator == "netvlad":
        aggregator = netvlad.from_centroids(centroids, jnp.asarray(features))
    else:
        aggregator = anyloc.from_words(centroids, params.backbone)
    return dataclasses.replace(params, aggregator=aggregator)


def _check_counts(
    config: ModelConfig, clusters: int, found: int, images: int | None, seed: int
) -> None:
    """What can be said before an image is read."""
    if seed < 0:
        raise InputError(f"seed: found {seed}, expected at least 0")
    if images is not None and images < 1:
        raise InputError(f"images: found {images}, expected at least 1")
    used = found if images is None else min(images, found)
    most = used * _taken(config)
    if most < clusters:
        raise InputError(
            f"images: found {used}, which is {most} features, expected at least {clusters}, one "
            "for each cluster"
        )


def _taken(config: ModelConfig) -> int:
    """Features of an image."""
    return min(PATCHES, config.patches)


def _read_features(
    params: Crisalad,
    config: ModelConfig,
    paths: Sequence[pathlib.Path],
    seed: int,
    batch_size: int,
    *,
    on_bad_image: OnBadImage,
    quiet: bool,
) -> Float32[np.ndarray, "feature dim"]:
    batches = image_batches(
        paths, image_size=config.image_size, batch_size=batch_size, on_bad_image=on_bad_image
    )
    devices = devices_for(batch_size)
    params = devices.share(params)
    generator = np.random.default_rng(seed)
    parts: list[np.ndarray] = [np.empty((0, config.backbone.dim), np.float32)]
    with progress_bar("vocabulary", len(paths), "images", quiet=quiet) as bar:
        for batch in batches:
            found = jax.device_get(unit_features(params, devices.spread(batch.images), config))
            for image in found[batch.valid]:
                chosen = np.sort(generator.permutation(len(image))[:PATCHES])
                parts.append(image[chosen].astype(np.float32))
            bar.advance(int((batch.indices >= 0).sum()))
    return np.concatenate(parts)


def _k_means(
    features: Float[np.ndarray, "feature dim"], clusters: int, seed: int
) -> Float32[np.ndarray, "cluster dim"]:
    import faiss as _faiss  # which those who ask whether there is a vocabulary need not load

    faiss: Any = _faiss
    kmeans = faiss.Kmeans(
        features.shape[1],
        clusters,
        niter=_ROUNDS,
        seed=seed % 2**31,
        # All features, however many or few.
        min_points_per_centroid=1,
        max_points_per_centroid=len(features),
    )
    kmeans.train(np.ascontiguousarray(features))
    return kmeans.centroids
