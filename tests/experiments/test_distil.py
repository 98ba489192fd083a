"""A student that learns a teacher's descriptors: what it learns, its cache, its resumption."""

import dataclasses

import jax
import numpy as np
import pytest

from crisalad_jax.checkpoints.load import load
from crisalad_jax.checkpoints.weights import save_weights
from crisalad_jax.cli import main
from crisalad_jax.cli.distil import parse
from crisalad_jax.data.places import group_images, read_places
from crisalad_jax.data.reading import Reading
from crisalad_jax.data.sources import join_sources, open_sources
from crisalad_jax.experiments import distil as module
from crisalad_jax.experiments.distil import distil, teachers_descriptors
from crisalad_jax.nn.model import Model, describe, init_crisalad
from crisalad_jax.retrieval.extract import extract
from crisalad_jax.training.callbacks import Callback, StopTraining
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.loop import fit
from crisalad_jax.training.losses import LossConfig
from crisalad_jax.training.losses.distil import DistilConfig
from crisalad_jax.utils.errors import InputError
from tests.conftest import MODEL, RECIPE, assert_equal, random_params

STUDENT = dataclasses.replace(
    RECIPE,
    model=dataclasses.replace(MODEL, cross_image="none"),
    loss=LossConfig(kind="distil"),
    places_per_batch=8,
    images_per_place=1,
    min_images=1,
    epochs=6,
)
"""Most tests have the same steps, so that one program is compiled."""
TERMS = ("loss.cosine", "loss.relations", "loss.neighbours")
QUIET = Reading(quiet=True, batch_size=8)


@pytest.fixture(scope="module")
def teacher() -> Model:
    return Model(random_params(MODEL), MODEL)


def test_a_student_comes_near_its_teacher(shared, tmp_path) -> None:
    """It has the teacher's own form here, so that it can."""
    config = dataclasses.replace(STUDENT, augmentation="none")
    teacher = Model(random_params(config.model), config.model)
    images = shared / "city" / "Images"
    result = distil(config, teacher, images, tmp_path / "run", reading=QUIET)
    assert result.steps == 18  # 24 images, 8 a step
    steps = read_metrics(tmp_path / "run" / "metrics.jsonl")
    for name in TERMS:
        first, last = (np.mean([step[name] for step in part]) for part in (steps[:3], steps[-3:]))
        assert last < 0.85 * first, name  # by 22 % or more in 18 steps
    total = sum(steps[0][name] for name in TERMS)
    assert steps[0]["loss"] == pytest.approx(total, rel=1e-5)  # a sum in float32


def test_targets_follow_their_images(shared, teacher, monkeypatch, tmp_path) -> None:
    """Those of a step are the teacher's descriptors of its images."""
    places = group_images(join_sources(open_sources(shared / "city" / "Images")))
    targets = teachers_descriptors(teacher, places, reading=QUIET)
    paths = [places.path(image) for image in range(len(places.files))]
    expected = extract(teacher, paths, reading=QUIET).descriptors
    np.testing.assert_array_equal(targets, expected)
    seen = []
    from crisalad_jax.training import trainer

    step = trainer.train_step

    def spy(*arguments):
        seen.append((np.asarray(arguments[2]), np.asarray(arguments[-1])))
        return step(*arguments)

    monkeypatch.setattr(trainer, "train_step", spy)
    taught = LossConfig(kind=DistilConfig(teacher_dim=targets.shape[1]))
    config = dataclasses.replace(STUDENT, augmentation="none", loss=taught)
    fit(config, places, tmp_path / "run", targets=targets, quiet=True)
    assert len(seen) == 18
    for pixels, given in seen[:4]:
        # Cross-image attention relates the images of a batch, so each is described by itself.
        alone = [describe(teacher.params, pixels[i : i + 1], teacher.config)[0] for i in range(8)]
        np.testing.assert_allclose(given, alone, atol=1e-5)  # unit vectors, float32


@pytest.mark.slow  # runs of `train` resume the same way
def test_a_resumed_run_has_the_same_bits(shared, teacher, tmp_path) -> None:
    class Stop(Callback):
        def on_step(self, values):
            if values["step"] == 4:
                raise StopTraining

    images = shared / "city" / "Images"
    whole = distil(STUDENT, teacher, images, tmp_path / "whole", reading=QUIET)
    distil(STUDENT, teacher, images, tmp_path / "parts", reading=QUIET, callbacks=[Stop()])
    parts = distil(STUDENT, teacher, images, tmp_path / "parts", reading=QUIET)
    assert parts.steps == whole.steps == 18
    assert_equal(parts.params, whole.params)


def test_the_teacher_describes_once(shared, teacher, monkeypatch) -> None:
    places = group_images(join_sources(open_sources(shared / "city" / "Images" / "Aston")))
    first = np.array(teachers_descriptors(teacher, places, reading=QUIET))

    def refuse(*_, **__):
        raise AssertionError("described again")

    monkeypatch.setattr(module, "extract", refuse)
    np.testing.assert_array_equal(teachers_descriptors(teacher, places, reading=QUIET), first)
    other = Model(init_crisalad(jax.random.key(9), MODEL), MODEL)
    with pytest.raises(AssertionError, match="described again"):
        teachers_descriptors(other, places, reading=QUIET)


def test_an_image_that_changed_is_described_again(city, teacher) -> None:
    folder = city / "Images" / "Aston"
    places = group_images(join_sources(open_sources(folder)))
    before = np.array(teachers_descriptors(teacher, places, reading=QUIET))
    picture, other = (folder / name for name in (places.files[0], places.files[5]))
    picture.write_bytes(other.read_bytes())
    after = teachers_descriptors(teacher, places, reading=QUIET)
    np.testing.assert_array_equal(after[0], before[5])
    np.testing.assert_array_equal(after[1:], before[1:])


def test_an_unreadable_image_is_skipped_by_both(city, teacher, tmp_path) -> None:
    folder = city / "Images"
    broken = sorted((folder / "Aston").iterdir())[2]
    broken.write_bytes(b"no picture")
    with pytest.raises(InputError, match=broken.name):
        distil(STUDENT, teacher, folder, tmp_path / "run", reading=QUIET)
    assert not (tmp_path / "run").exists()
    skip = dataclasses.replace(QUIET, on_bad_image="skip")
    result = distil(STUDENT, teacher, folder, tmp_path / "run", reading=skip)
    assert result.skipped_images == 6  # once an epoch


def test_labels_count_with_places(shared, teacher, tmp_path) -> None:
    kind = DistilConfig(labels=1.0)
    config = dataclasses.replace(
        STUDENT, loss=LossConfig(kind=kind), places_per_batch=4, images_per_place=2, min_images=2
    )
    config = dataclasses.replace(config, epochs=1)
    distil(config, teacher, None, tmp_path / "run", data=shared / "city", reading=QUIET)
    steps = read_metrics(tmp_path / "run" / "metrics.jsonl")
    assert all(step["loss.labels"] > 0 for step in steps)


def test_what_does_not_fit_is_refused(shared, teacher, tmp_path) -> None:
    images, out = shared / "city" / "Images", tmp_path / "run"
    with pytest.raises(InputError, match="--images, --data: found both, expected one"):
        distil(STUDENT, teacher, images, out, data=shared / "city")
    with pytest.raises(InputError, match="--place-frames, and --fps or --topic with either"):
        distil(STUDENT, teacher, None, out, data=shared / "city", fps=2.0)
    with pytest.raises(InputError, match="loss: found multi-similarity, expected distil"):
        distil(RECIPE, teacher, images, out)
    places = read_places(shared / "city", min_images=2)
    with pytest.raises(InputError, match="targets: found none for loss distil, expected a descrip"):
        fit(STUDENT, places, out)
    with pytest.raises(InputError, match=r"targets: found shape \(24, 3\) .*, expected none"):
        fit(RECIPE, places, out, targets=np.zeros((24, 3), np.float32))
    with pytest.raises(InputError, match=r"TrainConfig\.images_per_place: found 1"):
        dataclasses.replace(STUDENT, loss=RECIPE.loss)
    assert not out.exists()


def test_the_command(shared, tmp_path, capsys) -> None:
    start = Model(random_params(STUDENT.model), STUDENT.model)
    save_weights(tmp_path / "start.safetensors", start)
    out, weights = tmp_path / "run", str(tmp_path / "start.safetensors")
    call = ["distil", "--teacher", "hog", "--out", str(out), "--quiet", "--epochs", "1"]
    call += ["--validate-every", "1", "--places-per-batch", "8"]
    call += ["--optimiser.learning-rate", "1e-12"]
    images = ["--images", str(shared / "city" / "Images")]
    val = ["--val", str(shared / "town")]
    assert main([*call, *images, *val, "--student", weights]) == 0
    said = capsys.readouterr().out
    assert "24 images; the student has" in said
    assert "3 steps, best R@5" in said
    found = load(out / "last.safetensors")
    assert found.config == STUDENT.model
    for ours, theirs in zip(*map(jax.tree.leaves, (found.params, start.params)), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)  # three steps of 1e-12, and decay
    for given, words in (
        ([*images, "--student", weights], "the run started from other validation than are given"),
        (["--student", "tiny"], "--images, --data: found none, expected one"),
        (
            [*images, "--student", str(shared / "weights.safetensors")],
            "student: found cross-image encoder transformer, expected none",
        ),
    ):
        assert main([*call, *given]) == 2
        assert words in capsys.readouterr().err


def test_parts_have_the_students_size() -> None:
    call = ["--teacher", "hog", "--student", "tiny", "--images", "a", "--out", "b"]
    call += ["--model.backbone", "resnet", "--model.aggregator", "conv-ap"]
    found = parse("distil", call).settings.model.backbone
    assert (found.layers, found.stages) == (18, 2)  # of preset tiny


def test_a_teacher_of_another_size_describes_again(shared, teacher) -> None:
    places = group_images(join_sources(open_sources(shared / "city" / "Images" / "Aston")))
    small = np.array(teachers_descriptors(teacher, places, reading=QUIET))
    resized = teacher._replace(config=dataclasses.replace(MODEL, image_size=(56, 56)))
    assert np.abs(teachers_descriptors(resized, places, reading=QUIET) - small).max() > 1e-3


@pytest.mark.slow
def test_an_image_that_the_teacher_could_not_read_is_left_out(shared, tmp_path) -> None:
    """Though the student can."""
    places = group_images(join_sources(open_sources(shared / "city" / "Images")))
    targets = np.eye(24, MODEL.descriptor_dim, dtype=np.float32)
    targets[5] = 0
    taught = LossConfig(kind=DistilConfig(teacher_dim=MODEL.descriptor_dim))
    config = dataclasses.replace(STUDENT, loss=taught)
    assert fit(config, places, tmp_path / "run", targets=targets, quiet=True).skipped_images == 6


def test_folders_of_one_parent_are_joined(shared) -> None:
    images = shared / "city" / "Images"
    both = group_images(join_sources(open_sources([images / "Aston", images / "Brill"])))
    whole = group_images(join_sources(open_sources(images)))
    assert [both.path(i) for i in range(24)] == [whole.path(i) for i in range(24)]
    assert both.root == images
    assert both.image_counts.tolist() == [1] * 24
