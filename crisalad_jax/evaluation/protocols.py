"""How published evaluations group images, by the name of their method."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence

from crisalad_jax.config.checks import choose
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.retrieval.grouping import MASKED, Grouping, parse_groupings
from crisalad_jax.utils.errors import InputError

PREFIX = "published:"


@dataclasses.dataclass(frozen=True)
class Protocol:
    """The batches of a published evaluation: images in the order of names, each side apart."""

    sizes: Mapping[str, int]
    """Images in a batch, by a part of the set's name in small letters."""
    otherwise: int | None
    """Images in a batch of any other set; None where none is known."""
    source: str
    """Where these sizes are from."""

    def batch_size(self, name: str, benchmark: Benchmark) -> int:
        """Return how many images of a set are in a batch.

        Raises:
            InputError: no size is known of the set, or its images are in another order.
        """
        words = benchmark.name.lower()
        size = next((n for key, n in self.sizes.items() if key in words), self.otherwise)
        if size is None:
            raise InputError(
                f"grouping: found {PREFIX}{name} of {benchmark.name}, expected a set with one of "
                f"{', '.join(self.sizes)} in its name, or a size, as in sequential@16"
            )
        for side in (benchmark.queries, benchmark.database):
            if [*side] != sorted(side, key=str):
                raise InputError(
                    f"grouping: found {PREFIX}{name} and images of {benchmark.name} in another "
                    "order than that of their names, expected that order, as folders have it"
                )
        return size


_SAGE = {26: "nordland", 20: "eynsham", 16: "msls tokyo", 8: "pitts", 2: "sped amstertime"}
"""Sets by the images in a batch."""
PROTOCOLS: Mapping[str, Protocol] = {
    "cricavpr": Protocol({"pitts": 8}, 16, "Lu et al., CVPR 2024: 8 of Pittsburgh, 16 of others"),
    "crisalad": Protocol({}, 16, "Xu et al. 2025, section 4: 16"),
    "sage": Protocol(
        {part: size for size, parts in _SAGE.items() for part in parts.split()},
        None,
        "github.com/chenshunpeng/SAGE, config.py: a size for each set",
    ),
}
"""Published evaluations of models whose images attend to each other."""


def check_groupings(texts: Sequence[str]) -> list[str]:
    """Check groupings, published ones too, and return the kinds of `Grouping` that they ask for.

    Raises:
        InputError: what `parse_groupings` raises, or there is no such published one.
    """
    for text in texts:
        if text.startswith(PREFIX):
            choose(f"grouping {PREFIX}NAME", text.removeprefix(PREFIX), PROTOCOLS)
    parsed = parse_groupings(_expanded(texts, lambda _: 1))
    return list(dict.fromkeys(kind for each in parsed for kind in (each.queries, each.database)))


def groupings_of(texts: Sequence[str], benchmark: Benchmark) -> list[Grouping]:
    """Make the groupings of an evaluation, in order and without repeats.

    A published one is followed by the honest ones of as many images: each alone, in random order,
    and without those of the own place.

    Args:
        texts: each as `Grouping.parse` reads it, or `published:NAME` of `PROTOCOLS`.
        benchmark: what is evaluated.

    Raises:
        InputError: what `Protocol.batch_size` raises.

    Example:
        >>> import pathlib
        >>> nothing = (), ()
        >>> benchmark = Benchmark("Nordland", pathlib.Path(), *nothing, None, "10 frames")
        >>> [str(each) for each in groupings_of(["published:sage"], benchmark)]
        ['sequential@26', 'single', 'shuffled@26', 'masked@26']
    """
    sizes = _expanded(texts, lambda name: PROTOCOLS[name].batch_size(name, benchmark))
    return parse_groupings(sizes)


def _expanded(texts: Sequence[str], size_of: Callable[[str], int]) -> Iterator[str]:
    """Yield groupings; a published name gives those that it is short for."""
    for text in texts:
        if text.startswith(PREFIX):
            size = size_of(text.removeprefix(PREFIX))
            yield from (f"sequential@{size}", "single", f"shuffled@{size}", f"{MASKED}@{size}")
        else:
            yield text


def protocol_notes(texts: Sequence[str]) -> list[str]:
    """Say where the sizes of published groupings are from, a line for each."""
    names = [text.removeprefix(PREFIX) for text in texts if text.startswith(PREFIX)]
    return [
        f"{PREFIX}{name}: batches in the order of names, each side apart "
        f"({PROTOCOLS[name].source}); below it the honest groupings of as many images."
        for name in dict.fromkeys(names)
    ]
