"""The lines that `crisalad query` prints."""

from collections.abc import Iterator

from crisalad_jax.retrieval.maps.query import Answers

_GAP = "  "


def answer_lines(answers: Answers) -> Iterator[str]:
    """Yield the name of each query, and below it its answers; an unknown place has one line.

    Numbers stand in columns, and names at the ends of lines: a name that a terminal has no room for
    runs on in its next line, and is copied whole.
    """
    followed = answers.probabilities is not None
    probability = ["probability"] if followed else []
    position = ", ".join(answers.axes or ("position",))
    if answers.zone is not None:
        position += f" (zone {answers.zone})"
    head = ["rank", "similarity", *probability, position, "name"]
    asked: list[str | None] = []
    rows = [head]
    for name, known, (_, ranked) in zip(answers.names, answers.known, answers.rows(), strict=True):
        for answer in ranked if known else ranked[:1]:
            at = answers.position(answer.image) if known else None
            asked.append(name if answer.rank == 1 else None)
            rows.append(
                [
                    str(answer.rank) if known else "-",
                    f"{answer.similarity:.3f}",
                    *([f"{answer.probability:.3f}"] if followed else []),
                    "-" if at is None else ", ".join(f"{value:.9g}" for value in at.values()),
                    answer.image.name if known else "unknown",
                ]
            )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    lines = (
        _GAP.join((*(cell.rjust(width) for cell, width in zip(row, widths, strict=False)), row[-1]))
        for row in rows
    )
    yield next(lines)
    for query, line in zip(asked, lines, strict=True):
        if query is not None:
            yield query
        yield line
