"""Describe images in this process, or on a Ray cluster whose nodes read and describe them."""

import dataclasses
import functools
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from crisalad_jax.config.plugins import load_plugins, loaded_plugins
from crisalad_jax.data.frames import file_of
from crisalad_jax.data.images import MAX_PIXELS
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.remote import address_of, is_remote
from crisalad_jax.retrieval.describe import Described, concatenated, described, token_rows
from crisalad_jax.retrieval.describer import Describer
from crisalad_jax.retrieval.pca import Pca
from crisalad_jax.retrieval.segments import SEGMENT
from crisalad_jax.utils import cluster
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.host import usable_cores


class Describing(NamedTuple):
    """A model and settings for describing images, each independently of the others."""

    describer: Describer
    reading: Reading
    components: Pca | None = None
    tokens: bool = False
    """Whether to return tokens, as `token_rows` does, instead of descriptors."""

    def stream(
        self, paths: Sequence[pathlib.Path], address: str | None = None
    ) -> Iterator[Described]:
        """Describe images in order, on the cluster at an address or, for None, in this process.

        Batches are the same in both cases; on machines of one kind, results are bit-identical.

        Raises:
            InputError: an image cannot be read and `reading` says "stop"; the cluster cannot be
                joined or fails; or a node lacks this package or a file that this machine can read.
        """
        if address is not None and paths:
            return self._on_cluster(paths, address)
        if self.tokens:
            return token_rows(self.describer, paths, self.reading)
        return described(self.describer, paths, self.reading, components=self.components)

    def _on_cluster(self, paths: Sequence[pathlib.Path], address: str) -> Iterator[Described]:
        size = max(1, SEGMENT // self.reading.batch_size) * self.reading.batch_size
        pieces = [(first, paths[first : first + size]) for first in range(0, len(paths), size)]
        environment = {MAX_PIXELS: os.environ[MAX_PIXELS]}  # before OpenCV is imported
        how = {
            "prepare": functools.partial(load_plugins, loaded_plugins()),
            "environment": environment,
        }
        # A cache belongs to this process.
        work = self._replace(reading=dataclasses.replace(self.reading, cache=None))
        with cluster.connected(address) as ray:
            cluster.check_nodes(ray, read=[_whole(paths[0]), _whole(paths[-1])])
            for part in cluster.map_in_order(ray, work.piece, pieces, **how):
                for index in part.unreadable:
                    self._check_unreadable(paths[index])
                yield part

    def piece(self, given: tuple[int, Sequence[pathlib.Path]]) -> Described:
        """Describe consecutive images, given as (index of the first, paths), on a cluster node."""
        first, paths = given
        own = dataclasses.replace(self.reading, threads=usable_cores())
        found = concatenated(list(self._replace(reading=own).stream(paths)))
        return found._replace(indices=found.indices + first, unreadable=found.unreadable + first)

    def _check_unreadable(self, path: pathlib.Path) -> None:
        """Check that an image that a node could not read is unreadable here too."""
        reading = dataclasses.replace(self.reading, threads=0)
        (batch,) = reading.batches([path], self.describer.preparation)
        if batch.valid[0]:
            raise InputError(
                f"{path}: a node of the cluster cannot read it, but this machine can: expected "
                "the same files everywhere"
            )


def _whole(path: pathlib.Path) -> str:
    file = file_of(path)
    return address_of(file) if is_remote(file) else os.path.abspath(file)
