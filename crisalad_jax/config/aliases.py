"""Load files and flags with the names of earlier versions.

Version 0.1 stored the settings of every aggregator, loss and augmentation beside the name of the
chosen one. Version 0.2 stores the settings of the chosen one alone.
"""

from collections.abc import Callable, Mapping
from typing import Any

Plain = dict[str, Any]

RENAMED: Mapping[str, Mapping[str, str]] = {
    "ModelConfig": {"encoder": "cross_image", "keeps": "remat"},
    "ViTConfig": {"position_start": "position_init", "layer_scale_start": "layer_scale_init"},
    "SinkhornConfig": {"must_converge": "throw", "anderson": "anderson_memory"},
    "LossConfig": {"epsilon": "miner_margin", "library_quirk": "match_pml_zero"},
    "OptimiserConfig": {
        "final_fraction": "end_lr_fraction",
        "drop_epochs": "step_epochs",
        "drop_factor": "step_gamma",
    },
    "TrainConfig": {"trains": "trainable"},
}
"""Fields by the name of their class: the old name, and today's."""
REMAT: Mapping[str, str] = {"products": "dots", "blocks": "full", "everything": "none"}
"""Values of the old `keeps`, with those of `remat`."""
NORMALISATION: Mapping[str, str] = {"imagenet": "mean-deviation"}
"""Values of the old `normalisation`, with those of today's, which stands in `preprocessing`."""
AGGREGATORS = (
    *("salad", "gem-pyramid", "class-token", "gem", "netvlad", "conv-ap", "cosplace", "mixvpr"),
    *("anyloc", "boq", "transvpr"),
)
"""Aggregators whose settings once stood side by side."""
LOSSES = (
    *("multi-similarity", "contrastive", "triplet", "circle", "supcon", "fast-ap"),
    "large-margin-cosine",
)
"""Losses whose settings once stood side by side."""
PROBLEM = ("dustbin", "epsilon", "row_tau", "column_tau")
"""Settings of the transport problem that `sinkhorn` once had."""
CLASSES = (
    *("groups", "steps", "cell", "sector", "spacing", "sector_spacing", "focal_distance"),
    "view_angle",
)
"""Settings of classes that the loss of classes once had."""


def field_of(name: str) -> str:
    """Return the field in which the settings of a named part once stood."""
    return name.replace("-", "_")


def upgrade(kind: type, value: Mapping[str, Any]) -> Plain:
    """Return the fields of a configuration under today's names, one level deep."""
    value = dict(value)
    change = _CHANGES.get(kind.__name__)
    if change is not None:
        change(value)
    renamed = RENAMED.get(kind.__name__, {})
    for old, new in renamed.items():
        if old in value and new not in value:
            value[new] = value.pop(old)
    return value


def is_of_an_earlier_version(plain: Any) -> bool:
    """Return whether a model's or a run's configuration has names of version 0.1."""
    if not isinstance(plain, Mapping):
        return False
    model = plain.get("model", plain)
    return isinstance(model, Mapping) and ("encoder" in model or "keeps" in model)


def _choose(value: Plain, names: tuple[str, ...], field: str, chosen: Any) -> None:
    """Move the settings of the chosen part from their own field to `field`."""
    if not isinstance(chosen, str):
        return
    beside = {name: value.pop(field_of(name), None) for name in names if field_of(name) != field}
    if any(each is not None for each in beside.values()):
        value[field] = _named(chosen, beside.get(chosen))


def _named(name: Any, settings: Any) -> Any:
    """Add a part's name to its settings; pass on settings that are no object, refused later."""
    if settings is None:
        return {"name": name}
    return {"name": name, **settings} if isinstance(settings, Mapping) else settings


def _model(value: Plain) -> None:
    _choose(value, AGGREGATORS, "aggregator", value.get("aggregator", "salad"))
    keeps = value.get("keeps")
    if isinstance(keeps, str) and keeps in REMAT:
        value["keeps"] = REMAT[keeps]
    if "normalisation" in value and "preprocessing" not in value:
        how = value.pop("normalisation")
        if isinstance(how, str):
            how = NORMALISATION.get(how, how)
        value["preprocessing"] = {"normalisation": how}
    backbone = value.get("backbone")
    if isinstance(backbone, Mapping) and "name" not in backbone:
        value["backbone"] = {"name": "vit", **backbone}


def _salad(value: Plain) -> None:
    sinkhorn = value.get("sinkhorn")
    if isinstance(sinkhorn, Mapping):
        value["sinkhorn"] = {k: v for k, v in sinkhorn.items() if k not in PROBLEM}
        value.update({k: v for k, v in sinkhorn.items() if k in PROBLEM})


def _boq(value: Plain) -> None:
    # Files hold all fields: one without this one is of the time when there was always the norm.
    if value.keys() >= {"channels", "queries", "layers", "rows"}:
        value.setdefault("last_norm", True)


def _anyloc(value: Plain) -> None:
    # As for BoQ: without this field, a patch's word was always the one at the least distance.
    if value.keys() >= {"clusters", "layer", "facet"}:
        value.setdefault("assignment", "euclidean")


def _sinkhorn(value: Plain) -> None:
    if "method" not in value:
        return
    step: Plain = {"name": value.pop("method")}
    relaxation = value.pop("relaxation", 1.0)
    if step["name"] == "sinkhorn":
        step["relaxation"] = relaxation
    value["step"] = step


def _loss(value: Plain) -> None:
    _choose(value, LOSSES, "kind", value.get("kind", "multi-similarity"))


def _large_margin_cosine(value: Plain) -> None:
    if isinstance(value.get("classes"), str):
        classes = {name: value.pop(name) for name in CLASSES if name in value}
        value["classes"] = {"kind": value["classes"], **classes}


def _training(value: Plain) -> None:
    # Files of runs hold all fields: without this one, statistics were never updated.
    if _adapter_kind(value) == "multi-resolution" and value.keys() >= {"epochs", "patience"}:
        value.setdefault("batch_norm", "stored")
    beside = {"rand-augment": "rand_augment", "light": "light_augment"}
    if "augmentation" in value or value.keys().isdisjoint(("augment", *beside.values())):
        return
    chosen = value.pop("augment", "rand-augment")
    settings = {name: value.pop(field, None) for name, field in beside.items()}
    value["augmentation"] = _named(
        chosen, settings.get(chosen) if isinstance(chosen, str) else None
    )


def _adapter_kind(training: Plain) -> Any:
    """Return the kind of adapter of a run's model; None where the plain value names none."""
    value: Any = training
    for name in ("model", "backbone", "adapter", "kind"):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


_CHANGES: Mapping[str, Callable[[Plain], None]] = {
    "ModelConfig": _model,
    "SaladConfig": _salad,
    "AnyLocConfig": _anyloc,
    "BoqConfig": _boq,
    "SinkhornConfig": _sinkhorn,
    "LossConfig": _loss,
    "LargeMarginCosineConfig": _large_margin_cosine,
    "TrainConfig": _training,
}
