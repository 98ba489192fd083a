"""`crisalad evaluate`."""

import contextlib
import dataclasses
import importlib
import pathlib
from typing import Annotated, Literal

from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.common import (
    echo,
    emit_json,
    emit_latex,
    open_flagged,
    open_set,
    pick,
    refuse_with,
    refuse_without,
    show_tables,
)
from crisalad_jax.cli.flags import FOLDER, ModelFlags, ReadFlags, SetFlags, TableFlags, Target
from crisalad_jax.evaluation.evaluate import check_evaluation, evaluate
from crisalad_jax.evaluation.record import evaluation_record
from crisalad_jax.evaluation.similarity import FirstSimilarities
from crisalad_jax.experiments.result_tables import result_tables
from crisalad_jax.nn.model import Model
from crisalad_jax.retrieval.grouping import DEFAULT_GROUPINGS
from crisalad_jax.retrieval.pca import load_pca
from crisalad_jax.retrieval.reranking import Reranking, parse_reranking
from crisalad_jax.utils.files import atomic_path, write_json
from crisalad_jax.utils.locks import staged_folder


class Evaluate(ReadFlags, ModelFlags, SetFlags, TableFlags):
    """Print a model's recall under each grouping, and how much its batches reveal about places."""

    preset: str | None = None
    """Evaluate an untrained model of this size instead of weights: tiny, s14, b14, l14 or g14."""
    grouping: str = ",".join(DEFAULT_GROUPINGS)
    """Comma-separated: single, shuffled, sequential, masked (sequential, but no image sees another
    of its own place), window (an image and those just before it, --batch-size in all);
    QUERIES/DATABASE groups the sides separately, and @26 after it makes batches of 26.
    published:sage, published:cricavpr or published:crisalad: the batches of that evaluation, and
    then single, shuffled and masked ones of that size."""
    pca: pathlib.Path | None = None
    """Components that `crisalad pca` fitted, for shorter descriptors."""
    dtype: Literal["float32", "bits"] = "float32"
    """How descriptors are compared: bits compares their signs by the Hamming distance
    (docs/maps.md)."""
    rerank: str | None = None
    """NAME:TOPK re-ranks the first TOPK retrievals by local features: patch-netvlad,
    patch-netvlad-ransac or patch-netvlad-sum, with a NetVLAD model; fol, pair-vpr, selavpr,
    selavprpp or transvpr, with a model of that method; sinkhorn-divergence, with any local tokens
    (docs/methods.md); local, with SIFT (docs/verification.md). Adds a row for each row of the
    table."""
    rerank_weights: pathlib.Path | None = None
    """Model that makes the features for --rerank: a file or a name; by default the evaluated model.
    For local, a matcher as an ONNX file."""
    precision: float | None = None
    """Also print the minimum similarity at which this share of the accepted first answers is
    correct, such as 0.99, and the remaining recall."""
    seed: int = 0
    """Seed of the first shuffled order, and of untrained weights."""
    seeds: int = 3
    """Number of shuffled orders, whose mean and standard deviation are shown."""
    out: Annotated[pathlib.Path | None, FOLDER] = None
    """Folder for a gallery of retrievals and the resolved configuration."""
    report: Annotated[pathlib.Path | None, FOLDER] = None
    """Folder for a self-contained page of all results, index.html, and its pictures as files."""
    rerun: Annotated[pathlib.Path | None, Target((".rrd",))] = None
    """Recording for the viewer Rerun: queries, retrievals (correct ones in green), similarities."""


def run(arguments: Evaluate) -> None:
    """Evaluate the model, print the table, and write the files that are asked for."""
    groupings = arguments.grouping.split(",")
    drawn = pick(arguments, "seed", "seeds", "precision")
    kinds = check_evaluation(groupings, **drawn)
    _check_flags(arguments)
    reading = arguments.reading
    rerank = _reranking(arguments)
    benchmark = open_set(arguments)
    if arguments.preset is not None:
        model, name, file = _untrained(arguments.preset, arguments)
    else:
        model, name, file = open_flagged(arguments, groupings=kinds)
    config = model.config
    pca = None if arguments.pca is None else load_pca(arguments.pca, verify=arguments.checksums)
    echo(name)
    echo(f"images at {config.images_in_words}")
    similarities = FirstSimilarities()
    results = evaluate(
        model,
        benchmark,
        groupings=groupings,
        pca=pca,
        dtype=arguments.dtype,
        observe=None if arguments.report is None else similarities,
        rerank=rerank,
        reading=reading,
        **drawn,
    )
    asked = {"weights": arguments.weights or file, "groupings": groupings} | pick(
        arguments, "batch_size", "seed", "seeds", "pca", "dtype", "rerank", "rerank_weights"
    )
    record = evaluation_record(results, benchmark, config, model_name=name, **asked)
    tables = result_tables(results)
    show_tables(*tables)
    for note in record.notes:
        echo(note)
    readable = results[0].skipped.rest_of(benchmark)
    with contextlib.ExitStack() as staged:  # so that all files appear, or none
        if arguments.out is not None:
            from crisalad_jax.experiments.report import write_galleries

            folder = staged.enter_context(staged_folder(arguments.out))
            write_galleries(folder, readable, results, model_name=name)
            write_json(folder / "config.json", record.settings)
        if arguments.report is not None and isinstance(model, Model):
            from crisalad_jax.experiments.report import write_report

            write_report(
                staged.enter_context(staged_folder(arguments.report)),
                readable,
                results,
                model=model,
                model_name=name,
                settings=record.settings,
                similarities=similarities.map,
            )
        if arguments.rerun is not None:
            from crisalad_jax.experiments.rerun_log import record_results

            record_results(staged.enter_context(atomic_path(arguments.rerun)), readable, results)
        emit_latex(arguments.latex, *tables)
        emit_json(arguments.json, record.values)
    if arguments.report is not None:
        echo(f"report: {arguments.report / 'index.html'}")


def _check_flags(arguments: Evaluate) -> None:
    """Check that flags fit together, before any work."""
    if arguments.weights is not None:
        refuse_with("--weights", preset=arguments.preset)
    if arguments.runtime != "jax":
        refuse_with(f"--runtime {arguments.runtime}", **pick(arguments, "report", "preset"))
    if arguments.rerun is not None:
        importlib.import_module("crisalad_jax.experiments.rerun_log")  # raises without its extra
    refuse_without("--rerank", arguments.rerank, rerank_weights=arguments.rerank_weights)


def _untrained(preset: str, arguments: Evaluate) -> tuple[Model, str, None]:
    """Make an untrained model of a preset."""
    import jax

    from crisalad_jax.nn.model import init_crisalad
    from crisalad_jax.training.recipes import recipe

    config = recipe(preset).model
    params = init_crisalad(jax.random.key(arguments.seed), config)
    model = Model(params, arguments.applied_to(config))
    return model, f"untrained {preset}, seed {arguments.seed}", None


def _reranking(arguments: Evaluate) -> Reranking | None:
    """Make the second stage, with the model of --rerank-weights if there is one."""
    if arguments.rerank is None:
        return None
    rerank = parse_reranking(arguments.rerank)
    if arguments.rerank_weights is not None and not rerank.needs_model:
        rerank = dataclasses.replace(rerank, matcher=arguments.rerank_weights)
    elif arguments.rerank_weights is not None:
        file = find_weights(arguments.rerank_weights, quiet=arguments.quiet)
        rerank = dataclasses.replace(rerank, model=load_weights(file, verify=arguments.checksums))
    return rerank
