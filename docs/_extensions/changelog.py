"""Put the changelog into the site, where its links start from the folder of the documentation."""

import pathlib
from typing import Any

CHANGELOG = pathlib.Path(__file__).parents[2] / "CHANGELOG.md"


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return a page's text: of changelog.md the changelog's, with links as the site has them."""
    if page.file.src_uri != "changelog.md":
        return markdown
    return CHANGELOG.read_text(encoding="utf-8").replace("](docs/", "](")
