"""Shares of a collection: each process describes its own, and the last one joins all."""

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

from crisalad_jax.config.io import to_plain
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.model import Model, model_hash
from crisalad_jax.utils.errors import InputError


class Share(NamedTuple):
    """One share of several: a run of a collection's images."""

    index: int
    """Number of the share, from 0."""
    count: int
    """Number of shares."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read INDEX/COUNT.

        Raises:
            InputError: anything else, or an index that is not below the count.
        """
        match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
        if match is None or int(match[1]) >= int(match[2]):
            raise InputError(
                f"share: found {text!r}, expected INDEX/COUNT, with an index from 0 and below the "
                "count, such as 0/8"
            )
        return cls(int(match[1]), int(match[2]))

    @property
    def name(self) -> str:
        """The name of this share's files."""
        return f"{self.index}-of-{self.count}"

    def others(self) -> list[Self]:
        """Return all shares in order, this one too."""
        return [type(self)(index, self.count) for index in range(self.count)]

    def of(self, images: int, batch_size: int) -> slice:
        """Return the places of this share's images: whole batches, so that bits stay the same.

        Raises:
            InputError: there are fewer batches than shares.
        """
        batches = -(-images // batch_size)
        if batches < self.count:
            raise InputError(
                f"share: found {self.count} shares of {images} images in batches of {batch_size}, "
                f"expected at most {batches}, or smaller batches"
            )
        first, end = (
            min(images, i * batches // self.count * batch_size)
            for i in (self.index, self.index + 1)
        )
        return slice(first, end)


def digest_of(
    params: Model, config: ModelConfig, names: Sequence[str], settings: Mapping[str, Any]
) -> str:
    """Compute a digest of what all shares of one collection have in common."""
    common = {"model": model_hash(params, config), "config": to_plain(config), **settings}
    digest = hashlib.sha256(json.dumps(common, sort_keys=True).encode())
    for name in names:
        digest.update(f"{name}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()
