"""The pages about the pytest plug-in: what they show runs, and they leave nothing out."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from hil.testing import plugin
from hil.testing.mocks import CanBus, MockRobot, UrController
from tests.support.paths import DOCS

HOW_TO = (DOCS / "how-to" / "test-your-code.md").read_text("utf-8")
REFERENCE = (DOCS / "reference" / "pytest-fixtures.md").read_text("utf-8")
CELLS = re.findall(r"^\| ([^|]+) \|", REFERENCE, re.MULTILINE)
NAMED = {name.partition("(")[0] for cell in CELLS for name in re.findall(r"`([^`]+)`", cell)}


def fixtures() -> list[str]:
    kind = type(plugin.mock_robot)
    return [name for name, what in vars(plugin).items() if isinstance(what, kind)]


def test_every_fixture_and_marker_has_a_row() -> None:
    assert len(fixtures()) == 7
    assert set(fixtures()) <= NAMED
    markers = {marker.partition("(")[0] for marker in plugin.MARKERS}
    assert {f"@pytest.mark.{name}" for name in markers} <= NAMED


@pytest.mark.parametrize("kind", [MockRobot, UrController, CanBus])
def test_every_member_has_a_row(kind: type) -> None:
    members = {name for base in kind.__mro__ for name in vars(base)}
    of_robots = {"capabilities", "identity", "limits", "connect", "close", "prepare"}
    of_robots |= {"read", "set_payload", "start", "stop"} if kind is MockRobot else set()
    public = {name for name in members if not name.startswith("_")} - of_robots
    assert public
    assert public <= NAMED


@pytest.mark.wire
def test_what_the_page_shows_passes(tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", HOW_TO, re.DOTALL)
    for number, block in enumerate(blocks):
        (tmp_path / f"test_{number}.py").write_text(block, "utf-8")
    few = "not TestOurDriver or at_rest_holds"  # all of them take minutes
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "pytest", "--strict-markers", "-k", few],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert "5 passed" in done.stdout, done.stdout
