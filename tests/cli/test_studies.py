"""`hil study` and `hil figures`: what a person sees, on a terminal and in a pipe."""

from __future__ import annotations

import io
import json
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.cli.output import table_lines
from hil.cli.progress import ProgressLines, StudyLine
from hil.core.errors import FitError, Stopped
from hil.studies.figure import Curve, Figure, Grid, Panel
from hil.studies.store import problem_files
from tests.support.report_runs import dwell_plan, write_run
from tests.support.study_parts import register


def wide(columns: int | None) -> list[str]:
    """A table of three methods and twelve joints on a terminal of so many columns."""
    joints = range(1, 13)
    rows = [(f"method {i}", *(f"{0.1 * j + i:.2f}" for j in joints)) for i in range(3)]
    header = ("method", *(f"J{j} [A]" for j in joints))
    return table_lines(header, rows, right=joints, width=columns)


@pytest.fixture(autouse=True)
def _studies(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = write_run(tmp_path, dwell_plan(poses=2)).path
    with (path / "spec.yaml").open("a", encoding="utf-8") as spec:
        spec.write("study: [{study: counted}]\n")
    return path


class Terminal(io.StringIO):
    """Standard error that is a terminal."""

    def isatty(self) -> bool:
        return True


def test_sentences_and_tables_are_printed_and_the_page_is_written(run: Path) -> None:
    done = CliRunner().invoke(app, ["study", str(run)])
    assert done.exit_code == 0, done.output
    assert "ur5 has" in done.stdout
    assert re.search(r"^kind +series  share$", done.stdout, re.MULTILINE)
    assert re.search(r"^dwell +4 +–$", done.stdout, re.MULTILINE)
    assert "Counts again (paper protocol): Series by kind" in done.stdout
    assert f"report: {run / 'report.html'}" in done.stdout
    assert "counted: counting 1/3" in done.stderr
    assert "fit 3 of 3: a round (0.5 s)" in done.stderr


def test_json_is_one_document_without_nan(run: Path) -> None:
    done = CliRunner().invoke(app, ["study", str(run), "--json", "--set", "rounds=5"])
    document = json.loads(done.stdout, parse_constant=lambda name: pytest.fail(name))
    (study,) = document["studies"]
    assert study["parameters"]["rounds"] == 5
    assert Path(study["folder"], "study.json").is_file()


def test_json_has_figures_of_arrays_as_study_json_has_them(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = Grid(np.array([0.0, 1.0]), np.array([2.0, 3.0]), np.array([[math.nan, 0.5], [1.0, 2.0]]))
    curve = Curve("measured", np.arange(3.0), np.array([1.0, math.nan, 2.0]))
    panels = (Panel("J1", "t [s]", "i [A]", (curve,)), Panel("J2", "q", "i", (), grid=grid))
    monkeypatch.setattr(
        "tests.support.study_parts.six_panels", lambda: Figure("fig-7", "All", "", panels)
    )
    done = CliRunner().invoke(app, ["study", str(run), "--json"])
    assert done.exit_code == 0, done.exception
    (study,) = json.loads(done.stdout)["studies"]
    stored = json.loads(Path(study["folder"], "study.json").read_bytes())
    assert study["parts"] == stored["parts"]


def test_a_study_that_fails_is_an_exit_code_and_one_error(run: Path) -> None:
    done = CliRunner().invoke(app, ["study", str(run), "--set", "ending=fails"])
    assert isinstance(done.exception, FitError)
    assert done.exception.hint == "record more poses"
    assert "report:" not in done.stdout


@pytest.mark.thorough
def test_a_trial_that_fails_leaves_no_mark_on_the_run(run: Path) -> None:
    CliRunner().invoke(app, ["study", str(run)])
    CliRunner().invoke(app, ["study", str(run), "--set", "ending=fails"])
    assert "The study counted failed" not in (run / "report.html").read_text("utf-8")
    assert problem_files(run) == []


def test_ctrl_c_says_how_to_go_on(run: Path) -> None:
    done = CliRunner().invoke(app, ["study", str(run), "--set", "ending=ctrl-c"])
    assert isinstance(done.exception, Stopped)
    assert (done.exception.by_signal, done.exception.hint) == (True, f"hil study {run}")


@pytest.mark.thorough
def test_figures_are_listed_as_they_were_written(run: Path, tmp_path: Path) -> None:
    CliRunner().invoke(app, ["study", str(run)])
    out = tmp_path / "paper"
    done = CliRunner().invoke(app, ["figures", str(run), "--out", str(out), "--format", "svg"])
    assert done.exit_code == 0, done.output
    assert {Path(line) for line in done.stdout.split()} == set(out.iterdir())
    assert out / "table-1-honest.csv" in out.iterdir()


def test_a_wide_table_is_broken_between_columns_on_a_narrow_terminal() -> None:
    lines = wide(40)
    assert max(map(len, lines)) <= 40
    assert sum(line.startswith("method ") and "J" in line for line in lines) > 1
    values = re.findall(r"\d\.\d+", " ".join(lines))
    assert len(values) == 36


def test_in_a_pipe_nothing_is_broken() -> None:
    assert len(wide(None)) == 4


def test_numbers_stand_below_each_other_at_their_right_ends() -> None:
    header, *rows = wide(None)
    assert {len(line) for line in rows} == {len(header)}


def test_a_terminal_shows_a_line_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("TERM", "xterm")
    lines = ProgressLines()
    event = {"kind": "study", "study": "counted", "what": "layouts [4, 1]", "done": 3, "total": 8}
    lines.notify(event)
    lines.notify({"kind": "study", "study": ""})
    lines.notify({"kind": "stage", "stage": "writing the report"})
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    assert "counted: layouts [4, 1]" in text
    assert "3/8" in text
    assert text.endswith("writing the report …\n")
    assert "\x1b[?25l" not in terminal.getvalue(), "whoever is killed leaves no hidden cursor"


ENDED = {"number": 7, "total": 54, "name": "lagrangian (proposed), seed 2", "seconds": 63.0}
LINE = "fit 7 of 54: lagrangian (proposed), seed 2 (1 min 03 s)"


def test_every_fit_of_a_study_leaves_a_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    event = {"kind": "study_fit", "study": "counted", "ended": ENDED}
    ProgressLines().notify(event)
    assert capsys.readouterr().err == f"{LINE}\n"
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    lines = ProgressLines()
    lines.notify({"kind": "study", "study": "counted", "what": "fits", "done": 6, "total": 54})
    lines.notify(event)
    lines.notify({"kind": "study", "study": ""})
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    assert f"{LINE}\n" in text.replace("\r", "")
    assert terminal.getvalue().count("6/54  counted: fits") == 2, "nothing shows that work goes on"


@pytest.mark.parametrize("failed", ["failed", "without rc-motion, which failed"])
def test_a_fit_that_failed_is_no_success(capsys: pytest.CaptureFixture[str], failed: str) -> None:
    ended = {**ENDED, "failed": failed}
    ProgressLines().notify({"kind": "study_fit", "study": "counted", "ended": ended})
    told = f"fit 7 of 54: lagrangian (proposed), seed 2 {failed} (1 min 03 s)\n"
    assert capsys.readouterr().err == told


def test_in_a_pipe_lines_come_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    bar = StudyLine()
    for done in range(1000):
        bar.show("counted", "fitting", done, 1000)
    assert capsys.readouterr().err.splitlines() == ["counted: fitting 0/1000"]
