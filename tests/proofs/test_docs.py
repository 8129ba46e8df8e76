"""Commands in the documentation that take long, run as they stand there (docs_commands.py)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support import docs_commands

PAGES = [page for page in docs_commands.PAGES if "<!-- run long" in page.read_text("utf-8")]


@pytest.mark.proof
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_page_runs(page: Path, tmp_path: Path) -> None:
    name = page.relative_to(docs_commands.ROOT).as_posix()
    done = docs_commands.run_page(name, ("run", "run long"), tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
