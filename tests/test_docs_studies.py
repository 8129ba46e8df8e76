"""The how-to about studies: its example is a study, and works."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from report_runs import dwell_plan, write_run
from study_parts import register

import hil

PAGE = (Path(__file__).parents[1] / "docs" / "how-to" / "add-a-study.md").read_text("utf-8")


def test_the_example_is_a_study_that_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "drift_example.py").write_text(code, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    register(monkeypatch, drift="drift_example:Drift")
    run = write_run(tmp_path / "runs", dwell_plan(poses=5)).path
    (result,) = hil.study(run, "drift", parameters={"least_dwells": 5})
    assert result.summary == ("10 dwells were compared.",)
    assert len(result.parts[0].figures[0].panels) == 6
