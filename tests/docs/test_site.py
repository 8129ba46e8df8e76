"""`make docs`: every page is in the navigation, links lead somewhere, no network is needed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.paths import DOCS, ROOT

pytest.importorskip("material", reason="the site needs hil[docs]")

LOADED = re.compile(
    r"<(?:script|link|img|iframe)\b[^>]*?\b(?:src|href)=\"?((?:https?:)?//[^\"> ]+)"
)


def build(root: Path, site: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)],
        cwd=root,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=100,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = build(ROOT, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def pages(site: Path) -> Iterator[tuple[Path, str]]:
    for path in sorted(site.rglob("*.html")):
        yield path, path.read_text("utf-8")


@pytest.mark.thorough
def test_every_page_is_in_the_navigation(site: Path) -> None:
    home = (site / "reference" / "spec.html").read_text("utf-8")
    tabs = re.findall(r'<a href="([^"]+)" class="md-(?:tabs|nav)__link', home)
    linked = {(site / "reference" / link).resolve() for link in tabs if "#" not in link}
    docs = DOCS
    made = {(site / path.relative_to(docs)).with_suffix(".html") for path in docs.rglob("[!R]*.md")}
    assert {path.relative_to(site).as_posix() for path in made - linked} == set()


@pytest.mark.thorough
def test_a_readme_is_a_page_of_its_section_and_not_the_section(site: Path) -> None:
    home = re.sub(r"\s+", " ", (site / "index.html").read_text("utf-8"))
    for path, title in (("experiments", "Ready experiments"), ("decisions", "Decision records")):
        assert re.search(
            rf'href="{path}/index.html"[^>]*> <span class="md-ellipsis"> {title}', home
        )


@pytest.mark.thorough
def test_links_lead_to_files_of_the_site(site: Path) -> None:
    broken = []
    for path, text in pages(site):
        for link in (
            re.findall(r'(?:href|src)="([^":#?]+)[#?"]', text) if path.name != "404.html" else ()
        ):
            if not (path.parent / link).resolve().exists():
                broken.append(f"{path.relative_to(site)}: {link}")
    assert broken == []


@pytest.mark.thorough
def test_files_out_of_docs_are_pages(site: Path) -> None:
    page = (site / "how-to" / "load-sweep.html").read_text("utf-8")
    assert 'href="../experiments/load_generalisation.yaml.html"' in page
    shown = (site / "experiments" / "load_generalisation.yaml.html").read_text("utf-8")
    assert "load-generalisation" in re.sub("<[^>]+>", "", shown)


@pytest.mark.thorough
def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    assert [
        (path.name, found) for path, text in pages(site) for found in LOADED.findall(text)
    ] == []
    assert not [p for p in site.rglob("*.css") if re.search(r"url\(\"?(https?:)?//", p.read_text())]
    assert (site / "search" / "search_index.js").is_file()
    assert 'src="../site/iframe-worker.js"' in (site / "how-to" / "excite.html").read_text("utf-8")


@pytest.mark.thorough
def test_what_is_wrong_ends_the_build(tmp_path: Path) -> None:
    shutil.copytree(DOCS, tmp_path / "docs")
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    for name in ("experiments", "drivers"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "docs" / "lost.md").write_text(
        "# Lost\n\n[gone](gone.md) [anchor](how-to/excite.md#no-such-heading)\n", "utf-8"
    )
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    told = done.stderr + done.stdout
    assert 'not included in the "nav"' in told
    assert "link 'gone.md', but" in told
    assert "does not contain an anchor '#no-such-heading'" in told
