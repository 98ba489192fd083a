"""Tabulate claimed recalls and how they were measured, for `docs/claims.md` and the README.

    python scripts/bench/study_claims.py [claims] [models] [leakage]

claims: every row of `docs/claims/claims.toml`. models: their licence, descriptor length and
parameters from the table of published models, and the speed that `bench_claims.py` measured.
leakage: the information that leaks between images of a batch in the published evaluations of models
whose images attend to each other, computed only from their rules: which frames are correct, in
which order they come, and how many are in a batch.
"""

import json
import pathlib
import tomllib
from typing import Any, NamedTuple

import numpy as np
from tables import Study, Table, flags, leave, read_some

from crisalad_jax.checkpoints.published import PUBLISHED
from crisalad_jax.evaluation.leakage import masked, mirrored_share, near, same_place_share
from crisalad_jax.evaluation.protocols import PROTOCOLS
from crisalad_jax.retrieval.grouping import Batches, batches_of
from crisalad_jax.utils.files import atomic_path

ROOT = pathlib.Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "claims"
README = ROOT / "README.md"
SETS = ("pitts30k", "msls", "nordland", "tokyo")
HEADERS = ("Pitts30k", "MSLS-val", "Nordland", "Tokyo 24/7")
BEST = 10
DASH = "\N{EN DASH}"


def rows() -> list[dict[str, Any]]:
    text = (FOLDER / "claims.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)["row"]


def recall(row: dict[str, Any], name: str) -> str:
    """Format the printed recall on a set; for Nordland also those of other splits, marked."""
    found = [f"{row[name]:.1f}"] if name in row else []
    if name == "nordland":
        found += [f"{row['nordland_bench']:.1f}*"] if "nordland_bench" in row else []
        found += [f"{row['nordland_other']:.1f}†"] if "nordland_other" in row else []
    return ", ".join(found) or DASH


def facts(row: dict[str, Any], speeds: dict[str, float]) -> tuple[str, str, str, str]:
    """Return licence, descriptor length, millions of parameters, and relative speed."""
    if "models" not in row:
        return DASH, f"{row['descriptor']:,}", DASH, DASH
    model = PUBLISHED[row["models"][0]]
    speed = speeds.get(model.name)
    licence = model.licence.name
    if model.licence.commercial is False:
        licence += ", not for commerce"
    millions = f"{model.parameters / 1e6:,.0f}"
    return licence, f"{model.descriptor:,}", millions, DASH if speed is None else f"{speed:.2f}"


def command(row: dict[str, Any]) -> str:
    """Return the arguments after `crisalad evaluate --data SET` that reproduce a row."""
    if "command" in row:
        return f"`{row['command']}`"
    words = [f"--weights {' | '.join(row['models'])}", *([row["flags"]] if "flags" in row else [])]
    return f"`{' '.join(words)}`".replace(" | ", "`, `")


def claims() -> Study:
    """Tabulate printed recalls, and how they were measured."""
    header = ("model", "measured", "printed in", *HEADERS)
    found = [
        (row["title"], row["how"], row["source"], *(recall(row, name) for name in SETS))
        for row in rows()
    ]
    caption = (
        "R@1 in percent, as printed. \\* VPR-Bench's lists of Nordland; † another split, see "
        '"measured", which begins with the image size.'
    )
    return Study(Table(header, found, caption, 3), found)


def measured() -> dict[str, Any]:
    """Read what `bench_claims.py` measured; empty if it has not run."""
    path = FOLDER / "speed.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def models() -> Study:
    """Tabulate what each model costs, and the command that reproduces its row."""
    speed = measured()
    speeds = speed.get("times_megaloc", {})
    header = ("model", "reproduces", "licence", "dimensions", "million parameters", "speed")
    found = [(row["title"], command(row), *facts(row, speeds)) for row in rows()]
    device = f" on one {speed['device']}" if speed else ""
    caption = (
        f"Speed: images described per second{device}, as a multiple of MegaLoc's, at the model's "
        "image size, in bfloat16. Append the second column to `crisalad evaluate --data SET`."
    )
    return Study(Table(header, found, caption, 3), found)


def best() -> str:
    """List rows with the highest mean of Pitts30k and MSLS on independent images, with speeds."""
    speeds = measured()["images_per_second"]
    alone = [
        row
        for row in rows()
        if {"pitts30k", "msls"} <= row.keys()
        and "published:" not in row.get("flags", "")
        and "models" in row
    ]
    alone.sort(key=lambda row: -(row["pitts30k"] + row["msls"]))
    lines = [
        "| model | Pitts30k | MSLS-val | Nordland | images/s | name |",
        "| --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for row in alone[:BEST]:
        name = row["models"][0]
        cells = (*(recall(row, each) for each in SETS[:3]), f"{speeds[name]:,.0f}")
        lines.append(f"| {row['title']} | {' | '.join(cells)} | `{name}` |")
    return "\n" + "\n".join(lines) + "\n"


class Rules(NamedTuple):
    """A set as in its evaluation: the positions of images, in any unit, in the order of names."""

    name: str
    queries: np.ndarray
    database: np.ndarray
    radius: float

    @property
    def positives(self) -> list[np.ndarray]:
        order = np.argsort(self.database, kind="stable")
        ordered = self.database[order]
        starts = np.searchsorted(ordered, self.queries - self.radius, "left")
        ends = np.searchsorted(ordered, self.queries + self.radius, "right")
        return [order[start:end] for start, end in zip(starts, ends, strict=True)]


def known_rules() -> list[Rules]:
    """Return the sets whose rules alone determine which images come next to each other.

    Nordland: winter frame i is correct for summer frames i - 10 to i + 10. SPED and AmsterTime: one
    image for each. Pitts30k: the 24 views of a panorama share one position, by which names are
    sorted; panoramas are assumed to be more than 25 m apart, so the shares are lower bounds.
    """
    frames = np.arange(27_592.0)
    return [
        Rules("Nordland", frames, frames, 10),
        Rules("SPED", np.arange(607.0), np.arange(607.0), 0),
        Rules("AmsterTime", np.arange(1231.0), np.arange(1231.0), 0),
        Rules("Pitts30k", np.arange(6816) // 24 * 1.0, np.arange(10_000) // 24 * 1.0, 0),
    ]


def batches(positions: np.ndarray, grouping: str, size: int, radius: float, seed: int) -> Batches:
    if grouping != "masked":
        return batches_of(len(positions), grouping, size, seed)
    return masked(batches_of(len(positions), "sequential", size), near(flat(positions), radius))


def flat(positions: np.ndarray) -> np.ndarray:
    return np.stack([positions, np.zeros(len(positions))], axis=1)


def leakage() -> Study:
    found, values = [], []
    for rules in known_rules():
        name = rules.name.lower()
        sizes: dict[int, list[str]] = {}
        for method, protocol in PROTOCOLS.items():
            known = [n for key, n in protocol.sizes.items() if key in name] or [protocol.otherwise]
            if known[0]:
                sizes.setdefault(known[0], []).append(method)
        for size, methods in sizes.items():
            for grouping in ("sequential", "shuffled", "masked"):
                sides = [
                    (positions, batches(positions, grouping, size, rules.radius, seed))
                    for seed, positions in enumerate((rules.queries, rules.database))
                ]
                shares = [
                    same_place_share(each, near(flat(at), rules.radius)) for at, each in sides
                ]
                mirrored = mirrored_share(sides[0][1], sides[1][1], rules.positives)
                row = [*shares, mirrored]
                values.append([rules.name, size, methods, grouping, *row])
                cells = (DASH if each is None else f"{100 * each:.1f}" for each in row)
                of = ", ".join(methods) if grouping == "sequential" else ""
                found.append((rules.name, str(size), grouping, of, *cells))
    header = ("set", "images", "batches", "used by", "same place, queries", "database", "mirrored")
    caption = (
        "Percent of the other images in a batch: those that show an image's own place, and those "
        "whose place is also in the batch of the query's correct answer."
    )
    return Study(Table(header, found, caption, 4), values)


STUDIES = {"claims": claims, "models": models, "leakage": leakage}


def main() -> None:
    arguments = read_some(flags("Tabulate claimed recalls.", "docs/claims"), STUDIES)
    for name in arguments.studies:
        leave(name, STUDIES[name](), arguments)
    if "claims" in arguments.studies and arguments.out.resolve() == FOLDER.resolve():
        start, end = "<!-- best -->\n", "<!-- end of best -->"
        before, rest = README.read_text(encoding="utf-8").split(start)
        with atomic_path(README) as temporary:
            after = rest.split(end)[1]
            temporary.write_text(f"{before}{start}{best()}{end}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
