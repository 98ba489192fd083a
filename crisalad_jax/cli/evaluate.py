"""`crisalad evaluate`."""

import contextlib
import dataclasses
import pathlib

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.common import (
    check_json,
    check_one_model,
    open_model,
    open_set,
    say,
    show,
    talk_beside,
    untrained,
    write_or_print_json,
)
from crisalad_jax.cli.flags import JsonFlag, ModelFlags, ReadFlags, SetFlags
from crisalad_jax.cli.tables import grouping_table, points_table
from crisalad_jax.config.checks import check_count, check_seed
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.operating_point import check_precision
from crisalad_jax.evaluation.record import evaluation_settings, results_json, table_notes
from crisalad_jax.evaluation.similarity import FirstSimilarities
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.grouping import DEFAULT_GROUPINGS, parse_groupings
from crisalad_jax.retrieval.pca import load_pca
from crisalad_jax.retrieval.reranking import Reranking, parse_reranking
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_target, write_json
from crisalad_jax.utils.locks import staged_folder

COMMON = (
    "data",
    "weights",
    "preset",
    "image-size",
    "resize",
    "grouping",
    "batch-size",
    "split",
    "images",
    "queries",
    "radius",
    "precision",
    "pca",
    "rerank",
    "report",
    "out",
    "json",
    "on-bad-image",
    "seeds",
    "quiet",
)
EXAMPLE = "crisalad evaluate --data pitts30k_test.mat --weights salad --report pitts30k"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate(ReadFlags, ModelFlags, SetFlags, JsonFlag):
    """Print what a model recalls of an evaluation set under each grouping, and what these leak."""

    preset: str | None = None
    """Evaluate an untrained model of this size in place of weights: tiny, s14, b14, l14 or g14."""
    grouping: str = ",".join(DEFAULT_GROUPINGS)
    """Comma-separated: single, shuffled, sequential, window (an image with those just before it,
    --batch-size in all); QUERIES/DATABASE groups the two sides apart."""
    pca: pathlib.Path | None = None
    """Components that `crisalad pca` fitted, for shorter descriptors."""
    rerank: str | None = None
    """NAME:TOPK puts the first TOPK retrievals in a new order by local features: patch-netvlad,
    patch-netvlad-ransac or patch-netvlad-sum, of a model with NetVLAD, selavpr or transvpr
    (docs/methods.md). Adds a row to each of the table."""
    rerank_weights: pathlib.Path | None = None
    """Model that makes these features, as --weights; by default the first stage's."""
    precision: float | None = None
    """Also print the similarity to ask for so that this share of the accepted first retrievals is
    right, such as 0.99, and the recall that is left."""
    seed: int = 0
    """Draws the first shuffled order, and untrained weights."""
    seeds: int = 3
    """Shuffled orders: their mean and standard deviation are printed."""
    out: pathlib.Path | None = None
    """Folder for a gallery of retrievals and the resolved configuration."""
    report: pathlib.Path | None = None
    """Folder for a page of all results, index.html, that needs no other file and no network; and
    its pictures."""


def run(arguments: Evaluate) -> None:
    """Evaluate the model, print the table, and write the files that are asked for."""
    groupings = arguments.grouping.split(",")
    parse_groupings(groupings)
    reading = arguments.reading
    check_seed("seed", arguments.seed)
    check_count("seeds", arguments.seeds)
    if arguments.precision is not None:
        check_precision(arguments.precision)
    _check_files(arguments)
    talk_beside(arguments.json)
    if arguments.rerank is not None:
        parse_reranking(arguments.rerank)
    is_default = arguments.weights is None and arguments.preset is None
    if is_default:
        arguments = dataclasses.replace(arguments, weights=starter.FILE)
    if arguments.weights is None:
        model, model_name = untrained(arguments.preset or "", arguments)
    else:
        model, model_name = open_model(arguments.weights, arguments, groupings=groupings)
    rerank = _reranking(arguments, model.config)
    pca = None if arguments.pca is None else load_pca(arguments.pca, verify=arguments.verify)
    benchmark = open_set(arguments)
    if is_default:  # told once nothing else is wrong
        starter.tell_taken()
    say(model_name)
    say(f"images at {model.config.images_in_words}")
    similarities = FirstSimilarities()
    results = evaluate(
        model,
        benchmark,
        groupings=groupings,
        seed=arguments.seed,
        seeds=arguments.seeds,
        pca=pca,
        observe=None if arguments.report is None else similarities,
        rerank=rerank,
        precision=arguments.precision,
        reading=reading,
    )
    settings = evaluation_settings(
        benchmark,
        model.config,
        weights=arguments.weights,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        seeds=arguments.seeds,
        pca=arguments.pca,
        rerank=arguments.rerank,
        rerank_weights=arguments.rerank_weights,
    )
    show(grouping_table(results))
    if points := {each.label: each.operating_point for each in results if each.operating_point}:
        show(points_table(points))
    for note in table_notes(results, settings):
        say(note)
    readable = results[0].skipped.rest_of(benchmark)
    with contextlib.ExitStack() as staged:  # so that all files appear, or none
        if arguments.out is not None:
            from crisalad_jax.experiments.report import write_galleries

            folder = staged.enter_context(staged_folder(arguments.out))
            write_galleries(folder, readable, results, model_name=model_name)
            write_json(folder / "config.json", settings)
        if arguments.report is not None and isinstance(model, Model):
            from crisalad_jax.experiments.report import write_report

            write_report(
                staged.enter_context(staged_folder(arguments.report)),
                readable,
                results,
                params=model.params,
                config=model.config,
                model_name=model_name,
                settings=settings,
                similarities=similarities.map,
            )
        if arguments.json is not None:
            values = results_json(results, settings, model_name=model_name, benchmark=benchmark)
            write_or_print_json(arguments.json, values)
    if arguments.report is not None:
        say(f"report: {arguments.report / 'index.html'}")


def _check_files(arguments: Evaluate) -> None:
    """Check before any work that files can be written and flags go together."""
    check_json(arguments.json)
    if arguments.out is not None:
        check_target(arguments.out / "config.json")
    if arguments.report is not None:
        check_target(arguments.report / "index.html")
    check_one_model(arguments.weights, arguments.preset)
    if arguments.runtime != "jax":
        for name, given in (("report", arguments.report), ("preset", arguments.preset)):
            if given is not None:
                raise InputError(
                    f"--{name}: found with --runtime {arguments.runtime}, expected jax"
                )
    if arguments.rerank is None and arguments.rerank_weights is not None:
        raise InputError(
            "--rerank-weights: found without --rerank, expected both, as in --rerank transvpr:100"
        )


def _reranking(arguments: Evaluate, config: ModelConfig) -> Reranking | None:
    """Load the second stage, and check that it fits the first."""
    if arguments.rerank is None:
        return None
    rerank = parse_reranking(arguments.rerank)
    if arguments.rerank_weights is not None:
        own = find_weights(arguments.rerank_weights, quiet=arguments.quiet)
        own_params, own_config = load_weights(own, verify=arguments.verify)
        rerank = dataclasses.replace(rerank, params=own_params, config=own_config)
    rerank.check(config)
    return rerank
