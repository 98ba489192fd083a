"""The table that `crisalad query` prints."""

from rich.table import Table
from rich.text import Text

from crisalad_jax.retrieval.maps.query import Answers
from crisalad_jax.utils.output import printable


def answers_table(answers: Answers, title: str = "") -> Table:
    """Make a table of answers for the terminal; a query of an unknown place has one row."""
    followed = answers.probabilities is not None
    table = Table(title=printable(title), title_justify="left")
    table.add_column("query", overflow="fold")
    table.add_column("rank", justify="right")
    table.add_column("name", overflow="fold")
    table.add_column("similarity", justify="right", no_wrap=True)
    if followed:
        table.add_column("probability", justify="right", no_wrap=True)
    position = ", ".join(answers.axes or ("position",))
    if answers.zone is not None:
        position += f" (zone {answers.zone})"
    table.add_column(position, justify="right", overflow="fold")
    for known, (path, ranked) in zip(answers.known, answers.rows(), strict=True):
        shown = ranked if known else ranked[:1]
        for answer in shown:
            position = answers.position(answer.image) if known else None
            cells = (
                path.as_posix() if answer.rank == 1 else "",
                str(answer.rank) if known else "-",
                answer.image.name if known else "unknown",
                f"{answer.similarity:.3f}",
                *([f"{answer.probability:.3f}"] if followed else []),
                "-" if position is None else ", ".join(f"{v:.9g}" for v in position.values()),
            )
            # `Text` keeps square brackets in a name from being markup.
            table.add_row(*map(Text, map(printable, cells)), end_section=answer.rank == len(shown))
    return table
