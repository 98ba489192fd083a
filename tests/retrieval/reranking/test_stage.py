"""The new order against scores of single pairs; each image is described once; bad input."""

import dataclasses
import pathlib
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from ott.geometry.pointcloud import PointCloud
from ott.tools.sinkhorn_divergence import sinkhorn_divergence as ott_divergence

from crisalad_jax.config.registry import make_part
from crisalad_jax.data.images import read_image
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.resize import resize_image
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.nn.aggregators.pair_vpr import PairVprConfig
from crisalad_jax.nn.aggregators.salad import FolConfig
from crisalad_jax.nn.aggregators.selavpr import SelaVprConfig
from crisalad_jax.nn.aggregators.selavprpp import SelaVprPpHashConfig
from crisalad_jax.nn.aggregators.transvpr import TransVprConfig
from crisalad_jax.nn.aggregators.vlad import NetVladConfig
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Model, extract_tokens
from crisalad_jax.nn.projection import ProjectionConfig
from crisalad_jax.retrieval.neighbours import Neighbours
from crisalad_jax.retrieval.reranking import (
    Reranker,
    Reranking,
    divergence,
    matching,
    parse_reranking,
    stage,
)
from crisalad_jax.utils.errors import InputError
from tests.conftest import BATCH, MODEL, random_params
from tests.nn.conftest import slow_unless

QUIET = Reading(batch_size=BATCH, quiet=True)

PLAIN = dataclasses.replace(MODEL, cross_image="none")
TRANSVPR = dataclasses.replace(PLAIN, aggregator=TransVprConfig(levels=2, dim=16))
SELAVPR = dataclasses.replace(PLAIN, aggregator=SelaVprConfig(hidden=16, local=8))
FOL = dataclasses.replace(
    PLAIN,
    image_size=(266, 210),  # the smallest
    aggregator=FolConfig(
        clusters=4, cluster_dim=8, token_dim=16, hidden=16, local_hidden=8, local=4
    ),
)
NETVLAD = dataclasses.replace(
    PLAIN,
    image_size=(98, 112),  # of windows of two sizes
    aggregator=NetVladConfig(clusters=4),
    projection=ProjectionConfig(dim=24),
)


PAIRVPR = dataclasses.replace(
    PLAIN, aggregator=PairVprConfig(dim=16, width=16, layers=2, hidden=8, positions=16)
)
SIDES = make_part("adapter", "side-multi-resolution", paths=2)
SELAVPRPP = dataclasses.replace(
    PLAIN,
    backbone=dataclasses.replace(PLAIN.backbone, adapter=SIDES),
    aggregator=SelaVprPpHashConfig(dim=24, bits=16),
)
OWN = {
    "fol": FOL,
    "pair-vpr": PAIRVPR,
    "transvpr": TRANSVPR,
    "selavpr": SELAVPR,
    "selavprpp": SELAVPRPP,
    "sinkhorn-divergence": PLAIN,
}


def model_of(name: str) -> tuple:
    """Random parameters of a re-ranker's model, and its configuration."""
    config = OWN.get(name, NETVLAD)
    return random_params(config), config


@pytest.fixture(scope="module")
def first_stage() -> Neighbours:
    """Of the town's five queries, all seven database images, in no order of use."""
    rng = np.random.default_rng(0)
    indices = np.stack([rng.permutation(7) for _ in range(5)])
    similarities = -np.sort(-rng.random((5, 7)).astype(np.float32), axis=1)
    return Neighbours(indices, similarities)


def rerank(
    given: Reranking,
    neighbours: Neighbours,
    database: Sequence[pathlib.Path],
    queries: Sequence[pathlib.Path],
) -> Neighbours:
    with Reranker(given, database, queries, QUIET) as second:
        return second(neighbours)


def reranking(name: str, top: int) -> Reranking:
    return Reranking(name, top, Model(*model_of(name)))


@pytest.mark.parametrize("name", [name for name in stage._METHODS if "netvlad" in name])
def test_windows_of_any_length_are_refused(name: str) -> None:
    """Their inner products would not tell which is the nearest."""
    kept = dataclasses.replace(NETVLAD, projection=ProjectionConfig(dim=24, renormalise=False))
    with pytest.raises(InputError, match=r"^rerank: found a model whose descriptors are not unit"):
        Reranking(name, 2).check(kept)
    Reranking(name, 2).check(NETVLAD)


# FoL compares 3,600 features of each image, however small the rest is.
MODELLED = [name for name, method in stage._METHODS.items() if method is not None]
NAMES = pytest.mark.parametrize(
    "name", slow_unless({*MODELLED} - {"fol", "sinkhorn-divergence", "pair-vpr"}, MODELLED)
)


@NAMES
def test_the_order_is_that_of_single_pairs(name: str, first_stage, benchmark, monkeypatch) -> None:
    """Which are fused for each query over all its candidates, however few are scored together."""
    own, config = model_of(name)
    method = stage._METHODS[name]
    monkeypatch.setattr(stage, "_AT_ONCE", 2)

    def local(paths) -> np.ndarray:
        images = np.stack([resize_image(read_image(p), config.image_size) for p in paths])
        return np.asarray(method.describe(own, images[:BATCH], config)), np.asarray(
            method.describe(own, np.resize(images[BATCH:], (BATCH, *images.shape[1:])), config)
        )

    database, queries = (
        np.concatenate(local(paths))[: len(paths)]
        for paths in (benchmark.database, benchmark.queries)
    )
    assert database.shape[1:] == method.shape(config)
    given = (own,) if method.by_params else ()
    parts = np.stack(
        [[method.score(*given, q, d[None], config)[0] for d in database] for q in queries]
    )
    assert len(np.unique(parts)) > 5
    top = 5
    found = rerank(reranking(name, top), first_stage, benchmark.database, benchmark.queries)
    for query, row in enumerate(first_stage.indices):
        scores = dict(zip(row, method.fuse(parts[query, row[:top]], config), strict=False))
        kept = sorted(row[:top], key=lambda image, scores=scores: -scores[image])
        np.testing.assert_array_equal(found.indices[query], [*kept, *row[top:]])
        # The same float32 sums, vectorised over another number of candidates.
        expected = [scores[image] for image in kept]
        np.testing.assert_allclose(found.similarities[query, :top], expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found.similarities[:, top:], first_stage.similarities[:, top:])
    assert (found.indices != first_stage.indices).any()


@NAMES
def test_an_image_is_most_like_itself(name: str, first_stage, benchmark) -> None:
    """Where the first stage had it last."""
    if name == "pair-vpr":
        pytest.skip("its score is learnt, and its weights here are random")
    own = benchmark.database[:5]
    last = np.array([np.roll(np.arange(7), -1 - i) for i in range(5)])
    neighbours = Neighbours(last, first_stage.similarities)
    found = rerank(reranking(name, 7), neighbours, benchmark.database, own)
    np.testing.assert_array_equal(found.indices[:, 0], np.arange(5))


def changed(monkeypatch, name: str, **functions: Callable) -> None:
    method = dataclasses.replace(stage._METHODS[name], **functions)
    monkeypatch.setattr(stage, "_METHODS", {**stage._METHODS, name: method})


@pytest.mark.parametrize(("name", "parts"), [("transvpr", ()), ("patch-netvlad", (2,))])
def test_equal_scores_keep_the_first_stages_order(
    name: str, parts: tuple[int, ...], first_stage, benchmark, monkeypatch
) -> None:
    """Also where they are divided by their deviation, which is 0."""
    changed(monkeypatch, name, score=lambda q, c, _: np.full((len(c), *parts), 0.1, np.float32))
    found = rerank(reranking(name, 6), first_stage, benchmark.database, benchmark.queries)
    np.testing.assert_array_equal(found.indices, first_stage.indices)
    assert np.isfinite(found.similarities).all()


def test_images_are_described_and_pairs_scored_once(first_stage, benchmark, monkeypatch) -> None:
    described, scored = [], []
    describe, score = matching.describe_transvpr, matching.count_inliers
    changed(
        monkeypatch,
        "transvpr",
        describe=lambda p, x, c: described.append(x) or describe(p, x, c),
        score=lambda q, x, c: scored.append(x) or score(q, x, c),
    )
    two = Neighbours(first_stage.indices[:, :2], first_stage.similarities[:, :2])
    candidates = len(np.unique(two.indices))
    with Reranker(
        reranking("transvpr", 2), benchmark.database, benchmark.queries, QUIET
    ) as reranker:
        folder = reranker._folder.name
        found = reranker(two)
        batches = -(-candidates // BATCH) + -(-5 // BATCH)
        assert (len(described), len(scored)) == (batches, 5)
        again = reranker(two)
        assert (len(described), len(scored)) == (batches, 5)
    np.testing.assert_array_equal(found.indices, again.indices)
    assert not pathlib.Path(folder).exists()


def test_an_evaluation_has_a_row_without_and_a_row_with(benchmark) -> None:
    own = random_params(PLAIN)
    plain = evaluate(Model(own, PLAIN), benchmark, reading=QUIET)
    with_own = reranking("transvpr", 3)
    both = evaluate(Model(own, PLAIN), benchmark, rerank=with_own, reading=QUIET)
    assert [(r.grouping, r.rerank) for r in both] == [("any", None), ("any", "transvpr:3")]
    assert both[0].recalls == plain[0].recalls
    np.testing.assert_array_equal(both[0].neighbours.indices, plain[0].neighbours.indices)
    expected = rerank(with_own, plain[0].neighbours, benchmark.database, benchmark.queries)
    np.testing.assert_array_equal(both[1].neighbours.indices, expected.indices)
    # Any order of the first three has as many right ones among them as they had.
    assert both[1].recalls[5] == plain[0].recalls[5]
    assert both[1].intervals.keys() == plain[0].intervals.keys()


def test_bits_are_searched_first_and_floats_rank_again(benchmark) -> None:
    model = Model(*model_of("selavprpp"))
    first, second = evaluate(
        model, benchmark, dtype="bits", rerank=Reranking("selavprpp", 4), reading=QUIET
    )
    assert set(np.unique(first.neighbours.similarities * 8)) <= set(range(-8, 9))  # of 16 bits
    floats = [
        np.concatenate(
            [
                np.asarray(matching.describe_selavprpp(model.params, image[None], model.config))
                for image in (resize_image(read_image(p), model.config.image_size) for p in paths)
            ]
        )[:, 0]
        for paths in (benchmark.queries, benchmark.database)
    ]
    distances = np.linalg.norm(floats[0][:, None] - floats[1][None], axis=2)
    assert second.rerank == "selavprpp:4"
    for query, row in enumerate(first.neighbours.indices[:, :4]):
        kept = row[np.argsort(distances[query, row], kind="stable")]
        np.testing.assert_array_equal(second.neighbours.indices[query, :4], kept)
        # Of single images: the program of another batch size rounds differently.
        np.testing.assert_allclose(
            second.neighbours.similarities[query, :4], -distances[query, kept], atol=1e-5
        )


@pytest.mark.parametrize("name", ["transvpr", "patch-netvlad-ransac"])
def test_the_first_stages_model_serves_where_it_can(name: str, benchmark) -> None:
    own, config = model_of(name)
    results = [
        evaluate(Model(own, config), benchmark, rerank=given, reading=QUIET)[1]
        for given in (Reranking(name, 7), Reranking(name, 7, Model(own, config)))
    ]
    assert results[0].rerank == f"{name}:7"
    for a, b in zip(*(result.neighbours for result in results), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("transvpr", "found 'transvpr', expected NAME:TOPK, as in patch-netvlad:100, with one of "),
        ("transvpr:-3", "expected NAME:TOPK"),
        ("transvpr:" + 5000 * "1", "expected NAME:TOPK"),
        ("transvpr:1", "found transvpr:1, expected at least 2 retrievals"),
        (
            "superglue:10",
            "rerank: found 'superglue', expected one of fol, local, pair-vpr, patch-n",
        ),
    ],
)
def test_what_cannot_be_read_is_named(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_reranking(text)


@pytest.mark.parametrize(
    ("given", "config", "words"),
    [
        ("transvpr:3", PLAIN, "found a model with aggregator salad and size rule fixed, exp"),
        ("patch-netvlad:3", TRANSVPR, "aggregator transvpr and size rule fixed, expected netvlad"),
        ("transvpr:8", TRANSVPR, "found transvpr:8 over a database of 7 images, expected at most"),
        (
            "patch-netvlad:3",
            dataclasses.replace(NETVLAD, image_size=(28, 56)),
            "found images of 28 x 56, expected at least 42 x 42",
        ),
        (
            "fol:3",
            FOL.resized((252, 322)),
            "found images of 252 x 322, expected at least 266 rows of pixels and 225 patches",
        ),
        ("fol:3", FOL.resized((266, 154)), "found images of 266 x 154, expected at least 266 row"),
    ],
)
def test_what_does_not_fit_is_found_before_any_work(
    given: str, config: ModelConfig, words: str, benchmark, monkeypatch
) -> None:
    monkeypatch.setattr("crisalad_jax.retrieval.describe.token_rows", None)
    rerank = parse_reranking(given)
    with pytest.raises(InputError, match=words):
        evaluate(
            Model(random_params(config), config),
            benchmark,
            rerank=rerank,
            reading=Reading(quiet=True),
        )


def test_a_full_disk_is_one_line(first_stage, benchmark, monkeypatch) -> None:
    usage = stage.shutil.disk_usage("/")._replace(free=1000)
    monkeypatch.setattr(stage.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(InputError, match=r"GiB free, expected .* for the local features of 5 im"):
        rerank(reranking("transvpr", 3), first_stage, benchmark.database, benchmark.queries)


@pytest.mark.slow
def test_tokens_are_compared_by_their_divergence_as_otts(benchmark) -> None:
    """In float16 tokens: unit vectors to 5e-4, and their costs, of 0 to 4, to 4e-3 at most."""
    own, config = model_of("sinkhorn-divergence")
    shape = (BATCH, *config.image_size, 3)
    images = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    local = np.asarray(extract_tokens(own, images, config).local, np.float64)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    rows = np.asarray(divergence.describe(own, images, config))
    assert rows.shape[1:] == divergence.shape(config)
    found = np.asarray(divergence.scores(rows[0], rows, config))

    def expected(other: np.ndarray) -> float:
        options = {"epsilon": 0.1, "solve_kwargs": {"threshold": 1e-6, "max_iterations": 5000}}
        return -float(ott_divergence(PointCloud, local[0], other, scale_cost=1.0, **options)[0])

    assert abs(found[0]) < 1e-5
    assert len(np.unique(found.round(3))) > 1
    np.testing.assert_allclose(found, [expected(other) for other in local], atol=4e-3)


def test_a_model_without_local_tokens_is_refused() -> None:
    config = dataclasses.replace(PLAIN, aggregator="gem")
    with pytest.raises(
        InputError, match=r"^rerank: found a model with aggregator gem, which has no"
    ):
        Reranking("sinkhorn-divergence", 2).check(config)
