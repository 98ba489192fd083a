"""`crisalad models`."""

import dataclasses
from typing import Annotated, Any

import jax
import tyro

from crisalad_jax.checkpoints import starter
from crisalad_jax.checkpoints.cache import is_cached
from crisalad_jax.checkpoints.published import PUBLISHED, Published, published_model
from crisalad_jax.checkpoints.weights import load_weights
from crisalad_jax.cli.common import echo, refuse_with, show_tables
from crisalad_jax.cli.flags import PluginFlag, TableFlags
from crisalad_jax.cli.tables import fact_lines, models_table
from crisalad_jax.utils.files import user_cache


class Models(PluginFlag, TableFlags):
    """List the models that others published, which --weights takes by name, or describe one."""

    name: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="NAME")] = None
    """Model to describe in full."""


def run(arguments: Models) -> dict[str, Any]:
    """Print the table of models, or all facts about one; return the result for --json."""
    name = arguments.name
    if name is not None:
        refuse_with("NAME", latex=arguments.latex)
        facts = _own_facts(name) if name in starter.FILES else _facts(published_model(name))
        for line in fact_lines(facts):
            echo(line)
        return facts
    models = tuple(PUBLISHED.values())
    show_tables(models_table(models), latex=arguments.latex)
    echo(f"{len(models)} models; * in the cache, {user_cache()}")
    echo(
        f"{starter.NAME}: the small model in this package, which extract, index and evaluate take "
        "by default"
    )
    for name in ("starter-1", "hog", "thumbnail"):
        echo(f"{name}: {_NOTES[name]}, also by name")
    echo("crisalad models NAME prints all about one: its images, paper, file and address")
    return {"cache": str(user_cache()), "models": [_facts(model) for model in models]}


def _facts(model: Published) -> dict[str, Any]:
    """Return what is known about a model, by name."""
    licence = {"licence": model.licence.name, "commercial": model.licence.commercial}
    return dataclasses.asdict(model) | licence | {"cached": is_cached(model)}


_NOTES = {
    starter.NAME: f"trained only on rendered images (docs/{starter.NAME}.md)",
    "starter-1": "the first version of starter, half as large",
    "hog": "a baseline that learns nothing: histograms of oriented gradients",
    "thumbnail": "a baseline that learns nothing: SeqSLAM's small grey images",
}


def _own_facts(name: str) -> dict[str, Any]:
    """Return what is known about a model in this package, as `_facts` does for published ones."""
    params, config = load_weights(starter.FILES[name])
    unsaid = dict.fromkeys(field.name for field in dataclasses.fields(Published))
    return unsaid | {
        "name": name,
        "descriptor": config.descriptor_dim,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(params)),
        "images": config.images_in_words,
        "file": str(starter.FILES[name]),
        "note": f"in this package; {_NOTES[name]}",
        "licence": "Apache-2.0",
        "commercial": True,
        "cached": True,
    }
