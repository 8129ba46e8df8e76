"""Links in the documentation lead somewhere; nothing cites what is not in the repository."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.paths import DOCS, ROOT

PAGES = sorted([ROOT / "README.md", *(DOCS).rglob("*.md")])
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
SHIPPED = ("hil", "drivers", "mock_robot", "docs", "experiments", "benchmarks")
TEXT = (".py", ".md", ".yaml", ".json", ".j2", ".css")
ABSENT = re.compile(r"ARCHITECTURE|STYLE\.md|\bfacts/|\bpapers/")
"""Working papers of those who built this; a reader of the repository has none of them."""


def anchors(page: Path) -> set[str]:
    """Of the headings, as the usual forges make them."""
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for link in LINK.findall(page.read_text("utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


def test_every_page_is_in_the_index() -> None:
    index = (DOCS / "README.md").read_text("utf-8")
    linked = {link.partition("#")[0] for link in LINK.findall(index)}
    pages = {str(page.relative_to(DOCS)) for page in PAGES if page.name != "README.md"}
    assert {page for page in pages if not page.startswith("decisions/")} <= linked


def test_every_folder_of_hil_is_in_the_layout() -> None:
    layout = (DOCS / "explanation" / "architecture.md").read_text("utf-8")
    folders = [path.parent.name for path in (ROOT / "hil").glob("*/__init__.py")]
    assert [name for name in folders if f"`hil/{name}`" not in layout] == []


def test_nothing_cites_what_is_not_in_the_repository() -> None:
    files = [ROOT / "Makefile", ROOT / "README.md", ROOT / ".ci" / "run"]
    for folder in SHIPPED:
        files += [file for file in (ROOT / folder).rglob("*") if file.suffix in TEXT]
    assert [file.name for file in files if ABSENT.search(file.read_text("utf-8"))] == []
