"""Weeks of a schedule on the mock at once, and what they show."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import SpecError
from hil.maintenance.ledger import Ledger, Occasion
from hil.maintenance.simulation import STAGES, conditions, noise_day
from hil.models.model_registry import Registry
from hil.report.simulation_page import found, simulation_page
from hil.spec.schedule import ScheduleSpec, load_schedule_spec
from tests.support.pipeline_parts import SCHEDULE, write_schedule
from tests.support.plans_once import share_plans

# Weeks of a schedule on the mock at once: the real loop and work, another clock and weather


BEGIN = datetime(2026, 11, 28, 3, tzinfo=UTC)
TINY = SCHEDULE | {
    "start": "2026-11-28T03:00",
    "station": "station.yaml",
    "simulate": {"room_c": [20, 22], "wear": [{"after": "8d", "factors": [1, 1.6, 1, 1, 1, 1]}]},
}
MOCK: dict[str, Any] = {"driver": "mock", "model": "ur5"}
OWN = MOCK | {"options": {"seed": 5, "profile": "ideal"}}


@dataclass(frozen=True)
class Lived:
    spec: ScheduleSpec
    folder: Path
    told: dict


def written(folder: Path, robot: Any = OWN, **simulated: Any) -> Path:
    station = {"hil_station": 1, "name": "bench", "robots": {"ur5": robot}}
    schedule = TINY | {"simulate": TINY["simulate"] | simulated}
    path = write_schedule(folder, schedule=schedule)
    (folder / "station.yaml").write_text(json.dumps(station), "utf-8")
    return path


@pytest.fixture(scope="module")
def lived(tmp_path_factory: pytest.TempPathFactory) -> Lived:
    """A first champion, a quiet week, and one in which a joint has nearly twice the friction."""
    folder = tmp_path_factory.mktemp("simulation")
    path = written(folder)
    with pytest.MonkeyPatch.context() as patch:
        share_plans(patch)  # each week has the same ones
        done = CliRunner().invoke(
            app, ["schedule", "simulate", str(path), "2w", "--runs", str(folder / "runs"), "--json"]
        )
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    return Lived(load_schedule_spec(path), Path(told["folder"]), told)


@pytest.mark.thorough
def test_what_changes_is_seen_and_the_robot_identified_again(lived: Lived) -> None:
    assert [each["week"] for each in lived.told["occasions"]] == [0.0, 1.0, 2.0]
    results = [each["result"] for each in lived.told["occasions"]]
    assert [each["outcome"] for each in results] == ["promoted", "quiet", "promoted"]
    assert "friction up on shoulder_lift_joint" in results[2]["drift"]["text"]
    after, before = (results[2]["errors"][key][1] for key in ("after", "before"))
    assert after < 0.5 * before
    assert Registry(lived.folder / "registry").aliases("ur5").champion == 2


@pytest.mark.thorough
def test_everything_is_in_one_folder_and_the_clock_is_that_of_the_weeks(lived: Lived) -> None:
    names = sorted(path.name for path in lived.folder.iterdir())
    assert names == ["registry", "report.html", "runs", "simulation.json", "state"]
    kept = json.loads((lived.folder / "simulation.json").read_text("utf-8"))
    assert lived.told == kept | {key: lived.told[key] for key in ("folder", "report")}
    assert Path(lived.told["report"]).is_file()
    lines = Ledger.read(lived.folder / "state").lines
    done = [datetime.fromisoformat(line["at"]) for line in lines if line["event"] == "done"]
    assert [moment.date() for moment in done] == [
        (BEGIN + timedelta(weeks=week)).date() for week in range(3)
    ]
    took = [moment - (BEGIN + timedelta(weeks=week)) for week, moment in enumerate(done)]
    assert timedelta(seconds=20) < took[1] < took[0] < took[2] < timedelta(minutes=5)


@pytest.mark.thorough
def test_every_run_has_the_weather_of_its_occasion_and_noise_of_its_own(lived: Lived) -> None:
    stations = [
        json.loads((run / "station.yaml").read_text("utf-8").partition("\n")[2])
        for run in sorted((lived.folder / "runs").glob("*/ur5/*"))
    ]
    options = [station["robots"]["ur5"]["options"] for station in stations]
    rooms = [each["room_c"] for each in lived.told["occasions"]]
    assert [each["room_c"] for each in options] == [rooms[0], rooms[1], *[rooms[2]] * 3]
    assert len({each["day"] for each in options}) == len(options) == 5
    assert [each.get("wear") for each in options[:2]] == [None, None]
    assert [each["wear"][1] for each in options[2:]] == [1.6, 1.6, 1.6]
    assert ["temperature_c" in each for each in options] == [False] * 4 + [True], "still warm"


@pytest.mark.thorough
def test_conditions_are_drawn_for_the_occasion_and_not_in_passing(lived: Lived) -> None:
    weeks = [Occasion(BEGIN + timedelta(weeks=week), "probe") for week in (2, 0, 1)]
    met = {each: conditions(lived.spec, BEGIN, each) for each in weeks}
    assert met[weeks[0]] == conditions(lived.spec, BEGIN, weeks[0])
    assert len({each.room_c for each in met.values()}) == 3
    assert all(20 <= each.room_c <= 22 for each in met.values())
    assert [met[each].wear for each in weeks[1:]] == [(), ()]


@pytest.mark.thorough
def test_two_occasions_of_a_day_have_noise_of_their_own(lived: Lived) -> None:
    due = [Occasion(BEGIN + timedelta(hours=hours), "campaign") for hours in (0, 12)]
    days = [noise_day(lived.spec, BEGIN, each, stage) for each in due for stage in STAGES]
    assert len(set(days)) == len(days) == 6
    assert noise_day(lived.spec, BEGIN, due[1], "campaign") == days[4]


@pytest.mark.thorough
@pytest.mark.parametrize(("days", "wear"), [(7, ()), (8, (1.0, 1.6, 1.0, 1.0, 1.0, 1.0))])
def test_wear_holds_from_its_moment_on(lived: Lived, days: int, wear: tuple[float, ...]) -> None:
    at = Occasion(BEGIN + timedelta(days=days), "probe")
    assert conditions(lived.spec, BEGIN, at).wear == wear


@pytest.mark.thorough
def test_an_arm_that_does_not_warm_up_has_no_friction_by_warmth(lived: Lived) -> None:
    warmth = lived.told["warmth"]
    assert warmth["all"]["friction_change"] == pytest.approx([0.0] * 6, abs=1e-12)
    assert warmth["all"]["from_c"] != warmth["all"]["to_c"], "the room is another every week"


@pytest.mark.thorough
def test_the_page_shows_the_weeks(lived: Lived) -> None:
    page = simulation_page(lived.folder)
    criteria = page.sections[0].blocks[0]
    assert criteria.kind == "table"
    # Such a joint errs more whatever the model: what friction does that it does not know grows too.
    assert [row[1].text for row in criteria.rows] == ["yes"] * 6
    assert page.badge.text == "all 6 criteria met"
    assert "Week 2: friction up on shoulder_lift_joint" in page.summary
    assert "v2 is promoted" in page.summary
    weeks = next(section for section in page.sections if section.id == "weeks")
    error, table = weeks.blocks
    assert table.kind == "table"
    assert error.kind == "figure"
    assert [row[0].text for row in table.rows] == ["0", "1", "2"]
    assert [row[5].text for row in table.rows] == ["as new", "as new", "J2\u00a0×\u00a01.6"]
    assert error.panels[0].curves[1].x == (1.0, 2.0, 2.0), "before and after"
    champions = page.sections[-1].blocks[0]
    assert champions.kind == "table"
    promoted = [row[0].text for row in champions.rows if row[2].text == "promoted to champion"]
    assert promoted == ["week 0", "week 2"]


@pytest.mark.parametrize(
    ("robot", "simulated", "said"),
    [
        (
            MOCK | {"options": {"clock": "wall"}},
            {},
            "the driver mock in wall time: only the embedded",
        ),
        (MOCK | {"driver": "ur", "options": {"host": "192.0.2.1"}}, {}, "has the driver ur: only"),
        (OWN, {"wear": [{"after": "8d", "factors": [1, 3]}]}, "mock option wear is"),
        (OWN, {"room_c": [20, 2000]}, "mock option room_c is 2000"),
    ],
)
def test_what_cannot_be_simulated_is_refused_before_anything_is_made(
    tmp_path: Path, robot: Any, simulated: dict[str, Any], said: str
) -> None:
    assert said in refused(tmp_path, written(tmp_path, robot, **simulated), "2w")
    assert not (tmp_path / "runs").exists()


def test_a_duration_that_is_none_is_refused(tmp_path: Path) -> None:
    said = refused(tmp_path, written(tmp_path), "often")
    assert "DURATION must be a duration such as 7d" in said


def test_an_experiment_has_no_weeks(tmp_path: Path) -> None:
    written(tmp_path)
    said = refused(tmp_path, tmp_path / "probe.yaml", "2w")
    assert "this file is an experiment, but a schedule is needed here" in said


def refused(folder: Path, path: Path, lasting: str) -> str:
    """What `hil schedule simulate` says of it."""
    command = ["schedule", "simulate", str(path), lasting, "--runs", str(folder / "runs")]
    done = CliRunner().invoke(app, command)
    assert isinstance(done.exception, SpecError), done.output
    return str(done.exception)


# What the weeks of a simulation show: each thing that is not as it should be is told


JOINTS = ["a", "b"]


def occasion(
    week: int, outcome: str = "quiet", *, changed: bool = False, before: Any = (1.0, 2.0),
    after: Any = None, champion: str = "v1", was: str | None = "v1",
) -> dict[str, Any]:  # fmt: skip
    errors = {"joint_names": JOINTS, "before": list(before), "after": list(after or before)}
    drift = {"changed": changed, "text": "friction up on b" if changed else "nothing has changed"}
    result = {
        "outcome": outcome, "text": outcome, "champion": champion, "before": was,
        "errors": errors if was else None, "drift": drift if was else None,
    }  # fmt: skip
    return {"week": float(week), "event": "done", "why": "", "result": result}


FIRST = occasion(0, "promoted", was=None)
SEEN = occasion(3, "promoted", changed=True, before=(1.0, 4.0), after=(1.0, 2.1), champion="v2")
GOOD = [FIRST, occasion(1), occasion(2), SEEN, occasion(4, champion="v2", was="v2")]


def told(occasions: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "wear_weeks": [2.5],
        "simulate": {"wear": [{"factors": [1, 1.15]}]},
        "occasions": occasions,
    }


def missed(*occasions: dict[str, Any]) -> list[str]:
    """Criteria that are missed when some weeks are others."""
    weeks = {each["week"]: each for each in (*GOOD, *occasions)}
    criteria = found(told([weeks[week] for week in sorted(weeks)])).criteria
    return [one.asked for one in criteria if not one.met]


def test_when_all_is_as_it_should_be_it_is_said() -> None:
    what = found(told(GOOD))
    assert all(one.met for one in what.criteria)
    assert what.promoted == (0.0, 3.0)
    assert what.weeks == (1.0, 2.0, 3.0, 3.0, 4.0)
    assert np.array_equal(what.level, [1.0, 2.0])
    assert what.after.tolist() == pytest.approx([1.0, (1.05 + 1.0) / 2])
    assert what.sentences == (
        "4 probes; after 17.5 days friction is 1.15 times as much on J2.",
        "Week 3: friction up on b; v2 is promoted.",
        "After the promotion, the mean error is 101 % of that on the first probe, for J2 102 %.",
    )


def test_wear_after_the_end_is_not_called_a_change() -> None:
    what = found({**told(GOOD[:3]), "weeks": 2.0})
    said = "2 probes; the wear on day 17.5 is after these 2 weeks and not shown."
    assert what.sentences[0] == said


def test_a_change_that_is_seen_later_was_not_seen_by_the_first_probe_after_it() -> None:
    late = occasion(4, "promoted", changed=True, champion="v2")
    asked = missed(occasion(3), late)
    assert asked[0].startswith("the first probe after the change on day 17.5 detects the change")
    assert asked[1].startswith("the robot is re-identified")
    assert "no challenger is promoted without a change" in asked


def test_a_challenger_that_is_kept_out_leaves_the_error() -> None:
    kept = occasion(3, "kept", changed=True, before=(1.0, 4.0))
    assert missed(kept) == [
        "the robot is re-identified and the challenger promoted",
        "the error exceeds that of the first probe by at most 10 %",
        "the error of J2 is at most 126.5 % of its error on the first probe (wear + 10 %)",
    ]


def test_a_promotion_and_an_alarm_without_a_change_are_told() -> None:
    assert missed(occasion(2, "promoted", changed=True)) == [
        "no challenger is promoted without a change",
        "no probe without a change reports a change",
    ]


def test_an_error_that_stays_is_told() -> None:
    worse = occasion(4, champion="v2", was="v2", before=(1.4, 2.0))
    assert missed(worse) == ["the error exceeds that of the first probe by at most 10 %"]


def test_the_joint_that_wore_is_not_lost_in_the_mean() -> None:
    worse = [
        {**week, "result": week["result"] | {"errors": errors}}
        for week, errors in (
            (SEEN, {"joint_names": JOINTS, "before": [0.6, 4.0], "after": [0.6, 2.6]}),
            (GOOD[4], {"joint_names": JOINTS, "before": [0.6, 2.6], "after": [0.6, 2.6]}),
        )
    ]
    assert missed(*worse) == [
        "the error of J2 is at most 126.5 % of its error on the first probe (wear + 10 %)"
    ]


def test_without_probes_there_are_no_errors_to_compare() -> None:
    weeks = [FIRST, {**SEEN, "result": SEEN["result"] | {"errors": None, "drift": None}}]
    what = found({**told(weeks), "wear_weeks": [], "simulate": {"wear": []}})
    assert what.weeks == ()
    assert what.after.size == 0
    assert what.sentences == ("0 probes; no wear.",)


def test_occasions_that_failed_have_no_numbers() -> None:
    failed = {"week": 3.0, "event": "failed", "why": "the robot is gone", "result": None}
    what = found(told([*GOOD[:3], failed]))
    assert [one.found for one in what.criteria[:2]] == [
        "week 3: the robot is gone",
        "the robot is gone",
    ]
    assert what.share_of(failed) == "–"
    assert what.share_of(GOOD[1]) == "100"
