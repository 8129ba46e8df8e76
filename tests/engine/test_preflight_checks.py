"""Preflight: all results at once, each check fails for its own reason, waivers by name."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core import plugins
from hil.core.errors import CommandRefused, PreflightFailed, RobotConnectionError, SpecError
from hil.core.typing import FloatArray, StructArray
from hil.engine.preflight import (
    BUILT_IN,
    NEVER_WAIVED,
    CheckResult,
    Context,
    Situation,
    preflight,
    preflight_context,
    require_preflight,
)
from hil.excitation.motion import Hold, Line
from hil.planning.plan import LoadStep, Plan, Step
from hil.robot import Capabilities, Finding, HasChecks, Identity, Limits, Status
from tests.support.kinematic_robot import KinematicRobot
from tests.support.paths import ROOT
from tests.support.plan_parts import JointSpace, always_clear, ur5

NAMES = tuple(f"j{i + 1}" for i in range(6))
NOW = 1.9e9
FACTS = ("rate_hz", "joint_names", "clock", "effort_kind")


class ScriptedRobot(KinematicRobot):
    """A kinematic robot whose facts can be replaced one by one."""

    def __init__(self, **facts: Any) -> None:
        super().__init__(facts.pop("disturb", lambda block: None))
        self.facts = facts
        self.connect()

    @property
    def identity(self) -> Identity:
        model, driver = (
            self.facts.get(*one) for one in (("model", "kinematic"), ("driver", "test"))
        )
        return Identity(model, "0", "1", driver)

    @property
    def capabilities(self) -> Capabilities:
        changes = {k: v for k, v in self.facts.items() if k in FACTS}
        return replace(super().capabilities, **changes)

    @property
    def limits(self) -> Limits:
        changes = {k: v for k, v in self.facts.items() if k in ("qd_max", "payload_max_kg")}
        return replace(super().limits, **changes)

    def set_payload(self, payload: Payload) -> Payload:
        if self.facts.get("refuses"):
            raise CommandRefused("the controller is in local mode", hint="switch it to remote")
        super().set_payload(payload)
        back: Payload = self.facts.get("reads_back", payload)
        return back


def small_plan(**changes: Any) -> Plan:
    line = Line((0.0,) * 6, (0.3,) * 6, 1.0, 2.0, 20.0, 125.0)
    steps = (Step(0, "payload"), Step(1, "move", line), Step(2, "dwell", Hold(line.goal), pose=0))
    loads = (LoadStep(Payload(2.0, (0.0, 0.0, 0.05))),)
    facts: dict[str, Any] = {
        "name": "small", "robot_model": "ur5", "joint_names": NAMES, "rate_hz": 125.0,
        "steps": steps, "loads": loads,
    }  # fmt: skip
    return Plan(**(facts | changes))


def context(
    tmp_path: Path, distance: Callable[[FloatArray], FloatArray] = always_clear, **changes: Any
) -> Context:
    facts: dict[str, Any] = {
        "folder": tmp_path,
        "collision": lambda plan: JointSpace(distance),
        "clearance_m": 0.02,
        "now": lambda: NOW,
        "free_bytes": lambda folder: 10**9,
    }
    return Context(**(facts | changes))


def field(name: str, value: Any) -> Callable[[StructArray], None]:
    """Overwrites a field of every state row."""

    def disturb(block: StructArray) -> None:
        block[name] = value

    return disturb


def failing(results: list[CheckResult]) -> list[str]:
    return [result.name for result in results if not result.passed]


def test_a_sound_situation_passes_every_check(tmp_path: Path) -> None:
    results = preflight(small_plan(), ScriptedRobot(), context(tmp_path))
    assert [result.name for result in results] == list(BUILT_IN)
    assert failing(results) == []


@pytest.mark.parametrize(
    ("check", "facts", "told"),
    [
        ("pose", {"disturb": field("q", [0, 0, 0.011, 0, 0, 0])}, "j3 is 0.0110 rad"),
        ("pose", {"disturb": field("q", np.nan)}, "nan rad"),
        ("rest", {"disturb": field("qd", 0.1)}, "0.1000 rad/s"),
        ("fault", {"disturb": field("status", Status.FAULT)}, "fault bit set"),
        ("fault", {"disturb": field("fault_code", 17)}, "fault code 17"),
        ("temperature", {"disturb": field("temperature", 85.0)}, "85.0 °C"),
        ("temperature", {"disturb": field("temperature", -40.0)}, "-40.0 to -40.0 °C"),
        ("rate", {"rate_hz": 500.0}, "sampled at 125 Hz, the robot runs at 500 Hz"),
        ("identity", {"model": "ur10"}, "ur10"),
        ("identity", {"joint_names": NAMES[::-1]}, "j6, j5"),
        ("limits", {"qd_max": np.full(6, 0.5)}, "velocity [rad/s]"),
        ("load", {"payload_max_kg": 1.5}, "2.000 kg, the robot is rated for 1.500 kg"),
        ("payload", {"reads_back": Payload()}, "reads back 0.000 kg"),
        ("payload", {"reads_back": Payload(2.0, (0.01, 0, 0.05))}, "(0.010, 0.000, 0.050)"),
        ("payload", {"refuses": True}, "local mode"),
        ("clock", {"clock": "wall"}, "s off"),
    ],
)
def test_each_robot_fault_fails_its_own_check(
    check: str, facts: dict[str, Any], told: str, tmp_path: Path
) -> None:
    results = preflight(small_plan(), ScriptedRobot(**facts), context(tmp_path))
    assert check in failing(results)
    assert set(failing(results)) <= {check, "first-move"}
    (result,) = [result for result in results if result.name == check]
    assert told in result.message
    assert result.hint


@pytest.mark.parametrize(
    ("check", "changes", "told"),
    [
        ("disk", {"free_bytes": lambda folder: 1000}, "0 MB are free"),
        ("clock", {"now": lambda: 86_400.0}, "1970-01-02"),
        ("first-move", {"distance": lambda q: 0.015 + 0 * q[:, 0]}, "clearance of 15.0 mm"),
        ("first-move", {"distance": lambda q: 0.2 - q[:, 0]}, "clearance of -100.0 mm"),
        ("first-move", {"collision": None}, "no collision model"),
        ("folder", {"folder": Path("/nowhere/at/all")}, "cannot be written to"),
    ],
)
def test_each_fault_of_host_or_plan_fails_its_own_check(
    check: str, changes: dict[str, Any], told: str, tmp_path: Path
) -> None:
    results = preflight(small_plan(), ScriptedRobot(), context(tmp_path, **changes))
    assert failing(results) == [check]
    (result,) = [result for result in results if result.name == check]
    assert told in result.message


def own_arm(folder: Path, guessed: str) -> Path:
    text = files("hil.arms").joinpath("ur5.yaml").read_text("utf-8")
    path = folder / "own.yaml"
    path.write_text(text + f"\nguessed: {guessed}\n")
    return path


@pytest.mark.parametrize(
    ("robot", "guessed", "fails"),
    [
        ({"clock": "wall"}, "[gear_ratio, excite]", True),
        ({"clock": "wall", "driver": "mock"}, "[gear_ratio, excite]", False),
        ({"clock": "virtual"}, "[gear_ratio, excite]", False),
        ({"clock": "wall"}, "[]", False),
    ],
)
def test_a_real_arm_is_moved_on_guesses_with_a_reason_alone(
    robot: dict[str, str], guessed: str, fails: bool, tmp_path: Path
) -> None:
    path = own_arm(tmp_path, guessed)
    plan = small_plan(robot_model=str(path))
    results = preflight(plan, ScriptedRobot(**robot), context(tmp_path, waivers=("guessed",)))
    (result,) = [result for result in results if result.name == "guessed"]
    assert (result.passed, result.waived) == (not fails, fails)
    assert ("gear_ratio, excite" in result.message) == (guessed != "[]")
    assert str(path) in result.hint or not fails


@pytest.mark.parametrize("word", ["q_limits", "qd_max", "qdd_max", "capsules", "qd_max_deg_s"])
def test_guesses_of_what_interlocks_rest_on_are_not_waived(word: str, tmp_path: Path) -> None:
    plan = small_plan(robot_model=str(own_arm(tmp_path, f"[gear_ratio, {word}]")))
    robot, given = ScriptedRobot(clock="wall"), context(tmp_path, waivers=("guessed", "clock"))
    with pytest.raises(
        PreflightFailed, match=f"guessed values of the arm: gear_ratio, {word}"
    ) as refused:
        require_preflight(plan, robot, given)
    assert refused.value.hint.endswith(f"; {word} cannot be waived")


@pytest.mark.parametrize("guessed", ["capsules", "true", "[1]", "{capsules: 1}"])
def test_guesses_are_a_list_of_words(guessed: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="`guessed` must be a list of strings"):
        load_arm(str(own_arm(tmp_path, guessed)))


def test_the_first_move_is_checked_from_where_the_arm_stands(tmp_path: Path) -> None:
    robot = ScriptedRobot(disturb=field("q", [0.009, 0, 0, 0, 0, 0]))
    asked: list[FloatArray] = []

    def distance(q: FloatArray) -> FloatArray:
        asked.append(q)
        return np.ones(len(q))

    preflight(small_plan(), robot, context(tmp_path, distance))
    assert asked[0][0][0] == 0.009
    assert asked[0][-1][0] == 0.3


def test_a_robot_without_thermometers_passes(tmp_path: Path) -> None:
    robot = ScriptedRobot(disturb=field("temperature", np.nan))
    assert failing(preflight(small_plan(), robot, context(tmp_path))) == []


def test_all_failures_are_raised_together(tmp_path: Path) -> None:
    robot = ScriptedRobot(rate_hz=500.0, reads_back=Payload())
    with pytest.raises(PreflightFailed) as error:
        require_preflight(small_plan(), robot, context(tmp_path, free_bytes=lambda folder: 0))
    assert [line.split(":")[0] for line in error.value.message.splitlines()] == [
        "payload", "rate", "disk",
    ]  # fmt: skip
    assert error.value.exit_code == 3


def test_a_waived_failure_does_not_block_and_is_recorded(tmp_path: Path) -> None:
    kept: dict[str, Any] = {}
    robot = ScriptedRobot(reads_back=Payload())
    require_preflight(
        small_plan(), robot, context(tmp_path, waivers=("payload",)), keep=kept.__setitem__
    )
    document = json.loads(json.dumps(kept["preflight.json"], allow_nan=False))
    assert document["passed"] is True
    assert document["waivers"] == ["payload"]
    (payload,) = [check for check in document["checks"] if check["name"] == "payload"]
    assert (payload["passed"], payload["waived"]) == (False, True)


def test_results_are_kept_before_the_failure_is_raised(tmp_path: Path) -> None:
    kept: dict[str, Any] = {}
    with pytest.raises(PreflightFailed):
        require_preflight(
            small_plan(), ScriptedRobot(rate_hz=500.0), context(tmp_path), keep=kept.__setitem__
        )
    assert kept["preflight.json"]["passed"] is False


def test_figures_that_json_has_no_number_for_are_kept_as_words(tmp_path: Path) -> None:
    robot = ScriptedRobot(disturb=field("q", np.nan))
    results = preflight(small_plan(), robot, context(tmp_path))
    written = json.dumps([result.to_dict() for result in results], allow_nan=False)
    assert {check["name"]: check["measured"] for check in json.loads(written)}["pose"] == "nan"


def test_a_waiver_for_no_check_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="'paylod' is not the name of a check") as error:
        preflight(small_plan(), ScriptedRobot(), context(tmp_path, waivers=("paylod",)))
    assert "'payload'" in error.value.hint


def test_a_robot_that_cannot_be_read_is_a_broken_rig(tmp_path: Path) -> None:
    robot = ScriptedRobot()
    robot.close()
    with pytest.raises(RobotConnectionError):
        preflight(small_plan(), robot, context(tmp_path))


def plugged(monkeypatch: pytest.MonkeyPatch, check: Callable[[Situation], CheckResult]) -> None:
    monkeypatch.setattr(plugins, "names", lambda group: ("cell-door",))
    monkeypatch.setattr(plugins, "load", lambda group, name: check)


def test_plugged_in_checks_run_last_under_their_registered_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged(monkeypatch, lambda situation: CheckResult("whatever", False, "the door is open"))
    results = preflight(small_plan(), ScriptedRobot(), context(tmp_path))
    assert results[-1].name == "cell-door"
    assert failing(results) == ["cell-door"]


def test_a_check_that_breaks_has_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(situation: Situation) -> CheckResult:
        raise ZeroDivisionError("no door")

    plugged(monkeypatch, broken)
    result = preflight(small_plan(), ScriptedRobot(), context(tmp_path))[-1]
    assert not result.passed
    assert "ZeroDivisionError: no door" in result.message


def test_the_context_of_a_station_knows_its_surroundings(tmp_path: Path) -> None:
    made = preflight_context(ur5(clearance_m=0.03), tmp_path)
    assert made.clearance_m == 0.03
    assert made.collision is not None
    over_the_table = np.radians([[0, -90, 90, -90, -90, 0]])
    empty = made.collision(small_plan(loads=(LoadStep(Payload()),)))
    long_body = LoadStep(Payload(1.0, (0.0, 0.0, 0.2)), size_m=(0.45, 0.02))
    assert empty.clearance(over_the_table)[0] > 0.03
    assert made.collision(small_plan(loads=(long_body,))).clearance(over_the_table)[0] < 0
    assert preflight_context(ur5("arm.urdf"), tmp_path).collision is None


def test_the_reference_has_every_check_in_their_order_and_whether_it_is_waived() -> None:
    page = (ROOT / "docs/reference/cli.md").read_text("utf-8")
    table = page.partition("## Checks before motion")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `([\w-]+)` \|.*\| (never|with a reason)[^|]*\|$", table, re.M)
    assert rows == [
        (name, "never" if name in NEVER_WAIVED else "with a reason") for name in BUILT_IN
    ]


@pytest.mark.parametrize("check", sorted(NEVER_WAIVED))
def test_what_would_be_dangerous_cannot_be_waived(tmp_path: Path, check: str) -> None:
    with pytest.raises(SpecError, match="cannot be waived"):
        preflight(small_plan(), ScriptedRobot(), context(tmp_path, waivers=(check,)))


def test_a_load_the_operator_has_yet_to_mount_is_not_declared_before(tmp_path: Path) -> None:
    robot = ScriptedRobot()
    plan = replace(small_plan(), loads=(LoadStep(Payload(2.0), "Mount 2 kg"),))
    before = robot.calls.count("set_payload")
    preflight(plan, robot, context(tmp_path))
    assert robot.calls.count("set_payload") == before


def sweep() -> Plan:
    hold = Hold((0.3,) * 6)
    steps = (*small_plan().steps, Step(3, "weigh", hold, pose=0, approach=1, load=1))
    return small_plan(steps=steps, loads=(LoadStep(Payload()), LoadStep(Payload(1.0))))


def test_it_is_said_before_motion_whether_loads_will_be_weighed(tmp_path: Path) -> None:
    def told(plan: Plan, kind: str) -> str:
        robot = ScriptedRobot(effort_kind=kind)
        results = preflight(plan, robot, context(tmp_path))
        (result,) = (r for r in results if r.name == "weighing")
        assert result.passed
        return result.message

    assert told(sweep(), "torque") == "payload check of each load at 1 pose first"
    assert "no payload check: the robot's drive gains are unknown" in told(sweep(), "current")
    assert "no payload check: all loads have the same mass" in told(small_plan(), "torque")


def test_the_weighing_to_come_can_be_waived(tmp_path: Path) -> None:
    results = require_preflight(sweep(), ScriptedRobot(), context(tmp_path, waivers=("weighing",)))
    assert failing(results) == []


class Inspected(ScriptedRobot):
    """Looks at itself, too."""

    def checks(self) -> list[Finding]:
        if isinstance(self.facts["finds"], Exception):
            raise self.facts["finds"]
        return list(self.facts["finds"])


def test_what_a_robot_finds_about_itself_is_among_the_results(tmp_path: Path) -> None:
    fine = Finding("software", True, "software 3.15", "3.15", "3.11")
    robot = Inspected(finds=[fine])
    assert isinstance(robot, HasChecks)
    assert not isinstance(ScriptedRobot(), HasChecks)
    results = preflight(small_plan(), robot, context(tmp_path))
    assert [result.name for result in results] == [*BUILT_IN, "robot-software"]
    assert results[-1] == CheckResult("robot-software", True, "software 3.15", "3.15", "3.11")


def test_what_it_finds_wrong_keeps_it_from_moving_and_cannot_be_waived(tmp_path: Path) -> None:
    robot = Inspected(finds=[Finding("mode", False, "it sleeps", hint="wake it up")])
    with pytest.raises(PreflightFailed, match="robot-mode: it sleeps") as caught:
        require_preflight(small_plan(), robot, context(tmp_path))
    assert "wake it up" in caught.value.hint
    with pytest.raises(SpecError, match="is not the name of a check"):
        preflight(small_plan(), robot, context(tmp_path, waivers=("robot-mode",)))


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (RobotConnectionError("nobody answers", hint="call"), "nobody answers"),
        (ZeroDivisionError("a bug"), "ZeroDivisionError: a bug"),
    ],
)
def test_a_robot_that_cannot_look_at_itself_does_not_move(
    error: Exception, told: str, tmp_path: Path
) -> None:
    results = preflight(small_plan(), Inspected(finds=error), context(tmp_path))
    assert failing(results) == ["robot-checks"]
    assert told in results[-1].message
