"""`crisalad data`."""

import dataclasses
import pathlib
from typing import Annotated, Any, Literal

import tyro

from crisalad_jax.cli.common import (
    echo,
    emit_json,
    refuse_with,
    show_tables,
)
from crisalad_jax.cli.flags import NEW_FOLDER, QuietFlag, TableFlags
from crisalad_jax.cli.tables import checked_table, fact_lines, sets_table
from crisalad_jax.config.checks import require
from crisalad_jax.data.sets import SETS, PublishedSet, check_set, fetch_set, find_set
from crisalad_jax.utils.errors import few


class Data(TableFlags, QuietFlag):
    """List public data sets, download one, or check which one a folder holds and what it lacks."""

    action: Annotated[
        tyro.conf.Positional[Literal["list", "fetch", "check"]],
        tyro.conf.arg(metavar="{list,fetch,check}"),
    ]
    """List the sets; fetch a set, or say how to get it by hand; or check a folder's counts, and its
    images."""
    what: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="NAME|DIR")] = None
    """A set's name, for list and fetch; a folder or a file of lists, for check."""
    to: Annotated[pathlib.Path | None, NEW_FOLDER] = None
    """With fetch: new folder for the set, which `crisalad evaluate --data` then reads."""
    set: str | None = None
    """With check: name of the expected set; by default the one in the folder's name, else any."""
    read: bool = True
    """With check: decode all images; --no-read only counts them."""


def run(arguments: Data) -> dict[str, Any] | None:
    """List the sets, fetch one, or check a folder; return the result for --json, unless written."""
    if arguments.action != "fetch":
        refuse_with(f"data {arguments.action}", to=arguments.to)
    if arguments.action != "check":
        refuse_with(f"data {arguments.action}", set=arguments.set)
    if arguments.action == "list":
        return _list(arguments)
    what = arguments.what
    require(what is not None, f"data {arguments.action}: found no name, expected one after it")
    if arguments.action == "fetch":
        return _fetch(find_set(str(what)), arguments)
    _check(pathlib.Path(str(what)), arguments.set, arguments)
    return None


def _list(arguments: Data) -> dict[str, Any]:
    if arguments.what is not None:
        refuse_with("NAME", latex=arguments.latex)
        published = find_set(arguments.what)
        facts = dataclasses.asdict(published)
        _show_facts(published, "DIR")
        return facts
    show_tables(sets_table(tuple(SETS.values())), latex=arguments.latex)
    echo("crisalad data list NAME prints all about one; crisalad data fetch NAME --to DIR gets it")
    return {"sets": [dataclasses.asdict(each) for each in SETS.values()]}


def _show_facts(published: PublishedSet, folder: str) -> None:
    """Print what is known about a set, and the steps to get it."""
    facts = {
        "set": published.title,
        "page": published.page,
        "licence": published.licence,
        "ask": published.ask,
        "size": None if published.gigabytes is None else f"{published.gigabytes} GB",
        "counts": "; ".join(part.words for part in published.parts) or None,
        "sha-256": ", ".join(file.sha256 for file in published.files if file.sha256) or None,
        "sources": "; ".join(published.sources),
        "note": published.note,
    }
    for line in fact_lines({name: value or "not known" for name, value in facts.items()}):
        echo(line)
    if published.is_fetched:
        echo(f"to get it: crisalad data fetch {published.name} --to {folder}")
        echo(f"to use it: {published.command.replace('DIR', folder)}")
        return
    echo("by hand:")
    for number, step in enumerate(published.by_hand(folder), 1):
        echo(f"{number}. {step}")


def _fetch(published: PublishedSet, arguments: Data) -> dict[str, Any]:
    folder = str(arguments.to or "DIR")
    if published.is_fetched:
        require(arguments.to is not None, "--to: found none, expected a new folder for the set")
        echo(f"{published.title}; licence: {published.licence or 'not known'}")
    else:
        _show_facts(published, folder)
    to = fetch_set(published.name, folder, quiet=arguments.quiet)
    echo(f"{to}: complete; {published.command.replace('DIR', folder)}")
    return _check(to, published.name, dataclasses.replace(arguments, read=False))


def _check(folder: pathlib.Path, expected: str | None, arguments: Data) -> dict[str, Any]:
    """Print which set a folder contains.

    Raises:
        InputError: it is not as published, or not complete.
    """
    checked = check_set(folder, expected, read=arguments.read, quiet=arguments.quiet)
    show_tables(checked_table(checked.parts), latex=arguments.latex)
    if checked.absent:
        echo(f"not in this folder: {'; '.join(checked.absent)}")
    values = {
        "folder": str(folder),
        "parts": [dataclasses.asdict(part) for part in checked.parts],
        "absent": list(checked.absent),
        "problems": list(checked.problems),
    }
    if arguments.action == "check" or checked.problems:
        emit_json(arguments.json, values)
    require(not checked.problems, f"{folder}: {few(checked.problems)}")
    return values
