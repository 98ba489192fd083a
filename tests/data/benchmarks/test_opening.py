"""Which layout is found, and which options it takes."""

from pathlib import Path

import numpy as np
import pytest

from crisalad_jax.data.benchmarks import open_benchmark
from crisalad_jax.errors import InputError
from tests.data.benchmarks.trees import truth_rows, write_utm, write_vpr_bench

REAL = Path(__file__).parents[3].parent / "shared" / "data"


def test_open_benchmark_finds_the_layout(tmp_path):
    write_utm(tmp_path / "a" / "images" / "val", np.zeros((2, 2)), np.zeros((1, 2)))
    assert open_benchmark(tmp_path / "a", radius=5.0).name == "a/val (@UTM, 5 m)"
    write_utm(tmp_path / "b", np.zeros((2, 2)), np.zeros((1, 2)))
    assert open_benchmark(tmp_path / "b").name == "b (@UTM, 25 m)"
    write_vpr_bench(tmp_path / "c", truth_rows((0, [0]), (1, [1]), (2, [2])))
    assert open_benchmark(tmp_path / "c").name == "c (VPR-Bench)"
    with pytest.raises(InputError, match="split: found 'val'"):
        open_benchmark(tmp_path / "c", "val")


def test_open_benchmark_says_what_it_found(tmp_path):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(InputError, match=r"found notes.txt, pictures/; expected images/.* ref/"):
        open_benchmark(tmp_path)
    with pytest.raises(InputError, match="nowhere: found no such folder"):
        open_benchmark(tmp_path / "nowhere")


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real photographs")
def test_real_sets():
    sped = open_benchmark(REAL / "sped_val")
    assert sped.name == "sped_val/test (@UTM, 25 m)"
    assert [len(p) for p in sped.positives] == [1] * 147
    for path, positives in zip(sped.queries, sped.positives, strict=True):
        # the file names carry the place as well as its placeholder coordinates
        assert path.name.split("@")[1] == sped.database[positives[0]].name.split("@")[1]

    corridor = open_benchmark(REAL / "corridor")
    assert corridor.name == "corridor (VPR-Bench)"
    assert len(corridor.database) == len(corridor.queries) == 111
    for i, positives in enumerate(corridor.positives):
        assert positives.tolist() == list(range(max(0, i - 2), min(110, i + 2) + 1))

    with pytest.raises(InputError, match=r"toy_streets/database/.*: found no coordinates"):
        open_benchmark(REAL / "toy_streets")
