"""`crisalad publish`."""

import pathlib
from typing import Annotated, Any

import tyro

from crisalad_jax.cli.common import echo
from crisalad_jax.cli.flags import JsonFlag, PluginFlag, QuietFlag
from crisalad_jax.experiments.publish import publish


class Publish(JsonFlag, PluginFlag, QuietFlag):
    """Write a run's model with a model card, to a folder or to Hugging Face's hub."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """Folder of the run; its best weights are used, or else its last."""
    to: str
    """New folder, or hf://OWNER/NAME at the hub (docs/how-to/share-a-model.md)."""
    licence: str
    """The weights' licence, by the hub's name for it, such as apache-2.0 or cc-by-nc-4.0."""
    data: str | None = None
    """What the model was trained on, in words; by default what the run recorded."""
    evaluation: tuple[pathlib.Path, ...] = ()
    """Files that `crisalad evaluate --json` wrote for the model; the card shows their recalls."""


def run(arguments: Publish) -> dict[str, Any]:
    """Publish the model, and print where it is; return the result for --json."""
    where = publish(
        arguments.run,
        arguments.to,
        licence=arguments.licence,
        data=arguments.data,
        evaluations=arguments.evaluation,
        quiet=arguments.quiet,
    )
    echo(f'{where}: model.safetensors, config.json, README.md; cj.load("{arguments.to}") reads it')
    return {"out": where, "licence": arguments.licence}
