"""Mined tuples: their pairs and losses against torch, the mining by hand, and runs that resume."""

import dataclasses
import itertools
import pathlib
import unittest.mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from crisalad_jax import recipe
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.data.augmentations import NoAugmentation
from crisalad_jax.data.places import read_places
from crisalad_jax.data.query_set import QuerySet, read_query_set
from crisalad_jax.data.reading import image_batches
from crisalad_jax.experiments.train import train
from crisalad_jax.nn.aggregators.selavpr import SelaVprConfig
from crisalad_jax.nn.model import describe
from crisalad_jax.training.config import MiningConfig, TrainConfig
from crisalad_jax.training.loop import fit
from crisalad_jax.training.losses import LossConfig, Role, metric_loss, tuple_labels, tuple_pairs
from crisalad_jax.training.losses.pairwise import SelaVprLoss, TripletConfig
from crisalad_jax.training.mining import Mined, Miner
from crisalad_jax.training.optimisers import Adam, Sgd
from crisalad_jax.training.run_files import checksum_of_places
from crisalad_jax.training.schedules import ConstantSchedule
from crisalad_jax.utils.errors import InputError
from tests.conftest import RECIPE, assert_equal
from tests.data.test_query_set import write_street
from tests.training.test_loop import assert_same_params, interrupt, metrics_of

ROLES = np.array([[0, 1, 2, 2, 2], [0, 1, 2, 3, 3], [0, 1, 3, 3, 3]])
"""Three tuples: of three negatives, of one, and of none."""


def unit(x: np.ndarray) -> np.ndarray:
    return (x / np.linalg.norm(x, axis=-1, keepdims=True)).astype(np.float32)


def batch(seed: int, dim: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors of the tuples of ROLES, and their labels."""
    drawn = np.random.default_rng(seed).standard_normal((ROLES.size, dim))
    return unit(drawn), tuple_labels(ROLES).ravel()


def triplets() -> list[tuple[int, int, int]]:
    """(query, positive, negative) of ROLES, by a loop."""
    width = ROLES.shape[1]
    return [
        (start, start + 1, start + place)
        for start, row in zip(itertools.count(0, width), ROLES, strict=False)
        for place, role in enumerate(row)
        if role == Role.NEGATIVE
    ]


def test_pairs_of_tuples_by_a_loop():
    _, labels = batch(0)
    pairs = tuple_pairs(jnp.asarray(labels))
    expected = {(query, negative) for query, _, negative in triplets()}
    assert {tuple(pair) for pair in np.argwhere(pairs.negatives).tolist()} == expected
    assert np.argwhere(pairs.positives).tolist() == [[0, 1], [5, 6], [10, 11]]
    valid = np.ones(len(labels), bool)
    valid[[1, 5]] = False
    pairs = tuple_pairs(jnp.asarray(labels), valid=jnp.asarray(valid))
    assert np.argwhere(pairs.positives).tolist() == [[10, 11]]
    assert np.argwhere(pairs.negatives).tolist() == [[0, 2], [0, 3], [0, 4]]


@pytest.mark.parametrize("seed", range(4))
def test_triplets_of_tuples_are_torchs(seed):
    """Nanne/pytorch-NetVlad sums torch's loss of each triplet and divides by their number.

    Torch adds 1e-6 to each of 8 differences, which moves a distance by at most 3e-6. Gradients of
    triplets are compared in losses/test_losses.py.
    """
    descriptors, labels = batch(seed)
    margin = 0.1**0.5
    config = LossConfig(kind=TripletConfig(margin, average="all"), miner="none")

    arrays = jnp.asarray(descriptors), jnp.asarray(labels)
    found = metric_loss(*arrays, config, pairs=tuple_pairs(arrays[1])).loss
    theirs = torch.tensor(descriptors)
    summed = torch.nn.TripletMarginLoss(margin=margin, p=2, reduction="sum")
    total = sum(summed(*(theirs[[image]] for image in each)) for each in triplets())
    np.testing.assert_allclose(found, float(total) / len(triplets()), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("seed", "lost"), [(0, []), (1, []), (2, [1])])
def test_the_loss_of_selavpr_by_a_loop_in_torch(seed, lost):
    """Equations of Lu et al. (ICLR 2024), section 3.3, image by image.

    A query whose positive is lost, as it could not be read, counts nowhere.

    Descriptors as above; local similarities are means of inner products of order 1 in float32.
    """
    descriptors, labels = batch(seed)
    generator = np.random.default_rng(seed)
    dense = unit(generator.standard_normal((ROLES.size, 30, 5)))
    config = LossConfig(kind=SelaVprLoss(), miner="none")
    valid = jnp.asarray(~np.isin(np.arange(ROLES.size), lost))
    counted = [each for each in triplets() if not {*each} & {*lost}]

    def loss(dense):
        pairs = tuple_pairs(jnp.asarray(labels), valid=valid)
        arrays = jnp.asarray(descriptors), jnp.asarray(labels)
        return metric_loss(*arrays, config, pairs=pairs, tokens=dense).loss

    found, gradient = jax.value_and_grad(loss)(jnp.asarray(dense))
    theirs = torch.tensor(dense, requires_grad=True)

    def similarity(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        products = first @ second.T
        pairs = [
            (i, int(products[i].argmax()))
            for i in range(len(first))
            if int(products[:, int(products[i].argmax())].argmax()) == i
        ]
        return torch.stack([(first[i] * second[j]).sum() for i, j in pairs]).mean()

    total = torch.zeros(())
    summed = torch.nn.TripletMarginLoss(margin=0.1, p=2, reduction="sum")
    images = torch.tensor(descriptors)
    for query, positive, negative in counted:
        total = total + summed(*(images[[image]] for image in (query, positive, negative)))
        near, far = (similarity(theirs[query], theirs[other]) for other in (positive, negative))
        total = total + torch.relu(far - near)
    expected = total / len(counted)
    expected.backward()
    np.testing.assert_allclose(found, expected.item(), rtol=0, atol=1e-5)
    assert theirs.grad is not None
    assert np.abs(theirs.grad.numpy()).max() > 0
    np.testing.assert_allclose(gradient, theirs.grad.numpy(), rtol=0, atol=1e-6)


def test_a_loss_of_tuples_refuses_places_and_models_without_local_features():
    descriptors, labels = batch(0)
    config = LossConfig(kind=SelaVprLoss(), miner="none")
    arrays = jnp.asarray(descriptors), jnp.asarray(labels)
    with pytest.raises(InputError, match="loss selavpr: found no tuples, expected the pairs"):
        metric_loss(*arrays, config)
    with pytest.raises(InputError, match="loss selavpr: found no tokens, expected the aggregator"):
        metric_loss(*arrays, config, pairs=tuple_pairs(arrays[1]))


def line_set(database: list[float], queries: list[float]) -> QuerySet:
    """A set on a street: positions in metres, of which 10 are a positive's and 25 not a negative's.

    Images have no files; their descriptors are the tests' own.
    """
    apart = np.abs(np.subtract.outer(queries, database))
    kept = [q for q, row in enumerate(apart) if (row <= 10).any()]
    return QuerySet(
        pathlib.Path("street"),
        tuple(f"{n}.jpg" for n in range(len(database) + len(queries))),
        len(database),
        len(database) + np.array(kept, np.int64),
        tuple(np.flatnonzero(apart[q] <= 10) for q in kept),
        tuple(np.flatnonzero(apart[q] <= 25) for q in kept),
    )


STREET = line_set([0, 5, 20, 100, 200, 300, 400], [1, 101, 1000])
# On a line: the query at 1 m has its positives at 0.3 and 0.1, something near at 0.05, which is no
# negative, and negatives at 0.2, 0.9, 0.35 and 2.
LINE = np.array([0.3, 0.1, 0.05, 0.2, 0.9, 0.35, 2.0, 0.0, 0.21, 9.0])


def on_the_line(paths: list[pathlib.Path], line: np.ndarray = LINE) -> np.ndarray:
    numbers = [int(path.stem) for path in paths]
    return np.stack([line[numbers], np.zeros(len(numbers))], axis=1).astype(np.float32)


def miner_of(mining: MiningConfig, queries: QuerySet = STREET, *, seed=0, batch=1) -> Miner:
    config = TrainConfig(
        trainable="head",
        mining=mining,
        places_per_batch=batch,
        images_per_place=2 + mining.negatives,
        seed=seed,
    )
    return Miner(config, queries)


def mined(mining: MiningConfig, describe=on_the_line, before=None, seed=0, step=0) -> Mined:
    """The two tuples of the street, in the order of their queries."""
    miner = miner_of(mining, seed=seed)
    if before is not None:
        miner.mined = miner.mined._replace(hardest=before)
    miner.mine(2 * step, describe)
    order = miner.mined.images[:, 0].argsort()
    return miner.mined._replace(images=miner.mined.images[order], roles=miner.mined.roles[order])


@pytest.mark.parametrize("kind", ["whole", "sample"])
def test_tuples_by_hand(kind):
    found = mined(MiningConfig(kind=kind, negatives=3, candidates=7, margin=0.15))
    # Query 7: its nearest positive is 1, at 0.1; 3 (0.2) violates 0.1 + 0.15, 5 and 4 do not.
    assert found.images[0].tolist() == [7, 1, 3, 5, 4]
    assert found.roles[0].tolist() == [0, 1, 2, 3, 3]
    # Query 8, at 0.21 and 101 m: its positive is 3, at 0.01; 0 (0.09), 1 (0.11) and 5 (0.14)
    # violate 0.01 + 0.15.
    assert found.images[1].tolist() == [8, 3, 0, 1, 5]
    assert found.roles[1].tolist() == [0, 1, 2, 2, 2]
    hardest = mined(MiningConfig(kind=kind, negatives=3, candidates=7))
    assert hardest.roles.tolist() == [[0, 1, 2, 2, 2]] * 2
    assert found.hardest[0].tolist() == [3, -1, -1]


def test_a_query_without_a_violation_keeps_its_last_negatives():
    config = MiningConfig(kind="whole", negatives=3, candidates=7, margin=0.05)
    before = np.array([[3, 5, -1], [0, -1, -1]], np.int32)
    found = mined(config, before=before)
    # Nothing is within 0.1 + 0.05 of the first query; 0 is within 0.01 + 0.05 of no other's.
    assert found.roles[0].tolist() == [0, 1, 3, 3, 3]
    assert found.hardest[0].tolist() == [3, 5, -1]


def test_a_negative_at_the_margin_is_none():
    config = MiningConfig(kind="whole", negatives=3, candidates=7, margin=0.5)
    exact = np.array([0.25, 0.25, 9, 0.75, 0.5, 0.7, 2.0, 0.0, 9, 9])

    found = mined(config, lambda paths: on_the_line(paths, exact))
    assert found.images[0].tolist() == [7, 0, 4, 5, 3]
    assert found.roles[0].tolist() == [0, 1, 2, 2, 3]  # 3 is at 0.75 = 0.25 + 0.5


def test_candidates_are_drawn_by_the_seed_and_the_step():
    config = MiningConfig(kind="whole", negatives=2, candidates=2)
    seen = {
        (seed, step): tuple(mined(config, seed=seed, step=step).images[0].tolist())
        for seed in range(4)
        for step in range(4)
    }
    assert len({seen[seed, 0] for seed in range(4)}) > 1
    assert len({seen[0, step] for step in range(4)}) > 1
    assert seen[1, 1] == tuple(mined(config, seed=1, step=1).images[0].tolist())


def test_negatives_of_earlier_rounds_are_candidates_again():
    """One candidate is drawn of seven; the hardest before comes to it."""
    config = MiningConfig(kind="whole", negatives=1, candidates=1)
    hardest, seen = None, []
    for step in range(30):
        round_ = mined(config, before=hardest, step=step)
        hardest = round_.hardest
        seen.append(abs(LINE[round_.images[0, 2]] - LINE[7]) if round_.roles[0, 2] == 2 else 9)
    assert seen == sorted(seen, reverse=True)  # never easier again
    assert seen[-1] == pytest.approx(0.2)  # and once all were drawn, the hardest of all


def test_too_few_candidates_leave_spare_images():
    found = mined(MiningConfig(kind="whole", negatives=6, candidates=7))
    # Four database images are negatives of the first query; its positive fills the tuple.
    assert found.images[0].tolist() == [7, 1, 3, 5, 4, 6, 1, 1]
    assert found.roles[0].tolist() == [0, 1, 2, 2, 2, 2, 3, 3]


def test_images_that_cannot_be_read_are_no_negatives():
    line = LINE.copy()
    line[[1, 3]] = np.nan
    config = MiningConfig(kind="whole", negatives=3, candidates=7)
    found = mined(config, lambda paths: on_the_line(paths, line))
    assert found.images[0].tolist() == [7, 0, 5, 4, 6]


@pytest.mark.parametrize("kind", ["whole", "sample"])
def test_mining_is_that_of_all_distances(kind):
    """Random descriptors and places, against a sort of all distances in float64."""
    generator = np.random.default_rng(4)
    queries = line_set(
        generator.uniform(0, 2000, 120).tolist(), generator.uniform(0, 2000, 30).tolist()
    )
    descriptors = unit(generator.standard_normal((150, 16)))
    miner = miner_of(MiningConfig(kind=kind, negatives=5, candidates=120), queries)
    miner.mine(0, lambda paths: descriptors[[int(path.stem) for path in paths]])
    wide = descriptors.astype(np.float64)
    assert sorted(miner.mined.images[:, 0]) == queries.queries.tolist()
    for row in miner.mined.images:
        far = np.linalg.norm(wide - wide[row[0]], axis=1)
        query = queries.queries.tolist().index(row[0])
        assert row[1] == min(queries.positives[query], key=lambda image: far[image])
        others = np.setdiff1d(np.arange(120), queries.near[query])
        assert row[2:].tolist() == sorted(others, key=lambda image: far[image])[:5]


def queries_of(miner: Miner, rounds: range) -> list[list[int]]:
    """The queries of some rounds."""
    found = []
    for number in rounds:
        miner.mine(number * miner.steps_per_round, on_the_line)
        found.append(miner.mined.images[:, 0].tolist())
    return found


def test_every_query_has_its_turn_in_an_epoch():
    street = line_set([0, 5, 20], [1.0] * 7)
    turns = MiningConfig(kind="whole", negatives=1, candidates=3, queries_per_round=3)
    miner = miner_of(turns, street)
    assert (miner.steps_per_round, miner.steps_per_epoch) == (2, 6)
    first, second = queries_of(miner, range(3)), queries_of(miner, range(3, 6))
    assert len(set(itertools.chain(*first))) == len(set(itertools.chain(*second))) == 6
    assert first != second
    drawn = queries_of(
        miner_of(dataclasses.replace(turns, queries_per_epoch=90), street), range(25)
    )
    assert all(len(set(each)) == len(each) for each in drawn)
    assert len({tuple(each) for each in drawn}) > 1


def test_rounds_of_pitts30k_are_the_codes():
    """Nanne splits n queries into ceil(n / 1,000) parts; pitts30k_train has some 7,320."""
    street = dataclasses.replace(STREET, queries=np.arange(7320))
    netvlad = Miner(recipe("b14", "netvlad"), street)
    assert (netvlad.steps_per_epoch, netvlad.steps_per_round) == (8 * (915 // 4), 915 // 4)
    selavpr = Miner(recipe("l14", "selavpr"), street)
    assert (selavpr.steps_per_epoch, selavpr.steps_per_round) == (30 * 250, 250)
    with pytest.raises(InputError, match="street: found rounds of 2 queries, of 2 with"):
        Miner(recipe("b14", "netvlad"), STREET)
    assert miner_of(MiningConfig(kind="whole"), batch=2).steps_per_epoch == 1  # both queries


def test_recipes_are_the_codes():
    """Constants of Nanne/pytorch-NetVlad, QVPR/Patch-NetVLAD and Lu-Feng/SelaVPR."""
    netvlad, patches, selavpr = (
        recipe(preset, name)
        for preset, name in (("b14", "netvlad"), ("b14", "patch-netvlad"), ("l14", "selavpr"))
    )
    for config in netvlad, patches:
        assert config.model.image_size == (480, 640)
        assert config.loss == LossConfig(kind=TripletConfig(0.1**0.5, "all"), miner="none")
        sgd = config.optimiser
        found = sgd.kind, sgd.learning_rate, sgd.weight_decay
        assert found == (Sgd(momentum=0.9), 1e-4, 1e-3)
        # Both stop after more than 10 epochs without gain.
        assert (config.epochs, config.patience, config.monitor) == (30, 11, "R@5")
        assert (config.places_per_batch, config.trainable) == (4, "last-1-blocks,head")
    assert netvlad.mining == MiningConfig("whole", 10, 1000, 1000, None, 10.0, 25.0, 0.1**0.5)
    assert patches.mining == MiningConfig("sample", 5, 1000, 1000, None, 10.0, 25.0, None)
    assert (netvlad.images_per_place, patches.images_per_place) == (12, 7)
    assert netvlad.model.descriptor_dim == 64 * 512
    assert patches.model.descriptor_dim == 16 * 512
    assert selavpr.mining == MiningConfig("sample", 2, 1000, 1000, 30_000, 10.0, 25.0, None)
    assert selavpr.loss == LossConfig(kind=SelaVprLoss(margin=0.1), miner="none")
    assert (selavpr.places_per_batch, selavpr.images_per_place) == (4, 4)
    assert (selavpr.model.descriptor_dim, selavpr.model.image_size) == (1024, (224, 224))
    adam = selavpr.optimiser
    found = adam.kind, adam.learning_rate, adam.weight_decay, adam.schedule
    assert found == (Adam(), 1e-5, 0, ConstantSchedule())
    assert (selavpr.epochs, selavpr.patience, selavpr.monitor) == (50, 3, "R@5")
    assert selavpr.trainable == "adapters,head"


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> pathlib.Path:
    return write_street(tmp_path_factory.mktemp("street"))


CONFIG = dataclasses.replace(
    RECIPE,
    model=dataclasses.replace(RECIPE.model, aggregator=SelaVprConfig(hidden=8, local=4)),
    loss=LossConfig(kind=SelaVprLoss(margin=2.0), miner="none"),  # which every triplet violates
    augmentation=NoAugmentation(),
    mining=MiningConfig(kind="whole", negatives=2, candidates=5, queries_per_round=5),
    places_per_batch=2,
    images_per_place=4,
    epochs=2,
)
"""Two rounds an epoch, of two batches of two tuples."""


def test_training_reads_the_set_as_configured(street, tmp_path, monkeypatch):
    """Radii, and the images of a file, reach the reader."""
    read = unittest.mock.Mock(side_effect=InputError("read"))
    monkeypatch.setattr("crisalad_jax.training.start.read_query_set", read)
    mining = dataclasses.replace(CONFIG.mining, positive_radius=4.0, negative_radius=50.0)
    config = dataclasses.replace(CONFIG, mining=mining, epochs=1)
    with pytest.raises(InputError, match=r"^read$"):
        train(config, tmp_path / "set.mat", tmp_path / "run", images=street, quiet=True)
    radii = {"positive_radius": 4.0, "negative_radius": 50.0}
    read.assert_called_once_with(tmp_path / "set.mat", **radii, images=street, on_bad_image="stop")


@pytest.mark.slow
def test_unreadable_images_are_told_in_mining(tmp_path, capfd):
    root = write_street(tmp_path / "street")
    broken = sorted((root / "images" / "train" / "database").iterdir())[:3]
    for path in broken:
        path.write_bytes(b"no picture")
    config = dataclasses.replace(CONFIG, epochs=1)
    fit(config, read_query_set(root), tmp_path / "run", on_bad_image="skip")
    assert "; 3 unreadable images left out" in " ".join(capfd.readouterr().err.split())


def test_checksums_tell_other_positives(street):
    narrow, wide = read_query_set(street), read_query_set(street, negative_radius=97)
    assert checksum_of_places(narrow) != checksum_of_places(wide)
    fewer = dataclasses.replace(narrow, positives=tuple(each[:1] for each in narrow.positives))
    assert checksum_of_places(narrow) != checksum_of_places(fewer)


def test_batches_hold_the_tuples_and_their_roles(street):
    queries = read_query_set(street)
    images = np.array([[20, 0, 4, 6], [21, 2, 8, 0], [22, 4, 0, 2], [23, 6, 2, 0]], np.int32)
    roles = np.array([[0, 1, 2, 2], [0, 1, 2, 3], [0, 1, 2, 2], [0, 1, 3, 3]], np.int32)

    def batches(step: int, **reading):
        miner = Miner(CONFIG, queries, **reading)
        miner.mined = miner.mined._replace(step=np.array(2), images=images, roles=roles)
        return miner.batches(step)

    first, second = batches(2)
    assert first.indices.tolist() == images[:2].ravel().tolist()
    assert second.labels.tolist() == [8, 9, 10, 10, 12, 13, 15, 15]
    (again,) = batches(3)
    np.testing.assert_array_equal(again.images, second.images)
    (half, _) = batches(2, part=(1, 2))
    np.testing.assert_array_equal(half.images, first.images[4:])


@pytest.fixture(scope="module")
def whole(street, tmp_path_factory) -> pathlib.Path:
    out = tmp_path_factory.mktemp("runs") / "whole"
    assert fit(CONFIG, read_query_set(street), out, quiet=True).steps == 8
    return out


@pytest.mark.parametrize("call", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_a_run_interrupted_in_a_round_goes_on_with_its_tuples(
    street, whole, tmp_path, monkeypatch, call
):
    """Ends at a step, or (call 1) as the first tuples were just mined."""
    queries, out = read_query_set(street), tmp_path / "run"
    interrupt(monkeypatch, "train_step", call, CONFIG, queries, out, quiet=True)
    fit(CONFIG, queries, out, quiet=True)
    assert metrics_of(out) == metrics_of(whole)
    assert_same_params(*(load_weights(each / "last.safetensors")[0] for each in (out, whole)))
    assert not [path for path in out.rglob("*") if "tmp" in path.name]


def test_every_round_is_mined_by_the_model_as_it_is(street, tmp_path, monkeypatch):
    """Against another miner: the model of each round's begin, and the last negatives."""
    queries, out, seen = read_query_set(street), tmp_path / "run", []
    mine = Miner.mine

    def recorded(self, step, describe):
        words = mine(self, step, describe)
        (params,) = describe.args
        seen.append((jax.tree.map(np.array, params), self.mined))  # a step uses up its buffers
        return words

    monkeypatch.setattr(Miner, "mine", recorded)
    config = dataclasses.replace(
        CONFIG, mining=dataclasses.replace(CONFIG.mining, candidates=3), epochs=2
    )
    fit(config, queries, out, quiet=True)
    assert [int(mined.step) for _, mined in seen] == [0, 2, 4, 6]
    again = Miner(config, queries)
    for number, (params, found) in enumerate(seen):

        def describe_all(paths, params=params):
            (batch,) = image_batches(
                paths,
                image_size=config.model.image_size,
                batch_size=len(paths),
                preprocessing=config.model.preprocessing,
            )
            alone = jnp.eye(len(paths), dtype=bool)
            return np.asarray(describe(params, batch.images, config.model, mask=alone))

        mine(again, 2 * number, describe_all)
        assert_equal(again.mined, found)
    with pytest.raises(AssertionError):  # of other parameters, which the steps between changed
        assert_equal(seen[0][0], seen[1][0])


def test_the_wrong_kind_of_set_is_refused(street, shared, tmp_path):
    out = tmp_path / "run"
    city = read_places(shared / "city", min_images=2)
    with pytest.raises(InputError, match="places: found Places with mining 'whole', expected Q"):
        fit(CONFIG, city, out, quiet=True)
    with pytest.raises(InputError, match="places: found QuerySet with mining 'none', expected P"):
        fit(RECIPE, read_query_set(street), out, quiet=True)
    with pytest.raises(InputError, match="expected images/"):
        train(CONFIG, shared / "city", out, quiet=True)
    with pytest.raises(InputError, match="--data-images: found for a recipe"):
        train(RECIPE, shared / "city", out, images=tmp_path, quiet=True)
    with pytest.raises(InputError, match="found images for the layout utm, which"):
        train(CONFIG, street, out, images=tmp_path, quiet=True)
    assert not out.exists()


WHOLE = MiningConfig(kind="whole")


@pytest.mark.parametrize(
    ("config", "changes", "message"),
    [
        (WHOLE, {"negatives": 0}, r"MiningConfig\.negatives: found 0"),
        (WHOLE, {"candidates": 9}, r"MiningConfig\.candidates: found 9, expected at l"),
        (WHOLE, {"positive_radius": 30.0}, r"positive_radius: found 30.0, expected metres above 0"),
        (WHOLE, {"margin": -1.0}, r"MiningConfig\.margin: found -1.0"),
        (CONFIG, {"images_per_place": 5}, "images_per_place: found 5, expected 4 with mined tup"),
        (CONFIG, {"mining": MiningConfig()}, "kind: found 'none', expected 'whole' or 'sample'"),
        (
            dataclasses.replace(CONFIG, loss=recipe("tiny", "crisalad").loss),
            {"loss": recipe("tiny", "cosplace").loss},
            "kind: found 'whole', expected 'none' for loss large-m",
        ),
    ],
)
def test_a_configuration_that_does_not_fit_is_refused(config, changes, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(config, **changes)
