"""What the folder of a comparison holds, which may grow by methods, rows, seeds and sets.

OUT/config.json has all that was ever compared there. A command may name a part of it, or more.
"""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

from crisalad_jax.config.io import read_config, to_plain
from crisalad_jax.config.part import parts_of
from crisalad_jax.config.plugins import source_digest
from crisalad_jax.experiments.comparison.methods import method_of
from crisalad_jax.experiments.comparison.plan import ComparisonConfig, Prepared
from crisalad_jax.experiments.comparison.records import read_result
from crisalad_jax.experiments.comparison.rows import AblationRow
from crisalad_jax.training.run_files import checksum_of_benchmark, checksum_of_places
from crisalad_jax.utils.checksums import sha256_of
from crisalad_jax.utils.errors import InputError
from crisalad_jax.utils.files import check_target, read_json, write_json
from crisalad_jax.utils.temporaries import holds_other_files

_GROWING = ("names", "rows", "test", "weights", "seeds")
_OF_TRAINING = ("train", "backbone", "epochs")
"""Settings that nothing depends on as long as nothing was trained."""


def claim(out: pathlib.Path, prepared: Prepared) -> None:
    """Make `out` the folder of this comparison, or check that it is, and add what is new.

    Raises:
        InputError: it holds results that other settings would change, or files but no comparison;
            or the content behind a name has changed since the comparison began: weights, a
            backbone, a set, a plug-in's part.
    """
    config, path = prepared.config, out / "config.json"
    check_target(path)
    if path.exists():
        existing = read_config(ComparisonConfig, path)
        together = grown(existing, config, out)
        if together != existing:
            write_json(path, to_plain(together))
    elif out.exists() and holds_other_files(out):
        raise InputError(
            f"{out}: found files but no comparison, expected one or a new or empty folder"
        )
    else:
        write_json(path, to_plain(dataclasses.replace(config, reference=None)))
    _check_behind(out / "behind.json", _behind(prepared))


def numbers_of(out: pathlib.Path, config: ComparisonConfig) -> list[int]:
    """Return the number of each set of `config.test` in the names of results.

    Raises:
        InputError: the folder's config.json cannot be read.
    """
    there: Any = read_json(out / "config.json", "a configuration as JSON", sealed=False)
    return [there["test"].index(test) for test in config.test]


def seeds_of(config: ComparisonConfig) -> dict[str, int]:
    """Map the names of a comparison to their numbers of runs: one for a model from a file."""
    files = _weights_of_runs(config)
    return {name: 1 if files[_run(config, name)] else config.seeds for name in config.names}


def grown(
    existing: ComparisonConfig, config: ComparisonConfig, out: pathlib.Path
) -> ComparisonConfig:
    """Add to a comparison what another configuration has beside it.

    Args:
        existing: what the folder holds.
        config: what is asked for; it may lack some of that, in any order.
        out: the folder, for messages.

    Returns:
        The configuration of both.

    Raises:
        InputError: another setting would change results that are there.
    """
    wrong = [*_changed_settings(existing, config), *_changed_methods(existing, config)]
    if wrong:
        raise InputError(
            f"{out}: holds another comparison: {'; '.join(wrong)}; give the same to go on with it "
            "(methods, rows, seeds and sets may be added), or another folder"
        )
    weights = _files(existing.weights) | _files(config.weights)
    rows = {row.name: row for each in (existing, config) for row in _rows(each)}
    together: dict[str, Any] = dict(
        names=tuple(dict.fromkeys((*existing.names, *config.names))),
        rows=tuple(rows.values()),
        test=tuple(dict.fromkeys((*existing.test, *config.test))),
        weights=tuple(f"{name}={file}" if file else name for name, file in weights.items()),
        seeds=max(existing.seeds, config.seeds),
        **{name: getattr(config, name) for name in _unused(existing)},
    )
    if all(getattr(existing, name) == value for name, value in together.items()):
        return existing
    return dataclasses.replace(existing, **together)


def _changed_settings(existing: ComparisonConfig, config: ComparisonConfig) -> list[str]:
    free = {*_GROWING, "reference", *_unused(existing)}
    return [
        f"{field.name}: was {_word(was)}, is {_word(given)}"
        for field in dataclasses.fields(config)
        if field.name not in free
        for was, given in [(getattr(existing, field.name), getattr(config, field.name))]
        if was != given
    ]


def _unused(existing: ComparisonConfig) -> list[str]:
    """Return settings that no result in the folder depends on."""
    unused: list[str] = [*_OF_TRAINING] if existing.train is None else []
    methods = [name for name in existing.names if name not in existing.models]
    if existing.kind == "ablate" or not any(
        method_of(name, existing.preset).rerank for name in methods
    ):
        unused.append("rerank")
    return unused


def _changed_methods(existing: ComparisonConfig, config: ComparisonConfig) -> list[str]:
    """Find names that would mean other rows or weights than before."""
    wrong = []
    for name in (name for name in existing.names if name in config.names):
        was, given = existing.row(name), config.row(name)
        if was != given:
            before, after = _flags(was), _flags(given)
            wrong += [
                f"row {name}: {flag}: was {before.get(flag, 'not set')}, is "
                f"{after.get(flag, 'not set')}"
                for flag in dict.fromkeys((*before, *after))
                if before.get(flag) != after.get(flag)
            ]
    before, after = _weights_of_runs(existing), _weights_of_runs(config)
    return wrong + [
        f"weights of {run}: was {before[run] or 'trained here'}, is {after[run] or 'trained here'}"
        for run in before
        if run in after and before[run] != after[run]
    ]


def _flags(row: AblationRow | None) -> Mapping[str, str]:
    return {} if row is None else {"recipe": row.recipe, **row.flags}


def _weights_of_runs(config: ComparisonConfig) -> dict[str, str | None]:
    """Map runs, which methods may share, to their files; None where a run is trained here."""
    files = {
        _run(config, name): file or name
        for name, file in _files(config.weights).items()
        if name in config.names
    }
    return {run: files.get(run) for run in (_run(config, name) for name in config.names)}


def _run(config: ComparisonConfig, name: str) -> str:
    if config.kind == "ablate" or name in config.models:
        return name
    return method_of(name, config.preset).recipe


def _files(weights: tuple[str, ...]) -> dict[str, str]:
    return {name: file for name, _, file in (text.partition("=") for text in weights)}


def _rows(config: ComparisonConfig) -> list[AblationRow]:
    return [row for row in map(config.row, config.names) if row is not None]


def _word(value: Any) -> Any:
    return "none" if value is None or value == () else value


def _check_behind(path: pathlib.Path, behind: dict[str, str]) -> None:
    """Check that what names stand for has not changed, and add the new ones."""
    there = read_result(path) if path.exists() else {}
    changed = [name for name, digest in there.items() if behind.get(name, digest) != digest]
    if changed:
        raise InputError(
            f"{path.parent}: {', '.join(changed)}: found changed since this comparison began, "
            "expected the same, or another folder"
        )
    if not path.exists() or behind.keys() - there.keys():
        write_json(path, {**there, **behind})


def _behind(prepared: Prepared) -> dict[str, str]:
    """Compute digests of what the configuration only names: files, sets' image names, plug-ins."""
    files = {str(v.weights) for v in prepared.variants if v.weights is not None}
    if prepared.config.backbone is not None:
        files.add(prepared.config.backbone)
    digests = {name: sha256_of(name) for name in sorted(files)}
    if prepared.places is not None:
        digests[str(prepared.config.train)] = str(checksum_of_places(prepared.places))
    for name, benchmark in zip(prepared.config.test, prepared.benchmarks, strict=True):
        digests[name] = str(checksum_of_benchmark(benchmark))
    for variant in prepared.variants:
        for part in map(type, parts_of(variant.training).values()):
            digest = source_digest(part)
            if digest is not None:
                digests[f"{part.registry.kind} {part.part_name}"] = digest
    return digests
