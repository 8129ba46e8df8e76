"""The page about the Python API: its script runs, its signatures are those of the code."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hil
from hil import api
from hil.campaign.run import RunReport
from hil.fitting import FitReport, Fitted

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "reference" / "api.md").read_text("utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
FUNCTIONS = [name for name in hil.__all__ if inspect.isfunction(getattr(api, name))]


def signature(name: str) -> str:
    """As the page shows it: names and defaults, without types."""
    given = inspect.signature(getattr(api, name))
    bare = [p.replace(annotation=p.empty) for p in given.parameters.values()]
    return f"hil.{name}{inspect.Signature(bare)}"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_signatures_are_those_of_the_code(name: str) -> None:
    assert signature(name) in [block.strip() for block in BLOCKS]


@pytest.mark.parametrize("report", [RunReport, FitReport], ids=lambda kind: kind.__name__)
def test_every_attribute_of_a_report_has_a_row(report: type) -> None:
    section = PAGE.split(f"\n### `{report.__name__}`")[1].split("\n#")[0]
    rows = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    assert rows == [field.name for field in dataclasses.fields(report)]


def test_everything_about_a_fitted_model_is_mentioned() -> None:
    for field in dataclasses.fields(Fitted):
        assert f"`fitted.{field.name}`" in PAGE


def test_the_script_runs_as_it_stands_there(tmp_path: Path) -> None:
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", BLOCKS[0]],
        cwd=tmp_path,
        env={**os.environ, "HIL_STATION": ""},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()
    assert told[1].startswith("completed passed")
    assert "24 dwells, (240, 6) [A]" in told
    assert len(list((tmp_path / "models").glob("static-wls-*/model.json"))) == 1
