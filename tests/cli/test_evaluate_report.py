"""`crisalad evaluate --report`: the page holds what the command found."""

import json

from tests.cli.test_cli import succeeds
from tests.conftest import BATCH
from tests.experiments.report.test_page import Page


def test_the_page_holds_the_numbers_of_the_json(shared, tmp_path, capfd, weights):
    said = succeeds(
        capfd,
        *("evaluate", "--data", shared / "town", "--weights", weights),
        *("--batch-size", BATCH, "--grouping", "single,sequential", "--quiet"),
        *("--report", tmp_path / "page", "--json", tmp_path / "found.json", "--precision", 0.6),
    )
    assert f"report: {tmp_path}/page/index.html" in said
    page_text = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    page = Page(page_text)
    results = json.loads((tmp_path / "found.json").read_text())["results"]
    assert [e["text"] for e in page.all("th", scope="row")] == 3 * ["single", "sequential"]
    cells = iter(e["text"] for e in page.all("td"))
    for result in results:
        for value in result["recalls"].values():
            assert next(cells).startswith(f"{100 * value:.1f}")
        for name in ("average_precision", "recall_at_full_precision"):
            assert next(cells) == f"{100 * result[name]:.1f}"
    for result in results:
        assert next(cells) == f"{100 * result['recalls']['R@1']:.1f}"
        gain = result["over_single"]
        points = [100 * number for number in (gain["R@1"], *gain["interval"])] if gain else []
        assert next(cells) == ("{:+.1f}{:+.1f} to {:+.1f}".format(*points) if gain else "-")
        shares = [
            "-" if share is None else f"{100 * share:.1f}"
            for share in (*result["same_place"].values(), result["mirrored"])
        ]
        assert next(cells) == " / ".join(shares[:2])
        assert next(cells) == shares[2]
    for result in results:
        point = result["operating_point"]
        assert next(cells) == f"{point['min_similarity']:.9g}"
        assert next(cells).startswith(f"{100 * point['precision']:.1f}")
        assert next(cells).startswith(f"{100 * point['right'] / 5:.1f}")
        assert next(cells) == f"{point['right']} of {point['answered']}"
        next(cells)
        # Five queries are few, as the terminal and the page say.
        words = f"{result['grouping']}: rests on few queries: {point['right']} of "
        assert words in said
        assert words in page_text
    assert next(cells, None) is None
    assert json.loads(page.all("pre")[0]["text"])["model"]["image_size"] == [42, 56]
