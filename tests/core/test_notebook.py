"""What results show in a notebook: escaped, in the report's colours, and short as plain text."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import hil
from hil.core import notebook
from hil.core.errors import DataError
from hil.data.dataset import Conditions, Dataset
from hil.evaluation.evaluation import Errors, Evaluation
from hil.evaluation.fitting import FitReport, Fitted
from hil.evaluation.validation import Validation
from hil.models.model_registry import Registry
from hil.models.promotion import Comparison
from hil.models.version import ModelVersion
from hil.studies.result import StudyResult, Table
from hil.workflow.running import RunReport
from tests.support.paths import EXPERIMENTS, ROOT

NASTY = "<script>alert('1')</script>&"
STYLE_SHEET = (ROOT / "hil" / "report" / "report.css").read_text("utf-8")


class Reader(HTMLParser):
    """Refuses tags that are not closed, and collects those seen and the text outside styles."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.seen.add(tag)
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += "" if "style" in self.open else data


def read(html: str) -> Reader:
    reader = Reader()
    reader.feed(html)
    reader.close()
    assert reader.open == []
    assert "script" not in reader.seen
    return reader


def errors() -> Errors:
    two = np.array([0.123456, np.nan])
    return Errors("all", NASTY, 1000, two, two, two, two, two, two)


def comparison(difference: float) -> Comparison:
    ends = (difference - 0.1, difference + 0.1)
    pair = np.array([1.0, 2.0])
    return Comparison(
        "A", (NASTY, "J2"), (NASTY,), 500, 9, pair, pair * (1 + difference), difference, ends,
        np.array([False, False]),
    )  # fmt: skip


def dataset() -> Dataset:
    series = tuple(Conditions(f"{NASTY}{i}", "dwell") for i in range(20))
    rows = np.zeros((40, 2))
    columns = {"t": np.arange(40.0), "q": rows, "effort": rows}
    return Dataset(NASTY, ("J1", "J2"), "current", columns, np.arange(0, 41, 2), series)


def version() -> ModelVersion:
    facts = {"estimator": NASTY, "robot": "ur5"}
    return ModelVersion(NASTY, 3, Path("v3"), "f" * 64, "2026-11-22T20:00:00", NASTY, facts, {})


EVALUATION = Evaluation("A", (NASTY, "J2"), errors())
SHOWN: dict[str, Any] = {
    "run": RunReport(
        Path("runs") / "1", "u", "failed", "not judged", 0, 0, 0, (), None, DataError(NASTY)
    ),
    "dataset": dataset(),
    "evaluation": EVALUATION,
    "validation": Validation(NASTY, EVALUATION, (NASTY,)),
    "version": version(),
    "better": comparison(-0.5),
    "unsure": comparison(-0.05),
    "worse": comparison(0.5),
    "table": Table("t", NASTY, (NASTY, "b"), ((NASTY, 1.23456),), NASTY, 2),
    "study": StudyResult("s", NASTY, (NASTY,), ()),
}


@pytest.mark.parametrize("name", SHOWN)
def test_every_result_is_a_whole_escaped_card(name: str) -> None:
    shown = read(SHOWN[name]._repr_html_())
    assert NASTY in shown.text or name == "better"
    assert len(repr(SHOWN[name])) < 300


def test_what_a_card_says_is_what_was_found() -> None:
    assert "✓ better" in read(comparison(-0.5)._repr_html_()).text
    assert "✗ worse" in read(comparison(0.5)._repr_html_()).text
    assert "! not significantly better" in read(comparison(-0.05)._repr_html_()).text
    assert "… and 8 more" in read(dataset()._repr_html_()).text
    assert "0.123" in read(EVALUATION._repr_html_()).text
    assert "1.23" in read(SHOWN["table"]._repr_html_()).text


@pytest.mark.thorough
def test_experiment_and_plan_with_its_picture() -> None:
    experiment = hil.load(EXPERIMENTS / "ci_fourier_2.yaml")
    assert repr(experiment).startswith("<Experiment ci-fourier-2 on ur5")
    assert "built-in mock bench" in read(experiment._repr_html_()).text
    plan = hil.plan(experiment)
    assert repr(plan).startswith("<Plan ci-fourier-2 for ur5: ")
    assert len(repr(plan)) < 120
    shown = read(plan._repr_html_())
    assert "img" in shown.seen
    assert plan.hash[:12] in shown.text


def test_a_folder_of_models_is_called_like_the_other_functions(tmp_path: Path) -> None:
    home = hil.registry(tmp_path / "none")
    assert isinstance(home, Registry)
    assert repr(home) == f"<Registry {tmp_path / 'none'}: no models>"
    assert "no models yet" in read(home._repr_html_()).text
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_colours_are_those_of_the_report(theme: str) -> None:
    light, dark = STYLE_SHEET.split("@media (prefers-color-scheme: dark)")
    text = light if theme == "light" else dark.split("* {")[0]
    report = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", text))
    ours = notebook.LIGHT if theme == "light" else notebook.DARK
    assert ours == {name: report[name] for name in ours}


def test_a_fit_has_a_row_per_held_out_source() -> None:
    model = SimpleNamespace(estimator=NASTY, effort_kind_="current", joint_names_=(NASTY, "J2"))
    fitted = Fitted(cast("Any", model), Path("models") / "m", 0.5, np.ones(2))
    report = FitReport(fitted, (Validation(NASTY, EVALUATION, (NASTY,)),) * 3)
    shown = read(report._repr_html_())
    assert shown.text.count("0.123") == 6  # of one joint, and the mean over those known
    assert repr(report) == f"<FitReport {Path('models') / 'm'}: 0.5 s, 3 held-out sources>"
