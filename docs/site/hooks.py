"""What makes a site of pages that are written to be read in the repository.

- The navigation is the lists of docs/README.md: one place to keep.
- Files outside docs/ that a page links to become pages of the site, at the same path.
- Headings have the anchors that forges give them; lists and tables may follow a line of text.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

HERE = "docs/"
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)#\s]+)")
FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
BLANK = re.compile(r"^((?![-|#>\d ]).*\S)\n(?=- |\|)", re.MULTILINE)
OUTSIDE = ("experiments", "drivers", "examples", "hil", "mock_robot", "tests")
"""Folders of the repository that pages may link to; docs/ has none of these names."""

LANGUAGES = {".py": "python", ".yaml": "yaml", ".yml": "yaml", ".json": "json"}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Navigation from the index, anchors as forges make them."""
    docs = Path(config.docs_dir)
    config.nav = [{"Home": "README.md"}, *navigation(docs)]
    toc: dict[str, Any] = config.mdx_configs.setdefault("toc", {})
    toc["slugify"] = slug
    return config


def navigation(docs: Path) -> list[Any]:
    """Sections, groups and pages in the order of docs/README.md."""
    sections: list[Any] = []
    section: list[Any] = []
    group: list[Any] = []
    for line in (docs / "README.md").read_text("utf-8").splitlines():
        if line.startswith("## "):
            group = section = []
            sections.append({line[3:]: section})
        elif line.startswith("### "):
            group = []
            section.append({line[4:]: group})
        elif entry := re.match(r"- \[([^\]]+)\]\(([^)]+)\)", line):
            group.append({entry[1]: site_uri("README.md", entry[2])})
    records = sorted(path.name for path in (docs / "decisions").glob("[0-9]*.md"))
    group += [f"decisions/{name}" for name in records]
    return sections


def slug(title: str, separator: str) -> str:
    """Anchor of a heading, as the usual forges make it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", separator)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what pages link to outside docs/, and what that links to in turn."""
    root = Path(config.docs_dir).parent
    waiting = {file.src_uri: file.content_string for file in files.documentation_pages()}
    while waiting:
        uri, text = waiting.popitem()
        for target in LINK.findall("".join(FENCE.split(text)[::2])):
            wanted, source = site_uri(uri, target), root / in_repository(uri, target)
            if files.get_file_from_path(wanted) or not source.exists() or HERE in f"{source}/":
                continue
            content = shown(source)
            made = File.generated(config, wanted, content=content)
            made.inclusion = InclusionLevel.NOT_IN_NAV
            files.append(made)
            waiting[wanted] = content
    return files


def in_repository(uri: str, target: str) -> str:
    """Path in the repository of what the page `uri` links to."""
    outside = uri.split("/")[0] in OUTSIDE
    return posixpath.normpath(posixpath.join("" if outside else HERE, uri, "..", target))


def site_uri(uri: str, target: str) -> str:
    """Where the site has what the page `uri` links to; what is outside docs/ keeps its path."""
    path = in_repository(uri, target)
    if path.startswith(HERE):
        return path.removeprefix(HERE)
    return path if path.endswith(".md") else f"{path}.md"


def shown(source: Path) -> str:
    """Return a file of the repository as a page, or the files of a folder."""
    if source.is_dir():
        named = (path.name for path in sorted(source.iterdir()) if path.name != "__pycache__")
        lines = [f"- [{name}]({source.name}/{name})" for name in named]
        return f"# {source.name}\n\n" + "\n".join(lines) + "\n"
    text = source.read_text("utf-8")
    if source.suffix == ".md":
        return text
    return f"# {source.name}\n\n```{LANGUAGES.get(source.suffix, '')}\n{text}```\n"


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Links as the site has them; a blank line before lists and tables, which forges need not."""
    uri = page.file.src_uri

    def there(link: re.Match[str]) -> str:
        return posixpath.relpath(site_uri(uri, link[1]), posixpath.dirname(uri) or ".")

    parts = FENCE.split(markdown)
    parts[::2] = [BLANK.sub(r"\1\n\n", LINK.sub(there, part)) for part in parts[::2]]
    return "".join(parts)
