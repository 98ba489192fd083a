"""Flags for every field of a configuration, and for those of its parts.

`--model.aggregator gem` chooses a registered part; `--model.aggregator.FIELD` sets its fields.
"""

import ast
import contextlib
import dataclasses
import io
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal, get_args, get_type_hints

import tyro

from crisalad_jax.config.part import NAME, Part
from crisalad_jax.config.registry import Registry
from crisalad_jax.config.short_repr import field_docs
from crisalad_jax.utils.errors import InputError, locate_errors

_KIND = "_kind"
"""Attribute of a dataclass that `flags_of` makes: the configuration's class."""


def flags_of(config: Any, arguments: Sequence[str], preset: str, path: str = "") -> Any:
    """Make a stand-in for a configuration, with the same fields and values but without checks.

    tyro makes a flag for every field of the stand-in's class. Parts that the arguments name replace
    those of the configuration, so that there are flags for their fields.

    Args:
        config: the configuration.
        arguments: the arguments of the command line.
        preset: name of the preset that sizes the model and its parts, such as "b14".
        path: dotted name of the configuration's own flag; empty for the outermost configuration.

    Raises:
        InputError: the arguments name an unknown part.
    """
    fields: list[tuple[str, Any, Any]] = []
    if isinstance(config, Part):
        registry: Registry[Any] = config.registry
        chosen = find_flag(arguments, f"--{path}")
        if chosen is not None and registry.find(chosen) is not type(config):
            config = registry.make(chosen, preset)
        others = f", or {registry.others}" if registry.others else ""
        help_text = f"Which {registry.kind}{others}; its own settings follow."
        names = Literal[tuple({*registry, config.part_name})]  # pyright: ignore
        hint = Annotated[names, tyro.conf.arg(name="", help=help_text)]
        fields.append(("part_name", hint, config.part_name))
    kind = type(config)
    hints, docs = get_type_hints(kind), field_docs(kind)
    namespace: dict[str, Any] = {"__doc__": kind.__doc__, _KIND: kind}
    for field in dataclasses.fields(kind):
        value = getattr(config, field.name)
        where = f"{path}.{field.name}".strip(".")
        if dataclasses.is_dataclass(value):
            value = flags_of(value, arguments, preset, where)
            hint = type(value)
        elif isinstance(value, tuple) and dataclasses.is_dataclass(get_args(hints[field.name])[0]):
            value = _flags_of_each(value, arguments, preset, where)
            hint = type(value)
        elif field.name == NAME:
            namespace[NAME] = value
            continue
        else:
            hint = Annotated[hints[field.name], tyro.conf.arg(help=docs.get(field.name))]
        fields.append((field.name, hint, dataclasses.field(default=value)))
    made = dataclasses.make_dataclass(kind.__name__, fields, frozen=True, namespace=namespace)
    return made()


def _flags_of_each(configs: Sequence[Any], arguments: Sequence[str], preset: str, path: str) -> Any:
    """Make a stand-in for a tuple of configurations, whose flags have their names."""
    made = {each.name: flags_of(each, arguments, preset, f"{path}.{each.name}") for each in configs}
    fields = [(name, type(each), dataclasses.field(default=each)) for name, each in made.items()]
    return dataclasses.make_dataclass("Each", fields, frozen=True, namespace={_KIND: tuple})()


def config_of(flags: Any) -> Any:
    """Make the configuration from a stand-in that `flags_of` made and tyro has filled in.

    Raises:
        InputError: the configuration's own checks reject a value.
    """
    kind = getattr(flags, _KIND)
    fields = dataclasses.fields(flags if kind is tuple else kind)
    given = {field.name: getattr(flags, field.name) for field in fields}
    values = {
        name: config_of(value) if hasattr(value, _KIND) else value for name, value in given.items()
    }
    return tuple(values.values()) if kind is tuple else kind(**values)


def flag_values(arguments: Sequence[str], name: str) -> list[list[str]]:
    """List the values of each occurrence of a flag, given as FLAG VALUE ... or FLAG=VALUE."""
    found = []
    for place, argument in enumerate(arguments, 1):
        flag, equals, value = argument.partition("=")
        if flag.replace("_", "-") == name.replace("_", "-"):
            after = itertools.takewhile(lambda each: not each.startswith("--"), arguments[place:])
            found.append([value] if equals else list(after))
    return found


def last_values(arguments: Sequence[str], name: str) -> list[str]:
    """Return the values of the last occurrence of a flag; an empty list if there is none."""
    return (flag_values(arguments, name) or [[]])[-1]


def find_flag(arguments: Sequence[str], name: str) -> str | None:
    """Return the first value of the last occurrence of a flag; None if there is none."""
    return next(iter(last_values(arguments, name)), None)


def parse_changes(config: Any, arguments: Sequence[str], preset: str, what: str) -> Any:
    """Apply command-line overrides to a configuration, with the checks of a command line.

    Args:
        config: the configuration to change.
        arguments: flags and values as on a command line; booleans are True or False.
        preset: name of the preset that sizes the model and its parts, such as "b14".
        what: text with which error messages begin.

    Returns:
        A configuration of the same class.

    Raises:
        InputError: there is no such flag or part, or a value does not fit; the message is one line.
    """
    with locate_errors(f"{what}: "), refusals(arguments):
        default = flags_of(config, arguments, preset)
        parsed = tyro.cli(
            type(default),
            prog=what,
            args=arguments,
            add_help=False,
            config=(tyro.conf.FlagConversionOff,),
        )
        return config_of(parsed)


_WIDE = "100000"
"""Terminal width that no line of tyro's boxes fills: a narrower one breaks names."""


@contextlib.contextmanager
def refusals(arguments: Sequence[str], *, wide: bool = True) -> Iterator[None]:
    """Raise an InputError in place of the box with which tyro reports an error and exits.

    Args:
        arguments: the arguments of the command line, to find the flag of a value.
        wide: whether to let tyro print wider than the terminal; False if it may print a help text.

    Raises:
        InputError: tyro's error in one line, or the error of a configuration's own check.
    """
    box, columns = io.StringIO(), os.environ.get("COLUMNS")
    if wide:
        os.environ["COLUMNS"] = _WIDE
    try:
        with contextlib.redirect_stderr(box):
            yield
    except SystemExit as stop:
        if not stop.code:  # after a help
            raise
        error: BaseException | None = stop
        while error is not None and not isinstance(error, InputError):
            error = error.__context__
        reason = _refusal(_unboxed(box.getvalue()), arguments) if error is None else str(error)
        raise InputError(reason) from stop
    finally:
        if columns is not None:
            os.environ["COLUMNS"] = columns
        elif wide:
            del os.environ["COLUMNS"]


# Beginnings of the parts of tyro's boxes that repeat the first one.
_ASIDES = ("Argument help", "Got errors", "For full")


def _unboxed(box: str) -> list[str]:
    """Extract the texts of tyro's boxes, without frames, help texts and footer."""
    sections = [[]]
    # The title is dropped. Without UTF-8 on stdout, the frame consists of spaces and hyphens.
    for line in box.splitlines()[1:]:
        row = line[2:].rstrip("│ ")
        if not row.strip("─╯-"):
            sections.append([])
        elif not row.startswith(" " * 5):
            sections[-1].append(row.strip())
    texts = [" ".join(rows) for rows in sections]
    return [text for text in texts if text and not text.startswith(_ASIDES)]


def plain_metavar(text: str) -> str:
    """Rewrite tyro's placeholder for a flag's value in a plainer style, without the None choice."""
    text = text.replace("{None}|", "").replace("{None,", "{")
    text = re.sub(r"\[(\w+) \[\1 \.\.\.\]\]|(\w+) \[\2 \.\.\.\]", r"\1\2...", text)
    return re.sub(r"^\{(\w+ .*|\w+\.\.\.)\}$", r"\1", text)


_KINDS = {"INT": "whole number", "FLOAT": "number"}


def _expected(metavar: str) -> str:
    """Describe the expected values in words, if they are numbers or choices."""
    parts = plain_metavar(metavar).split()
    kind = _KINDS.get(parts[0].removesuffix("..."))
    if kind is None:
        names = re.fullmatch(r"\{(.*)\}", plain_metavar(metavar))
        return plain_metavar(metavar) if names is None else f"one of {names[1].replace(',', ', ')}"
    if parts[0].endswith("..."):
        return f"{kind}s"
    return f"a {kind}" if len(parts) == 1 else f"{len(parts)} {kind}s"


def _refusal(texts: Sequence[str], arguments: Sequence[str]) -> str:
    """Rewrite tyro's messages in our style; unknown ones stay as they are.

    Args:
        texts: the parts of its box.
        arguments: the command line's arguments.
    """
    said: list[str] = []
    for text in texts:
        if found := re.match(
            r"Error parsing (\S+): (?:invalid|could not) .*?(int|float).*?: (.*)", text
        ):
            said.append(f"{found[1]}: found {found[3]}, expected {_expected(found[2].upper())}")
        elif found := re.match(
            r"Error parsing (\S+): no type matching (.+) could .*? (\[.*\])", text
        ):
            values = " ".join(ast.literal_eval(found[3]))
            said.append(f"{found[1]}: found {_or_none(values)}, expected {_expected(found[2])}")
        elif found := re.match(r"invalid choice (.*) for argument '(.*)'\. .* one of (.*)\.", text):
            names = ", ".join(name for name in ast.literal_eval(found[3]) if name != "None")
            said.append(f"{found[2]}: found {found[1]}, expected one of {names}")
        elif found := re.match(r"Missing value for argument '(.*)'. Expected (\d+) values", text):
            values = " ".join(last_values(arguments, found[1]))
            words = "a value" if found[2] == "1" else f"{found[2]} values"
            said.append(f"{found[1]}: found {_or_none(values)}, expected {words}")
        elif found := re.match(r"Missing from .*?: (-.*|[A-Z].*)", text):
            said.append(f"missing {plain_metavar(found[1])}")
        elif found := re.match(r"Unrecognized options: (.*)", text):
            # Tyro puts commas between them, but none if a flag is missing too.
            tokens = [each for each in re.split(", | ", found[1]) if each in arguments]
            said.insert(0, _unknown(tokens, arguments))
        elif found := re.match(r"(?:Perhaps you meant|Arguments similar to \S+): (.*)", text):
            said.append(f"did you mean {plain_metavar(found[1])}?")
        else:
            said.append(text)
    return "; ".join(said)


def _or_none(values: str) -> str:
    return repr(values) if values else "none"


def _unknown(tokens: Sequence[str], arguments: Sequence[str]) -> str:
    """Describe arguments that tyro does not accept: unknown flags, or too many values."""
    if not tokens:  # values with commas or spaces in them
        return "found values without a flag before them"
    flags = [token.partition("=")[0] for token in tokens if token.startswith("-")]
    if flags:
        return f"{', '.join(flags)}: found no such flag{'s' if len(flags) > 1 else ''}"
    before = itertools.takewhile(lambda each: each != tokens[0], arguments)
    flag = next((each for each in reversed(list(before)) if each.startswith("--")), None)
    if flag is None:
        return f"found {tokens[0]!r} without a flag before it"
    values = last_values(arguments, flag)
    most = len(values) - sum(each in values for each in tokens)
    words = ("no value", "one value")[most] if most < 2 else f"{most} values"
    return f"{flag}: found {' '.join(values)!r}, expected {words}"


def parse_settings(
    kind: type, program: str, arguments: Sequence[str], defaults: Any, preset: str
) -> Any:
    """Parse a command's flags, with one for every field of a configuration and of its parts.

    Args:
        kind: the command's class (`cli.flags.Flags`). Its field `settings` takes the configuration,
            and a field `image_size`, if there is one, replaces the model's.
        program: the command's name, for messages.
        arguments: the arguments of the command line.
        defaults: the configuration that the flags change.
        preset: name of the preset that sizes the model and its parts, such as "b14".

    Returns:
        An instance of a subclass of `kind`.

    Raises:
        InputError: there is no such part, or the configuration's checks reject a value.
    """
    parsed: Any = tyro.cli(
        with_settings(kind, arguments, defaults, preset), prog=program, args=arguments
    )
    given = parsed.settings
    size = getattr(parsed, "image_size", None)
    if size is not None:
        # Before the checks: the preset's own size may not fit another backbone.
        model = dataclasses.replace(given.model, image_size=size)
        given = dataclasses.replace(given, model=model)
    return dataclasses.replace(parsed, settings=config_of(given))


def with_settings(kind: type, arguments: Sequence[str], defaults: Any, preset: str) -> type:
    """Make a command's class with a flag for every field of a configuration; see `parse_settings`.

    Raises:
        InputError: the arguments name an unknown part.
    """
    default = flags_of(defaults, arguments, preset)
    hint = Annotated[type(default), tyro.conf.arg(name="")]
    members = {"__doc__": kind.__doc__, "__annotations__": {"settings": hint}, "settings": default}
    return type(kind.__name__, (kind,), members)
