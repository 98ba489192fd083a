"""How published evaluations group images into batches, by the name of their method."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence

from crisalad_jax.config.checks import choose
from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.retrieval.grouping import MASKED, Grouping, parse_groupings
from crisalad_jax.utils.errors import InputError

PREFIX = "published:"


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Batches of a published evaluation: images in order of name, queries and database separate."""

    sizes: Mapping[str, int]
    """Batch size, by a lower-case part of the evaluation set's name."""
    otherwise: int | None
    """Batch size for any other evaluation set; None if unknown."""
    source: str
    """Where the sizes are published."""

    def batch_size(self, name: str, benchmark: Benchmark) -> int:
        """Return the batch size for a benchmark; messages call the protocol `name`.

        Raises:
            InputError: no size is known for it, or its images are not in the order of their names.
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
                    "order than that of their names, expected that order, as in folders"
                )
        return size


_SAGE = {26: "nordland", 20: "eynsham", 16: "msls tokyo", 8: "pitts", 2: "sped amstertime"}
"""Sets by batch size."""
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
    """Check groupings, also published ones, and return the kinds in them, such as "shuffled".

    Raises:
        InputError: `Grouping.parse` cannot read a text, or a published grouping is unknown.
    """
    for text in texts:
        if text.startswith(PREFIX):
            choose(f"grouping {PREFIX}NAME", text.removeprefix(PREFIX), PROTOCOLS)
    parsed = parse_groupings(_expanded(texts, lambda _: 1))
    return list(dict.fromkeys(kind for each in parsed for kind in (each.queries, each.database)))


def groupings_of(texts: Sequence[str], benchmark: Benchmark) -> list[Grouping]:
    """Parse the groupings of an evaluation, in order and without repeats.

    A published grouping is followed by single images, and by shuffled and masked batches of the
    same size.

    Args:
        texts: each as `Grouping.parse` reads it, or `published:NAME` with a name in `PROTOCOLS`.
        benchmark: the evaluated benchmark.

    Raises:
        InputError: a published grouping does not fit the benchmark (`Protocol.batch_size`).

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
    """Yield groupings, with published names expanded."""
    for text in texts:
        if text.startswith(PREFIX):
            size = size_of(text.removeprefix(PREFIX))
            yield from (f"sequential@{size}", "single", f"shuffled@{size}", f"{MASKED}@{size}")
        else:
            yield text


def protocol_notes(texts: Sequence[str]) -> list[str]:
    """Explain each published grouping among the texts in one line, with its source."""
    names = [text.removeprefix(PREFIX) for text in texts if text.startswith(PREFIX)]
    return [
        f"{PREFIX}{name}: batches in the order of names, each side separately "
        f"({PROTOCOLS[name].source}); below it, single, shuffled and masked ones of the same size."
        for name in dict.fromkeys(names)
    ]
