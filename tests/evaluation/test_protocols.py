"""Published batches, by the sizes that their papers and configurations name."""

import dataclasses
import pathlib

import pytest

from crisalad_jax.data.benchmarks import Benchmark
from crisalad_jax.evaluation.protocols import check_groupings, groupings_of, protocol_notes
from crisalad_jax.utils.errors import InputError


def of(name: str) -> Benchmark:
    paths = pathlib.Path("a"), pathlib.Path("b")
    return Benchmark(name, pathlib.Path(), paths, paths, None, "25 m")


@pytest.mark.parametrize(
    ("protocol", "benchmark", "size"),
    [
        # chenshunpeng/SAGE dc79e21, config.py.
        ("sage", "Nordland (winter, summer)", 26),
        ("sage", "eynsham/test (@UTM, 25 m)", 20),
        ("sage", "MSLS val", 16),
        ("sage", "tokyo247/test", 16),
        ("sage", "Pitts250k/test", 8),
        ("sage", "SPED", 2),
        ("sage", "amstertime", 2),
        # Lu-Feng/CricaVPR, issues 2 and 7, and the paper's section 4.
        ("cricavpr", "pitts30k/test (@UTM, 25 m)", 8),
        ("cricavpr", "nordland", 16),
        # Xu et al. 2025, section 4.1.
        ("crisalad", "pitts30k/test (@UTM, 25 m)", 16),
    ],
)
def test_batches_are_of_the_published_size_and_honest_ones_follow(protocol, benchmark, size):
    found = [str(each) for each in groupings_of([f"published:{protocol}"], of(benchmark))]
    assert found == [f"sequential@{size}", "single", f"shuffled@{size}", f"masked@{size}"]


def test_published_groupings_stand_among_others_once():
    asked = ["single", "published:crisalad", "published:cricavpr", "window/single"]
    found = [str(each) for each in groupings_of(asked, of("sped"))]
    assert found == ["single", "sequential@16", "shuffled@16", "masked@16", "window/single"]
    assert check_groupings(asked) == ["single", "sequential", "shuffled", "masked", "window"]
    assert [note.partition(":")[2].partition(":")[0] for note in protocol_notes(asked)] == [
        *("crisalad", "cricavpr")
    ]


def test_what_is_not_published_is_named():
    with pytest.raises(InputError, match=r"^grouping published:NAME: found 'salad', expected one"):
        check_groupings(["published:salad"])
    with pytest.raises(InputError, match=r"found published:sage of town, .* or a size, as in seq"):
        groupings_of(["published:sage"], of("town"))
    for side in ("queries", "database"):
        mixed = dataclasses.replace(of("sped"), **{side: (pathlib.Path("b"), pathlib.Path("a"))})
        with pytest.raises(InputError, match="images of sped in another order than that"):
            groupings_of(["published:sage"], mixed)
