"""Reduce descriptors to their principal components, with or without whitening."""

import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.safetensors_io import read_sealed, write_sealed
from crisalad_jax.config.checks import PATH, check_count, check_seed, check_types, require, takes
from crisalad_jax.config.io import from_plain, to_plain
from crisalad_jax.config.short_repr import brief
from crisalad_jax.retrieval.chunks import WIDE, Descriptors, as_rows, blocks, sample
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.progress import progress_bar
from crisalad_jax.utils.shapes import Float32, Float64

if TYPE_CHECKING:
    from crisalad_jax.nn.layers import Linear
    from crisalad_jax.nn.projection import ProjectionConfig
    from crisalad_jax.retrieval.describer import Describer

FORMAT = "crisalad-jax pca 2"
"""The only metadata key of a file of components; its JSON value has the checksum and settings."""
SAMPLES = 2**14
"""Maximum number of descriptors that components are fitted to, as in CricaVPR."""
_ARRAYS = ("mean", "components", "variances", "total")
_CHUNK_BYTES = 2**26


@dataclasses.dataclass(frozen=True)
class PcaConfig:
    """What happens to descriptors after their projection onto the components."""

    whiten: bool = False
    """Divide every component by its standard deviation, so that all have the same variance (Jegou
    and Chum, 2012). CricaVPR does not whiten."""
    renormalise: bool = True
    """Normalise the reduced descriptors to unit length again, as `search` and all cosine
    comparisons expect (and as Jegou and Chum do after whitening). CricaVPR's published figures are
    without this step: it searches by Euclidean distance."""

    def __post_init__(self) -> None:
        """Check the types."""
        check_types(self)


@brief
class Pca(NamedTuple):
    """Principal components, fitted by `fit_pca`."""

    mean: Float32[np.ndarray, " d"]
    components: Float32[np.ndarray, "dim d"]
    """Orthonormal rows by descending variance; the entry of largest magnitude in each is > 0."""
    variances: Float32[np.ndarray, " dim"]
    """Sample variances (divided by n - 1) of the fitted descriptors along the components."""
    total: Float32[np.ndarray, ""]
    """Total variance of the fitted descriptors."""
    config: PcaConfig
    model: str = ""
    """The `model_hash` of the model whose descriptors were fitted; "" if it is not known."""

    @property
    def kept(self) -> float:
        """Share of the variance that the components explain, 0 to 1."""
        return float(self.variances.sum() / self.total)

    def apply(self, descriptors: Descriptors) -> Float32[np.ndarray, "n dim"]:
        """Reduce descriptors to their components, in float32, some rows at a time.

        Raises:
            InputError: `descriptors` is not a finite (n, d) matrix, where d is the fitted length.
        """
        if len(descriptors):  # a batch may have no readable image
            descriptors = as_rows(descriptors, "descriptors", len(self.mean))
        reduced = np.empty((len(descriptors), len(self.components)), np.float32)
        size = _rows_at_a_time(len(self.mean))
        for start, rows in blocks(descriptors, "descriptors", size, unit=False):
            part = (rows - self.mean) @ self.components.T / self._scale
            if self.config.renormalise:
                with np.errstate(invalid="ignore"):  # the mean itself has no direction: NaN
                    part /= np.linalg.norm(part, axis=1, keepdims=True)
            reduced[start : start + len(part)] = part
        return reduced

    @property
    def _scale(self) -> Float32[np.ndarray, "*dim"]:
        """The divisors of the components."""
        return np.sqrt(self.variances) if self.config.whiten else np.ones((), np.float32)

    def projection(self) -> "tuple[Linear, ProjectionConfig]":
        """Convert the components to a linear layer for the end of a model.

        Returns:
            The layer's parameters, in float32, and configuration, for `Crisalad.projection`.
        """
        # Imported here: applying components needs no JAX.
        import jax.numpy as jnp

        from crisalad_jax.nn.layers import Linear
        from crisalad_jax.nn.projection import ProjectionConfig

        weight = self.components.astype(np.float64).T / self._scale
        layer = Linear(jnp.asarray(weight, WIDE), jnp.asarray(-(self.mean @ weight), WIDE))
        return layer, ProjectionConfig(len(self.components), self.config.renormalise)


def shortened(
    pca: Pca | None, describer: "Describer", name: str, *, unit: bool = False
) -> tuple[int, bool]:
    """Check that components fit a model, and return the length of the reduced descriptors.

    Args:
        pca: the components; None leaves descriptors as they are.
        describer: the model.
        name: what to name in error messages: the model, or what needs its descriptors.
        unit: whether the resulting descriptors must be unit vectors.

    Returns:
        The length of the resulting descriptors, and whether they are unit vectors.

    Raises:
        InputError: the components were fitted to other descriptors, or `unit` is set and the
            resulting descriptors are not unit vectors.
    """
    config = describer.config
    length, is_unit = config.descriptor_dim, config.unit_length
    if pca is not None:
        require(
            length == len(pca.mean),
            f"{name}: found descriptors of length {length}, expected {len(pca.mean)} as the "
            "components were fitted to",
        )
        require(
            not pca.model or pca.model == describer.digest,
            f"{name}: found components that were fitted to descriptors of model {pca.model[:12]}, "
            "expected those of this model",
        )
        length, is_unit = len(pca.components), pca.config.renormalise
    require(
        is_unit or not unit,
        f"{name}: found descriptors that are not normalised, expected unit vectors, which are "
        "compared by cosine",
    )
    return length, is_unit


def fit_pca(
    descriptors: Descriptors,
    dim: int,
    config: PcaConfig | None = None,
    *,
    samples: int | None = SAMPLES,
    seed: int = 0,
    model: str = "",
    name: str = "descriptors",
    quiet: bool = True,
) -> Pca:
    """Fit `dim` principal components to descriptors of length d, in memory that depends only on d.

    The d x d covariance is summed in float64, some rows at a time, and its leading eigenvectors are
    computed. If at most d descriptors are fitted, their Gram matrix, which is smaller, gives the
    same components. The fitted descriptors are read twice, the first time for the mean.

    Args:
        descriptors: (n, d), in memory or as a memory map, of any norm.
        dim: number of components.
        config: whether to whiten and to renormalise; None is the default `PcaConfig`.
        samples: maximum number of descriptors to fit, drawn at random; None fits all.
        seed: random seed of the draw.
        model: `model_hash` of the only model that may use the components; empty allows any.
        name: name of the descriptors in messages, such as their file.
        quiet: whether to hide the progress bar.

    Returns:
        The components, for `Pca.apply`.

    Raises:
        InputError: the array is empty, is not a matrix, or has a row that is not finite; there are
            fewer than two descriptors or samples; `dim` is below 1, or above the rank of the fitted
            descriptors; or the seed is negative.

    Example:
        >>> import numpy as np
        >>> descriptors = np.random.default_rng(0).normal(size=(50, 8)).astype(np.float32)
        >>> fit_pca(descriptors, 3).apply(descriptors).shape
        (50, 3)
    """
    check_seed("seed", seed)
    check_count("dim", dim)
    descriptors = as_rows(descriptors, name)
    total, length = descriptors.shape
    count = total if samples is None else min(samples, total)
    if dim > min(count - 1, length):
        raise InputError(
            f"dim: found {dim}, expected 1 to {min(count - 1, length)}, the highest rank that "
            f"{count} descriptors of length {length} can have about their mean"
        )
    places = None if count == total else sample(total, count, seed)
    with progress_bar("components", 2 * count, "rows", quiet=quiet) as bar:

        def wide() -> Iterator[Float64[np.ndarray, "rows d"]]:
            size = _rows_at_a_time(length)
            for _, rows in blocks(descriptors, name, size, unit=False, places=places):
                yield rows.astype(np.float64)
                bar.advance(len(rows))

        mean = np.sum([rows.sum(axis=0) for rows in wide()], axis=0) / count
        centred = (rows - mean for rows in wide())
        if count <= length:
            together = np.concatenate(list(centred))
            covariance = together @ together.T / (count - 1)  # the Gram matrix: the same variances
        else:
            covariance = np.zeros((length, length))
            for rows in centred:
                covariance += rows.T @ rows / (count - 1)
    whole = np.trace(covariance)
    variances, components = _leading(covariance, dim, count, length)
    if count <= length:
        components = components @ together
        components /= np.linalg.norm(components, axis=1, keepdims=True)
    # Fixes the sign of each component, which otherwise depends on the solver.
    largest = np.take_along_axis(components, np.abs(components).argmax(axis=1)[:, None], axis=1)
    found = (mean, components * np.sign(largest), variances, whole)
    mean, components, variances, whole = (np.asarray(array, np.float32) for array in found)
    return Pca(mean, components, variances, whole, config or PcaConfig(), model)


@brief
class Plane(NamedTuple):
    """Descriptors in the plane of their first two principal components."""

    positions: Float32[np.ndarray, "n 2"]
    shares: Float32[np.ndarray, " 2"]
    """Share of the descriptors' variance along each axis, 0 to 1."""


def project_to_plane(descriptors: Descriptors) -> Plane:
    """Project descriptors onto the plane in which they vary most, to plot them.

    It is the plane of the first two principal components. Distances in it are never larger than
    those between the descriptors.

    Args:
        descriptors: n descriptors of any norm.

    Returns:
        Positions relative to the mean, and the share of the variance along each axis.

    Raises:
        InputError: there are fewer than three descriptors, or all lie on a line; or `fit_pca`
            refuses the array for another reason.

    Example:
        >>> import numpy as np
        >>> descriptors = np.random.default_rng(0).normal(size=(50, 8)).astype(np.float32)
        >>> project_to_plane(descriptors).positions.shape
        (50, 2)
    """
    pca = fit_pca(descriptors, 2, PcaConfig(renormalise=False))
    return Plane(pca.apply(descriptors), pca.variances / pca.total)


def _rows_at_a_time(length: int) -> int:
    return max(1, _CHUNK_BYTES // (8 * length))


def _leading(
    matrix: Float64[np.ndarray, "m m"], dim: int, count: int, length: int
) -> tuple[Float64[np.ndarray, " dim"], Float64[np.ndarray, "dim m"]]:
    """Return the `dim` largest eigenvalues and their vectors, largest first."""
    # SciPy's OpenBLAS waits forever for memory that is not available: allocate it first.
    np.empty((1 + (os.cpu_count() or 1), 2**25), np.uint8)
    import scipy.linalg  # takes a tenth of a second, and is not needed to apply components

    size = len(matrix)
    values, vectors = scipy.linalg.eigh(
        matrix, subset_by_index=(size - dim, size - 1), overwrite_a=True, check_finite=False
    )
    values, vectors = values[::-1], vectors[:, ::-1].T.copy()
    rank = int((values > values[0] * max(count, length) * np.finfo(np.float64).eps).sum())
    if rank < dim or values[0] <= 0:
        raise InputError(
            f"dim: found {dim}, expected at most {rank if values[0] > 0 else 0}, the rank of these "
            f"{count} descriptors of length {length} about their mean"
        )
    return values, vectors


def pca_hash(pca: Pca) -> str:
    """Compute the SHA-256 of components: of their arrays and `PcaConfig`, but not `Pca.model`."""
    digest = hashlib.sha256(json.dumps(to_plain(pca.config), sort_keys=True).encode())
    for name in _ARRAYS:
        digest.update(np.ascontiguousarray(getattr(pca, name)).data)
    return digest.hexdigest()


def save_pca(path: str | os.PathLike[str], pca: Pca) -> None:
    """Save components as safetensors, with their configuration in the metadata.

    Args:
        path: the .safetensors file.
        pca: the components, from `fit_pca`.

    Raises:
        InputError: the file cannot be written.

    Example:
        >>> import numpy as np
        >>> descriptors = np.random.default_rng(0).normal(size=(50, 8)).astype(np.float32)
        >>> save_pca(folder / "pca.safetensors", fit_pca(descriptors, 3))
        >>> load_pca(folder / "pca.safetensors").components.shape
        (3, 8)
    """
    arrays = {name: np.array(getattr(pca, name), order="C") for name in _ARRAYS}
    write_sealed(path, arrays, FORMAT, {"config": to_plain(pca.config), "model": pca.model})


@takes(path=PATH)
def load_pca(path: str | os.PathLike[str], *, verify: bool = True) -> Pca:
    """Read components that `save_pca` wrote.

    Args:
        path: the file.
        verify: whether to check the file against its checksum.

    Returns:
        The components.

    Raises:
        InputError: the file is missing, changed, truncated or of another kind, or its arrays do not
            fit each other.

    Example:
        >>> import numpy as np
        >>> from crisalad_jax import save_pca
        >>> descriptors = np.random.default_rng(0).normal(size=(50, 8)).astype(np.float32)
        >>> save_pca(folder / "pca.safetensors", fit_pca(descriptors, 3))
        >>> load_pca(folder / "pca.safetensors").apply(descriptors).shape
        (50, 3)
    """
    path = pathlib.Path(path)
    expected = f"a file of principal components ({FORMAT!r}), as `crisalad pca` writes it"
    value, arrays = read_sealed(path, FORMAT, expected, verify=verify)
    dim, length = (*arrays.get("components", np.empty(0)).shape, 0, 0)[:2]
    shapes = {"mean": (length,), "components": (dim, length), "variances": (dim,), "total": ()}
    found = {name: array.shape for name, array in arrays.items()}
    if found != shapes or not all(
        array.dtype == WIDE and np.isfinite(array).all() for array in arrays.values()
    ):
        raise InputError(f"{path}: found arrays {found}, expected {shapes} of finite float32")
    config = from_plain(PcaConfig, value.get("config"), source=str(path))
    return Pca(**arrays, config=config, model=str(value.get("model", "")))
