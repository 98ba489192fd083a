"""Write a run as the Hugging Face Hub expects it: weights, configuration and a model card."""

import contextlib
import json
import os
import pathlib
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from crisalad_jax.checkpoints.load import HUB_FILE
from crisalad_jax.checkpoints.weights import read_weights
from crisalad_jax.config.checks import PATH, require, takes
from crisalad_jax.config.io import read_config, to_plain
from crisalad_jax.data.benchmarks.on_disk import listing
from crisalad_jax.evaluation.metrics import bootstrap_interval
from crisalad_jax.evaluation.results import percent
from crisalad_jax.experiments.tables import NOTHING, Cell, Table, write_text
from crisalad_jax.training.config import TrainConfig
from crisalad_jax.training.log import read_metrics
from crisalad_jax.training.run_files import DATA
from crisalad_jax.training.summary import model_words
from crisalad_jax.training.validation import MONITORED
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import atomic_folder, read_json, real_path, write_json
from crisalad_jax.utils.hub import is_hub, parse_hub, upload_folder
from crisalad_jax.utils.output import counted, warn
from crisalad_jax.utils.version import VERSION

WEIGHTS = ("best.safetensors", "last.safetensors")
"""Weight files of a run; the first one that exists is published."""
CARD, CONFIG = "README.md", "config.json"
_TEMPLATE = "card.md"


@takes(run=PATH)
def publish(
    run: str | os.PathLike[str],
    to: str | os.PathLike[str],
    *,
    licence: str,
    data: str | None = None,
    evaluations: Sequence[str | os.PathLike[str]] = (),
    quiet: bool = False,
) -> str:
    """Write a run's model to a new folder, or to a repository on the Hugging Face Hub.

    The result has `model.safetensors`, `config.json` and `README.md`, a model card written from the
    run: what the model is, its training data and recipe, recalls with their intervals, the licence,
    and how to use it. `load` reads such a folder, and hf://OWNER/NAME.

    Args:
        run: the run's folder, with best.safetensors or last.safetensors.
        to: a new or empty folder, or hf://OWNER/NAME of a repository, new or without these files.
        licence: licence of the weights, by the hub's name for it, such as apache-2.0 or
            cc-by-nc-4.0; the initial weights and the training data may restrict the choice.
        data: description of the training data; None for what the run recorded.
        evaluations: files that `crisalad evaluate --json` wrote for this model.
        quiet: whether to hide the progress bar.

    Returns:
        The folder, or the address of the repository's page.

    Raises:
        InputError: the run has no weights; a file is missing or damaged; the folder is not empty,
            or the repository has such files; the licence name is invalid; or the upload fails.
        ModuleNotFoundError: huggingface_hub is not installed, and `to` is on the hub.

    Example:
        >>> import dataclasses
        >>> import crisalad_jax as cj
        >>> config = dataclasses.replace(cj.recipe("tiny"), epochs=1, places_per_batch=4)
        >>> _ = cj.train(config, places, folder / "run", quiet=True)
        >>> _ = publish(folder / "run", folder / "mine", licence="apache-2.0")
        >>> cj.load(folder / "mine").config == config.model
        True
    """
    run = pathlib.Path(run)
    require(
        re.fullmatch(r"[a-z0-9][a-z0-9.-]*", licence) is not None,
        f"licence: found {licence!r}, expected the hub's name for one, such as apache-2.0",
    )
    address = parse_hub(to) if is_hub(to) else None
    require(address is None or address.file is None, f"{to}: found a file, expected a repository")
    found = _read_run(run)
    rows = [*_validation(found), *(row for file in evaluations for row in _rows(file, found))]
    name = str(address or real_path(pathlib.Path(to)).name)
    card = _card(found, rows, name=name, licence=licence, data=data)
    with contextlib.ExitStack() as stack:
        if address is None:
            folder = stack.enter_context(atomic_folder(to))
        else:
            folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        shutil.copyfile(found.weights, folder / HUB_FILE)
        model = to_plain(found.config.model)
        about = {"library_name": "crisalad-jax", "version": VERSION, "model": model}
        write_json(folder / CONFIG, about | {"training": to_plain(found.config)})
        write_text(folder / CARD, card)
        if address is None:
            return os.fspath(to)
        return upload_folder(folder, address, f"Publish {run.name}", quiet=quiet)


class _Run(NamedTuple):
    """What is read from a run."""

    weights: pathlib.Path
    config: TrainConfig
    metrics: list[dict[str, Any]]
    data: dict[str, Any] | None
    """What it recorded of its data; None for a run that `fit` made without `train`."""


class _Row(NamedTuple):
    """A row of the table of recalls."""

    benchmark: str
    how: str
    recalls: Mapping[str, float]
    intervals: Mapping[str, Sequence[float]]

    def cell(self, name: str) -> Cell:
        """Format a recall, with its interval if known."""
        if name not in self.recalls:
            return Cell(NOTHING)
        ends = "-".join(map(percent, self.intervals.get(name, ())))
        return Cell(percent(self.recalls[name]), f"[{ends}]" if ends else "")


def _read_run(run: pathlib.Path) -> _Run:
    """Read a run, and check its weights.

    Raises:
        InputError: it has no weights, or a file is damaged.
    """
    there = [run / name for name in WEIGHTS if (run / name).is_file()]
    if not there:
        raise InputError(f"{run}: found {listing(run)}, expected a run with {' or '.join(WEIGHTS)}")
    config = read_config(TrainConfig, run / CONFIG)
    read_weights(there[0])
    log, data = run / "metrics.jsonl", run / DATA
    metrics = read_metrics(log) if log.is_file() else []
    return _Run(
        there[0], config, metrics, read_json(data, "a run's data") if data.is_file() else None
    )


def _validation(run: _Run) -> Iterator[_Row]:
    """Yield the recalls of the validation that chose these weights, if there was one."""
    ranks = [f"R@{k}" for k in MONITORED[run.config.monitor]]
    validations = [each for each in run.metrics if all(rank in each for rank in ranks)]
    if not validations:
        return
    last = run.weights.name == WEIGHTS[1]
    # Of equal recalls, the first is the best; the last weights belong to the last validation.
    best = max(validations, key=lambda each: sum(each[rank] for rank in ranks))
    chosen = validations[-1] if last else best
    recalls = {name: value for name, value in chosen.items() if re.fullmatch(r"R@\d+", name)}
    known = (run.data or {}).get("validation")
    intervals = {}
    if known is not None:
        for name, value in recalls.items():
            hits = np.arange(known["queries"]) < round(value * known["queries"])
            intervals[name] = list(bootstrap_interval(hits.astype(np.int64)))
    name = known["name"] if known is not None else "the run's validation set"
    yield _Row(name, f"validation at step {chosen['step']:,}, single", recalls, intervals)


def _rows(file: str | os.PathLike[str], run: _Run) -> Iterator[_Row]:
    """Yield the results of an evaluation.

    Raises:
        InputError: the file does not hold an evaluation.
    """
    values = read_json(file, "what `crisalad evaluate --json` wrote", sealed=False)
    try:
        benchmark, weights = values["benchmark"], values["weights"]
        rows = [
            _Row(
                benchmark,
                row["grouping"] + (f" + {row['rerank']}" if row["rerank"] else ""),
                row["recalls"],
                row["intervals"],
            )
            for row in values["results"]
        ]
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{file}: found no {error}, expected what `crisalad evaluate --json` wrote"
        ) from error
    if weights is None or real_path(weights) != real_path(run.weights):
        warn(f"{file}: found an evaluation of {weights}; {run.weights} is what is published")
    yield from rows


def _card(run: _Run, rows: Sequence[_Row], *, name: str, licence: str, data: str | None) -> str:
    """Write the model card: a YAML header for the hub, and a page for people."""
    config, short = run.config, name.rpartition("/")[2].partition("@")[0]
    limits = "A descriptor depends only on its own image."
    if config.model.cross_image.attends:
        limits = (
            "Its descriptors depend on the images that are described together "
            "(`docs/evaluation.md`): the recalls below say how they were grouped."
        )
    # JSON is valid YAML, and quotes anything that a name may hold.
    index = json.dumps([{"name": short, "results": [_result(row) for row in rows]}])
    page = pathlib.Path(__file__).with_name(_TEMPLATE).read_text(encoding="utf-8")
    return page.format(
        quoted=json.dumps(licence),
        index=f"\nmodel-index: {index}" if rows else "",
        losses=", ".join(dict.fromkeys(each.loss.kind.part_name for each in config.alone)),
        epochs=counted(config.epochs, "epoch"),
        model=model_words(config.model),
        data=data or _data_words(run.data),
        recalls=_table(rows),
        version=VERSION,
        **{"config": config, "name": name, "short": short, "licence": licence, "limits": limits},
    )


def _data_words(data: Mapping[str, Any] | None) -> str:
    if data is None:
        return "the run has no record of it"
    training = data["training"]
    counts = ", ".join(
        f"{training[each]:,} {each}" for each in ("places", "queries", "images") if each in training
    )
    validation = data["validation"]
    on = "" if validation is None else f"; validated on {validation['name']}"
    return f"{training['name']} ({counts}){on}"


def _table(rows: Sequence[_Row]) -> str:
    if not rows:
        return "The run has no validation, and no evaluation was given."
    names = sorted({name for row in rows for name in row.recalls}, key=lambda n: int(n[2:]))
    cells = [[Cell(each.benchmark), Cell(each.how), *map(each.cell, names)] for each in rows]
    table = Table(["data set", "grouping", *names], cells, labels=2).markdown()
    return (
        f"{table}\nPercent of all queries; in brackets the 95 % interval by bootstrap over the "
        "queries, as if they were independent. A validation chose the weights, so its recalls "
        "are optimistic."
    )


def _result(row: _Row) -> dict[str, Any]:
    """Convert a row to the form of the hub's `model-index`, with recalls in percent."""
    kind = re.sub(r"[^a-z0-9]+", "-", row.benchmark.lower()).strip("-")
    metrics = [
        {"type": f"recall_at_{name[2:]}", "name": f"{name}, {row.how}", "value": 100 * value}
        for name, value in row.recalls.items()
    ]
    return {
        "task": {"type": "image-feature-extraction", "name": "Visual place recognition"},
        "dataset": {"type": kind, "name": row.benchmark},
        "metrics": metrics,
    }
