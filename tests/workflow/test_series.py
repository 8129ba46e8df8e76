"""A series of runs: one after the other, stopped and gone on with, and its overview."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.cli.series import resume_series
from hil.core.errors import DataError, FitError, HilError, InterlockTripped, Rejected, Stopped
from hil.planning.commissioning import Commissioning
from hil.planning.experiment import Experiment
from hil.recording.run_group import SeriesGroup
from hil.report.series_page import side_by_side
from hil.studies.result import Part, StudyResult, Table
from hil.studies.store import write_study
from hil.workflow.series import Series, load_series, run_series

SPEC = """
hil: 1
name: {name}
robot: ur5
excitation: {{kind: fourier, trajectories: 1, fundamental_hz: 0.5, seed: 3}}
warm_up: {{duration_s: 0}}
reference: {{every: 0}}
"""
NAMES = ("first", "second", "third")


def written(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        (folder / f"{name}.yaml").write_text(SPEC.format(name=name), "utf-8")
    path = folder / "series.yaml"
    entries = ", ".join(f"{{spec: {name}.yaml}}" for name in names)
    path.write_text(f"hil_series: 1\nname: Three.of-Them\nseries: [{entries}]\n", "utf-8")
    return path


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    return written(tmp_path, NAMES[:2])


@pytest.fixture
def series(tmp_path: Path) -> Series:
    return load_series(written(tmp_path, NAMES))


@pytest.fixture
def folder(series: Series, tmp_path: Path) -> SeriesGroup:
    return series.create_group(tmp_path / "runs")


class Robot:
    """Runs every experiment with the outcome it is told, and notes what it was asked."""

    def __init__(self, **outcomes: Any) -> None:
        self.outcomes = outcomes
        self.asked: list[tuple[str, dict[str, Any]]] = []

    def __call__(
        self, experiment: Experiment, before: dict[str, Any]
    ) -> tuple[dict[str, Any], HilError | None]:
        name = experiment.spec.name
        self.asked.append((name, before))
        error = self.outcomes.get(name)
        if isinstance(error, KeyboardInterrupt):
            raise error
        moved = error is None or isinstance(error, Rejected | FitError)
        verdict = "rejected" if isinstance(error, Rejected) else "passed"
        return {"outcome": "completed" if moved else "tripped", "verdict": verdict}, error

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.asked]


def test_experiments_are_run_in_order(series: Series, folder: SeriesGroup) -> None:
    robot = Robot()
    report = run_series(series, folder, robot)
    assert robot.names == list(NAMES)
    assert (report.error, report.left) == (None, ())


@pytest.mark.parametrize("error", [Rejected("missed"), FitError("too few")])
def test_a_bad_model_does_not_keep_the_next_robot_from_moving(
    series: Series, folder: SeriesGroup, error: HilError
) -> None:
    report = run_series(series, folder, Robot(first=error))
    assert len(report.members) == 3
    assert report.error is error


@pytest.mark.parametrize(
    "error", [InterlockTripped("too fast"), Stopped("stopped", by_signal=True)]
)
def test_a_run_that_ends_early_ends_the_series(
    series: Series, folder: SeriesGroup, error: HilError
) -> None:
    report = run_series(series, folder, Robot(second=error))
    assert [each.experiment for each in report.members] == ["first", "second"]
    assert report.left == ("third",)
    assert report.error is error


def test_the_worst_is_what_ended_the_series_then_a_fit_then_a_rejection(
    series: Series, tmp_path: Path
) -> None:
    first, second = (series.create_group(tmp_path) for _ in range(2))
    outcomes = {"first": Rejected("missed"), "second": FitError("few")}
    assert isinstance(run_series(series, first, Robot(**outcomes)).error, FitError)
    outcomes["third"] = InterlockTripped("hot")
    report = run_series(series, second, Robot(**outcomes))
    assert (type(report.error), report.to_dict()["exit_code"]) == (InterlockTripped, 5)


def test_ctrl_c_between_two_runs_keeps_what_there_is(series: Series, folder: SeriesGroup) -> None:
    report = run_series(series, folder, Robot(second=KeyboardInterrupt()))
    assert report.to_dict()["exit_code"] == 130
    kept = SeriesGroup.open(folder.path).members()
    assert [member.report.get("outcome") for member in kept] == ["completed", None]


def test_going_on_repeats_nothing_that_was_measured(series: Series, folder: SeriesGroup) -> None:
    run_series(series, folder, Robot(first=Rejected("missed"), second=InterlockTripped("hot")))
    robot = Robot()
    report = run_series(series, SeriesGroup.open(folder.path), robot)
    assert robot.names == ["second", "third"]
    assert robot.asked[0][1]["outcome"] == "tripped"
    assert isinstance(report.error, Rejected)


def test_a_run_that_was_stopped_during_its_studies_is_gone_on_with(
    series: Series, folder: SeriesGroup
) -> None:
    def stopped(experiment: Experiment, before: dict[str, Any]) -> Any:
        return {"outcome": "completed"}, Stopped("during the studies", by_signal=True)

    assert len(run_series(series, folder, stopped).members) == 1
    robot = Robot()
    run_series(series, SeriesGroup.open(folder.path), robot)
    assert robot.names == list(NAMES)


def test_a_file_that_names_other_experiments_now_is_refused(
    series: Series, folder: SeriesGroup
) -> None:
    run_series(series, folder, Robot(second=InterlockTripped("hot")))
    first, second = folder.members()
    folder.write([replace(first, experiment="another"), second])
    with pytest.raises(DataError, match="another, second were run"):
        run_series(series, SeriesGroup.open(folder.path), Robot())


def test_folders_of_a_day_do_not_meet(series: Series, tmp_path: Path) -> None:
    made = [series.create_group(tmp_path) for _ in range(2)]
    assert [each.path.name for each in made] == ["series-three.of-them", "series-three.of-them-2"]


def test_a_series_belongs_to_one_process(series: Series, folder: SeriesGroup) -> None:
    run_series(series, folder, Robot(second=InterlockTripped("hot")))
    with folder.held():
        done = CliRunner().invoke(app, ["resume", str(folder.path)])
    assert isinstance(done.exception, DataError)
    assert "is in use by pid" in str(done.exception)


def test_a_damaged_document_is_told(folder: SeriesGroup) -> None:
    (folder.path / "series.json").write_text('{"hil_series_run": 1, "runs": [3]}', "utf-8")
    with pytest.raises(DataError, match="is not a list of runs"):
        SeriesGroup.open(folder.path)


@pytest.mark.thorough
def test_a_series_on_the_command_line(pair: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    done = CliRunner().invoke(app, ["run", str(pair), "--runs", str(runs), "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert [run["experiment"] for run in told["runs"]] == list(NAMES[:2])
    assert "2 of 2: second on ur5" in done.stderr
    page = Path(told["page"]).read_text("utf-8")
    for link in re.findall(r'<a href="(\.\./[^"]+)"', page):
        assert (Path(told["series"]) / link).is_file()
    again = CliRunner().invoke(app, ["resume", told["series"], "--json"])
    assert json.loads(again.stdout)["runs"] == [
        {**run, "run": str(Path(run["run"])), "report": str(Path(run["report"]))}
        for run in told["runs"]
    ]
    listed = CliRunner().invoke(app, ["runs", "--runs", str(runs), "--json"])
    assert len(json.loads(listed.stdout)) == 2
    assert CliRunner().invoke(app, ["report", told["series"]]).exit_code == 0


def test_what_is_left_of_a_slow_series_is_run_as_slowly(series: Series, tmp_path: Path) -> None:
    slow = Commissioning(speed=0.1)
    folder = series.create_group(tmp_path, part=slow)
    run_series(series, folder, Robot(second=InterlockTripped("hot")))
    asked: list[Commissioning | None] = []

    def begin(experiment: Experiment) -> Any:
        asked.append(experiment.commissioning)
        raise Stopped("enough seen")

    with pytest.raises(Stopped):
        resume_series(
            folder.path,
            begin,
            lambda run: begin(series.experiments[0]),
            False,
            confirm=lambda moves: None,
        )
    assert asked == [slow]


@pytest.mark.thorough
def test_a_series_is_planned_with_the_options_it_is_run_with(pair: Path) -> None:
    durations = []
    for options in ((), ("--speed-scale", "10%")):
        done = CliRunner().invoke(app, ["plan", str(pair), *options, "--json"])
        assert done.exit_code == 0, done.output
        durations.append(json.loads(done.stdout)["duration_s"])
    assert durations[1] > 5 * durations[0]


@pytest.mark.thorough
def test_a_plan_of_a_series_tells_how_long_all_of_it_takes(pair: Path) -> None:
    done = CliRunner().invoke(app, ["plan", str(pair), "--json"])
    told = json.loads(done.stdout)
    assert told["duration_s"] == pytest.approx(sum(run["duration_s"] for run in told["runs"]))
    assert CliRunner().invoke(app, ["validate", str(pair)]).stdout.startswith(f"{pair}: valid (2")


def table(*rows: tuple[Any, ...], columns: tuple[str, ...] = ("method", "J1")) -> Table:
    return Table("t", "RMSE", columns, rows, "A note.")


def test_tables_of_the_runs_stand_side_by_side() -> None:
    (joined,) = side_by_side(
        [("one", table(("a", 1.0), ("a", 2.0))), ("two", table(("a", 3.0), ("b", 4.0)))]
    )
    assert joined.groups == [("", 1), ("one", 1), ("two", 1)]
    assert [[cell.text for cell in row] for row in joined.rows] == [
        ["a", "1.00", "3.00"],
        ["a", "2.00", "–"],
        ["b", "–", "4.00"],
    ]
    assert joined.note == "A note."


def test_tables_with_other_columns_stand_below_one_another() -> None:
    other = table(("a", 1.0, 2.0), columns=("method", "J1", "J2"))
    assert len(side_by_side([("one", table(("a", 1.0))), ("two", other)])) == 2


def test_the_overview_has_the_tables_of_the_studies(series: Series, folder: SeriesGroup) -> None:
    run = folder.path.parent / "0001-first"
    part = Part("Held out", "honest", (), (table(("ours", 0.5)),))
    write_study(StudyResult("compared", "Compared", (), (part,), {}), run / "study" / "compared-0")

    def measured(experiment: Experiment, before: dict[str, Any]) -> Any:
        return {"run": str(run), "outcome": "completed", "verdict": "passed"}, None

    page = (run_series(series, folder, measured).page or Path()).read_text("utf-8")
    assert "Held out (honest protocol)" in page
    assert page.count('<td class="number ">0.500</td>') == 3


def finished(folder: SeriesGroup, series: Series) -> str:
    run_series(series, folder, Robot(first=Rejected("missed")))
    return str(folder.path)


def test_of_a_finished_series_nothing_is_left_to_do(series: Series, folder: SeriesGroup) -> None:
    done = CliRunner().invoke(app, ["resume", finished(folder, series)])
    assert done.exit_code == 0, done.output
    (line,) = done.stdout.splitlines()
    page = folder.path / "series.html"
    assert line == f"Three.of-Them is complete; overview: {page}"
    told = CliRunner().invoke(app, ["resume", str(folder.path), "--json"])
    assert (told.exit_code, json.loads(told.stdout)["exit_code"]) == (0, 0)


def test_the_overview_has_the_errors_of_the_models_and_the_time_as_runs_have_it(
    series: Series, folder: SeriesGroup
) -> None:
    run = folder.path.parent / "0001-first"
    model = run / "fit" / "rigid-wls-0"
    model.mkdir(parents=True)
    (model / "model.json").write_text("{}", "utf-8")
    total = {"mean_raw": 0.01234, "mean_filtered": 0.0042}
    held_out = {"unit": "A", "joint_names": ["j"], "total": total}
    (model / "evaluation.json").write_text(json.dumps({"held_out": held_out}), "utf-8")

    def measured(experiment: Experiment, before: dict[str, Any]) -> Any:
        return {"run": str(run), "outcome": "completed", "verdict": "passed"}, None

    began = {**folder.head, "started": "2026-11-22T12:08:13+01:00"}
    at_one = SeriesGroup(folder.path, began)
    page = (run_series(series, at_one, measured).page or Path()).read_text("utf-8")
    for text in ("rigid-wls", "0.0123", "0.00420"):
        assert page.count(f">{text}</td>") == 3
    assert "started 22 Nov 2026, 11:08 UTC" in page
    assert "from the studies" not in page
