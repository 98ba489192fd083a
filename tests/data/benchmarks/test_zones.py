"""@UTM names of several zones and hemispheres, against pyproj's projections and geodesics."""

import numpy as np
import pyproj
import pytest

from crisalad_jax.data.benchmarks import open_benchmark, read_utm
from tests.data.benchmarks.trees import lists_of, refused, touch, write_sides

GEOD = pyproj.Geod(ellps="WGS84")
BANDS = "CDEFGHJKLMNPQRSTUVWX"


def name_of(latitude: float, longitude: float, zone: int | None = None) -> str:
    """As VPR-datasets-downloader writes it, with two decimals."""
    number = int((longitude + 180) // 6) + 1 if zone is None else zone
    letter = BANDS[min(int((latitude + 80) // 8), 19)]
    code = (32600 if latitude >= 0 else 32700) + number
    into = pyproj.Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True)
    east, north = into.transform(longitude, latitude)
    return f"@{east:.2f}@{north:.2f}@{number:02d}@{letter}@{latitude}@{longitude}@@@@@@@@@.jpg"


def metres_between(first: str, second: str) -> float:
    (a, b), (c, d) = (map(float, each.split("@")[5:7]) for each in (first, second))
    return GEOD.inv(b, a, d, c)[2]


# 14 m apart across the edge of zones 31 and 32, and across the equator.
EDGE = name_of(48.85, 6 - 7 / 73_350), name_of(48.85, 6 + 7 / 73_350)
EQUATOR = name_of(7 / 110_574, 3.5), name_of(-7 / 110_574, 3.5)


@pytest.mark.parametrize("pair", [EDGE, EQUATOR], ids=["zones", "hemispheres"])
def test_neighbours_in_two_planes_match(tmp_path, pair):
    there, asked = pair
    assert metres_between(there, asked) == pytest.approx(14, abs=0.05)
    assert there.split("@")[3:5] != asked.split("@")[3:5]
    write_sides(tmp_path, [there, name_of(48.9, 5.9)], [asked])
    benchmark = read_utm(tmp_path)
    index = [path.name for path in benchmark.database].index(there)
    assert lists_of(benchmark.positives) == [[index]]
    assert "the distance on the ground" in benchmark.rule
    # Names have two decimals.
    apart = np.linalg.norm(benchmark.database_positions[index] - benchmark.query_positions[0])
    assert apart == pytest.approx(metres_between(there, asked), abs=0.02)
    plain = read_utm(tmp_path, ignore_zones=True)
    assert lists_of(plain.positives) == [[]]
    assert plain.name.endswith("(@UTM, 25 m, zones ignored)")


def test_equal_numbers_of_two_zones_are_far_apart(tmp_path):
    """They are 430 km apart, and a match to a tool that ignores the zones."""
    first, second = (f"@500000.00@5411000.00@{zone}@U@@@@@@@@@@@.jpg" for zone in (31, 32))
    write_sides(tmp_path, [first], [second])
    assert lists_of(read_utm(tmp_path).positives) == [[]]
    into = [pyproj.Transformer.from_crs(f"EPSG:{z}", "EPSG:4326") for z in (32631, 32632)]
    (a, b), (c, d) = (each.transform(500000, 5411000) for each in into)
    benchmark = read_utm(tmp_path)
    apart = np.linalg.norm(benchmark.database_positions[0] - benchmark.query_positions[0])
    # The chord is 0.1 km shorter than the geodesic.
    assert apart == pytest.approx(GEOD.inv(b, a, d, c)[2], abs=100)
    assert 430e3 < apart < 445e3
    assert lists_of(open_benchmark(tmp_path, ignore_zones=True).positives) == [[0]]
    touch(tmp_path / "database" / "@400000.00@5411000.00@31@U@@@@@@@@@@@.jpg")
    assert lists_of(read_utm(tmp_path, radius=450e3).positives) == [[1]]


def test_the_letter_s_is_a_band_or_the_south(tmp_path):
    """San Francisco is in band S of the north; H and a bare S are of the south."""
    francisco = "@551550.00@4182401.73@10@S@@@@@@@@@@@.jpg"
    sydney = ["@334900.00@6252300.00@56@H@@@@@@@@@@@.jpg"]
    write_sides(tmp_path, [*sydney, francisco], [sydney[0].replace("@H@", "@S@")])
    benchmark = read_utm(tmp_path)
    assert lists_of(benchmark.positives) == [[0]]
    assert "10 north, 56 south" in benchmark.rule
    east = pyproj.Transformer.from_crs("EPSG:32610", "EPSG:4978").transform(551550, 4182401.73, 0)
    # The series: 0.1 mm.
    np.testing.assert_allclose(benchmark.database_positions[1], east, atol=1e-3)


def test_positives_across_zones_equal_brute_force(tmp_path):
    draw = np.random.default_rng(3)
    middle = [(0.0, 6.0), (52.0, 12.0), (-34.0, 150.0), (0.0, -180.0)]
    names = []
    for latitude, longitude in middle:
        metres = draw.uniform(-60, 60, (2, 25))
        around = longitude + metres[0] / (111_320 * np.cos(np.deg2rad(latitude)))
        around = (around + 180) % 360 - 180
        names += [
            name_of(float(a), float(b))
            for a, b in zip(latitude + metres[1] / 110_600, around, strict=True)
        ]
    write_sides(tmp_path, names[::2], names[1::2])
    benchmark = read_utm(tmp_path)
    matches = across = 0
    for query, positives in zip(benchmark.queries, benchmark.ground_truth(), strict=True):
        assert (np.diff(positives) > 0).all()
        for index, path in enumerate(benchmark.database):
            metres = metres_between(query.name, path.name)
            # UTM's scale is 0.1 % off at most, and names have two decimals.
            if abs(metres - 25) > 0.05:
                assert (index in positives) == (metres < 25)
                matches += metres < 25
                two = query.name.split("@")[3:5] != path.name.split("@")[3:5]
                across += metres < 25 and two
    assert matches > across > 10


def test_images_of_one_zone_match_by_its_metres_beside_others(tmp_path):
    """Published sets such as MSLS have a city a zone: their positives are those of other tools.

    400 km west of a meridian 25.00 m in the plane are 24.96 m on the ground.
    """
    pair = [f"@{east}.00@6000000.00@33@U@@@@@@@@@@@.jpg" for east in (100_000, 100_025)]
    write_sides(tmp_path, [pair[0], "@500000.00@4000000.00@10@S@@@@@@@@@@@.jpg"], [pair[1]])
    assert lists_of(read_utm(tmp_path).positives) == [[0]]
    assert lists_of(read_utm(tmp_path, radius=24.97).positives) == [[]]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("@1@2@.jpg", "@1@2@.jpg: found no zone with a letter, expected @east@north@zone@letter@"),
        ("@500000@5000000@33@@@@.jpg", "found no zone with a letter, .*evaluate --ignore-zones"),
        ("@500000@5000000@61@U@@@.jpg", "found no zone with a letter"),
        ("@9000000@5000000@33@U@@@.jpg", r"found \[9000000.0, 5000000.0\], expected metres of UTM"),
    ],
)
def test_a_name_without_its_zone_among_several_is_refused(tmp_path, name, words):
    write_sides(tmp_path, [EDGE[0], name], [EDGE[1]])
    with refused(words):
        read_utm(tmp_path)
    assert read_utm(tmp_path, ignore_zones=True).positives is not None
