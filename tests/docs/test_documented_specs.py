"""The specs that pages show whole, run as they stand there: completed, and passed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import hil
from tests.support.paths import ROOT

PAGES = ("README.md",)
"""The tutorial writes its spec by `hil new`, which test_docs_commands.py does."""
FEW = 12
"""Poses that are enough to see that the numbers hold; the 650 of the README take a minute."""


def specs() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        blocks = re.findall(r"```yaml\n(.*?)```", (ROOT / page).read_text("utf-8"), re.S)
        found += [(f"{page}:{i}", block) for i, block in enumerate(blocks)]
    return found


def fewer_poses(text: str) -> str:
    return re.sub(r"waypoints: (\d+)", lambda m: f"waypoints: {min(FEW, int(m[1]))}", text)


def test_the_pages_show_a_spec() -> None:
    assert {name.partition(":")[0] for name, _ in specs()} == set(PAGES)


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "text"), specs(), ids=[name for name, _ in specs()])
def test_a_spec_shown_to_newcomers_passes(name: str, text: str, tmp_path: Path) -> None:
    spec = tmp_path / "spec.yaml"
    spec.write_text(fewer_poses(text), "utf-8")
    report = hil.run(hil.load(spec), runs=tmp_path / "runs")
    assert report.error is None
    assert (report.outcome, report.verdict) == ("completed", "passed")
