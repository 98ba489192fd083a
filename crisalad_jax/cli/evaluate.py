"""`crisalad evaluate`."""

import contextlib
import dataclasses
import pathlib
from typing import Any, Literal

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.load import find_weights
from crisalad_jax.checkpoints.runtime import Runtime
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.common import (
    RuntimeName,
    check_json,
    load_model,
    open_model,
    open_set,
    say,
    show,
    talk_beside,
    write_or_print_json,
)
from crisalad_jax.cli.tables import grouping_table, points_table
from crisalad_jax.evaluation.evaluate import evaluate
from crisalad_jax.evaluation.operating_point import check_precision
from crisalad_jax.evaluation.record import evaluation_settings, results_json, table_notes
from crisalad_jax.evaluation.similarity import FirstSimilarities
from crisalad_jax.nn.config import ModelConfig
from crisalad_jax.retrieval.grouping import DEFAULT_GROUPINGS, check_grouping, parse_groupings
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


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Print what a model recalls of an evaluation set under each grouping, and what these leak."""

    data: pathlib.Path
    """Evaluation set in any layout of docs/datasets.md: @UTM names, VPR-Bench, raw MSLS, two plain
    folders; a .mat file of NetVLAD; .npy lists of SALAD."""
    weights: pathlib.Path | None = None
    """By default starter, the small model in this package; or hog, a baseline that learns nothing;
    or a .safetensors file, or a published model's name (`crisalad models`)."""
    preset: str | None = None
    """Evaluate an untrained model of this size in place of weights: tiny, s14, b14, l14 or g14."""
    image_size: tuple[int, int] | None = None
    """Height and width, multiples of the patch size; by default the model's."""
    resize: tuple[str, ...] = ()
    """Words in place of the model's way: fixed, shorter-side, longer-side or native; bilinear,
    bicubic or area; antialias or no-antialias; bytes or floats; round;
    high-byte or contrast-stretch, for 16 bits and floats (docs/resizing.md)."""
    grouping: str = ",".join(DEFAULT_GROUPINGS)
    """Comma-separated: single, shuffled, sequential, window (an image with those just before it,
    --batch-size in all); QUERIES/DATABASE groups the two sides apart."""
    batch_size: int = 16
    """Images that a cross-image encoder sees together (the paper: 16)."""
    split: str | None = None
    """train, val or test, where the set has several."""
    layout: str | None = None
    """utm, vpr-bench, netvlad, salad, msls, msls-subtask or folders; by default what DATA looks
    like (msls-subtask, the 740 queries of raw MSLS, only by name)."""
    images: pathlib.Path | None = None
    """Folder of the images that a .mat file or .npy lists name; by default beside them."""
    queries: str | None = None
    """Folder of the queries, where @UTM sets have several: queries_night of SVOX; by default
    queries."""
    ignore_zones: bool = False
    """Compare @UTM numbers of all zones as if of one plane, as the public tools do."""
    radius: float | None = None
    """Largest distance of a positive in metres; by default 25, or what a .mat file says."""
    max_heading_difference: float | None = None
    """Largest difference of compass angles of a positive in degrees, for raw MSLS; by default any
    (the paper: 40)."""
    frames: int | None = None
    """How many frames a positive may be away, for two plain folders of the same moments."""
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
    runtime: RuntimeName = "jax"
    """What computes the model: jax, onnxruntime or openvino (docs/export.md). Weights are exported
    for it once; --weights may be an exported folder."""
    compute_dtype: Literal["float32", "bfloat16"] | None = None
    """Type of the matrix products, by default the model's; docs/performance.md shows what bfloat16
    gains and loses."""
    seed: int = 0
    """Draws the first shuffled order, and untrained weights."""
    seeds: int = 3
    """Shuffled orders: their mean and standard deviation are printed."""
    out: pathlib.Path | None = None
    """Folder for a gallery of retrievals and the resolved configuration."""
    report: pathlib.Path | None = None
    """Folder for a page of all results, index.html, that needs no other file and no network; and
    its pictures."""
    json: pathlib.Path | None = None
    """File for the table as JSON; - prints it."""
    on_bad_image: Literal["stop", "skip"] = "stop"
    """Stop at an unreadable image, or leave it out and say so: recalls are then of the rest."""
    verify: bool = True
    """Check weights and components against their checksums; --no-verify skips that, where files are
    huge."""
    max_pixels: int = 2**28
    """Pixels that an image file may have; larger ones are not decoded."""
    plugin: tuple[str, ...] = ()
    """Files FILE.py or modules that register parts of your own; their code is run."""
    quiet: bool = False
    """No progress bars."""


def run(arguments: Evaluate) -> None:
    """Evaluate the model, print the table, and write the files that are asked for."""
    groupings = arguments.grouping.split(",")
    parse_groupings(groupings)
    check_grouping((), arguments.batch_size, arguments.seed, arguments.seeds)
    if arguments.precision is not None:
        check_precision(arguments.precision)
    _check_files(arguments)
    talk_beside(arguments.json)
    if arguments.rerank is not None:
        parse_reranking(arguments.rerank)
    is_default = arguments.weights is None and arguments.preset is None
    if is_default:
        arguments = dataclasses.replace(arguments, weights=starter.FILE)
    options: dict[str, Any] = {
        "image_size": arguments.image_size,
        "resize": arguments.resize,
        "compute_dtype": arguments.compute_dtype,
        "verify": arguments.verify,
        "quiet": arguments.quiet,
    }
    if arguments.weights is None or arguments.runtime == "jax":
        params, config, model_name = load_model(
            arguments.weights, preset=arguments.preset, seed=arguments.seed, **options
        )
    else:
        params, config, model_name = open_model(
            arguments.weights,
            arguments.runtime,
            any_grouping=set(arguments.grouping.replace("/", ",").split(",")) != {"single"},
            **options,
        )
    rerank = _reranking(arguments, config)
    pca = None if arguments.pca is None else load_pca(arguments.pca, verify=arguments.verify)
    benchmark = open_set(arguments)
    if is_default:  # told once nothing else is wrong
        starter.tell_taken()
    say(model_name)
    say(f"images at {config.images_in_words}")
    similarities = FirstSimilarities()
    results = evaluate(
        params,
        config,
        benchmark,
        groupings=groupings,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        seeds=arguments.seeds,
        pca=pca,
        observe=None if arguments.report is None else similarities,
        rerank=rerank,
        on_bad_image=arguments.on_bad_image,
        precision=arguments.precision,
        quiet=arguments.quiet,
    )
    settings = evaluation_settings(
        benchmark,
        config,
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
        if arguments.report is not None and not isinstance(params, Runtime):
            from crisalad_jax.experiments.report import write_report

            write_report(
                staged.enter_context(staged_folder(arguments.report)),
                readable,
                results,
                params=params,
                config=config,
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
