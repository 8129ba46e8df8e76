"""The robot layer of the driver without a bus: rows, trouble, stops, findings, modes, gains."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import CommandRefused, RobotConnectionError, RobotFault, SpecError
from hil.dynamics.robot_model import RobotModel
from hil.robot import HasChecks, HasResource, HasTopics, RobotProcess, Segment, Status
from hil_drivers.arm import limits_of
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.axes_robot import AxesRobot
from hil_drivers.cia402.can_channel import open_bus
from hil_drivers.cia402.can_cycle import Counts, quick_stop_frames, stop_directly
from hil_drivers.cia402.commissioning import (
    Commissioned,
    Drive,
    LeftFault,
    declare,
    require_resettable,
    set_mode,
)
from hil_drivers.cia402.gains import KV_PER_S, LOOP_RAD_S, gains_of
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.profile import AxisProfile, Scaling
from hil_drivers.cia402.robot import Cia402Robot
from hil_drivers.cia402.rows import TOPIC
from hil_drivers.cia402.session import Session, Thermometer, Trouble, outside_of
from hil_drivers.cia402.torque import TorqueModel
from hil_drivers.cia402.track import track_of
from hil_mock_robot.cia402.keys import key
from tests.support.cia402_drives import drives
from tests.support.in_time import InTime, measured_again

ARM = load_arm("lab6")
PROFILES = [AxisProfile(1 << 20, float(gear), 2.0, 1.0) for gear in ARM.gear_ratio]
SCALING = Scaling(PROFILES)
PERIOD_S = 0.004
GIVEN = {"bus": {"interface": "hil_unix", "channel": "nobody"}}


class Objects:
    """Drives that remember what was written."""

    def __init__(self):
        self.values = {}

    def upload(self, axis, entry):
        return self.values[axis, entry.index, entry.sub]

    def download(self, axis, entry, value):
        self.values[axis, entry.index, entry.sub] = value


class Asked:
    """Drives that are asked at once."""

    def __init__(self):
        self.axes = []

    n = 3

    def upload_each(self, entry, axes, within_s=0.0):
        self.axes.append(list(axes))
        return {}


def found(**objects):
    drives = tuple(Drive(objects, profile) for profile in PROFILES)
    return Commissioned(drives, ((),) * 6)


def segment(q, kind="trajectory", qd=None):
    q = np.atleast_2d(np.asarray(q, dtype=float))
    zeros = np.zeros_like(q)
    return Segment(3, kind, q, zeros if qd is None else qd, zeros, 0.0, 0.0)


def track(asked, standing=None, model=None, *, first=False):
    standing = np.zeros(6) if standing is None else standing
    return track_of(asked, limits_of("lab6"), standing, 250.0, SCALING, model, first=first)


# -- what is told of silence


class Named:
    """Drives that have names, and samples of which some axes have left none."""

    def __init__(self, *silent):
        self.silent = silent

    def name_of(self, axis):
        return f"joint_{axis + 1} (node {axis + 1})"


def test_when_no_cycle_is_complete_the_axes_that_do_not_answer_are_named():
    axes = Named(1, 3)
    said = Trouble("arm", None, axes, axes).silence(1.0).message
    assert said == "arm: no answer from joint_2 (node 2), joint_4 (node 4) within 1 s"


def test_when_there_is_no_cycle_no_axis_is_blamed():
    trouble = Trouble("arm", None, Named(), Named())
    assert "no cycle ended within 1 s" in trouble.silence(1.0).message


# -- before anybody connects


def test_a_robot_is_described_without_a_process_and_without_a_bus():
    robot = Cia402Robot("arm", "lab6", **GIVEN)
    assert robot.process is None
    assert (robot.capabilities.rate_hz, robot.capabilities.effort_kind) == (250.0, "torque")
    assert robot.resource == "can://hil_unix/nobody"
    assert [topic.name for topic in robot.topics] == [TOPIC]
    assert isinstance(robot, HasTopics)
    assert isinstance(robot, HasResource)
    assert isinstance(robot, HasChecks)
    robot.stop()
    robot.close()


def test_a_wrong_option_is_told_before_a_process_is_started():
    with pytest.raises(SpecError, match="effrot"):
        Cia402Robot("arm", "lab6", **GIVEN, effrot="torque")


def test_a_bus_that_nobody_hosts_says_what_to_start():
    with pytest.raises(RobotConnectionError, match="has no host") as caught:
        open_bus(options_of(GIVEN, "lab6").bus, within_s=0.0)
    assert "hil mock can" in str(caught.value.hint)


def test_a_direct_stop_says_when_it_cannot_be_heard():
    assert not stop_directly(options_of(GIVEN, "lab6"))


@pytest.mark.parametrize("mapping", ["position", "minimal", "all-modes"])
def test_a_direct_stop_is_a_quick_stop_for_every_axis_and_a_sync(mapping):
    options = options_of(GIVEN | {"mapping": mapping, "nodes": [1, 2, 3, 10, 11, 12]}, "lab6")
    *commands, sync = [bytes(frame) for frame in quick_stop_frames(options)]
    told = {(int.from_bytes(c[:4], "little"), int.from_bytes(c[8:10], "little")) for c in commands}
    assert told == {(0x200 + node, 0x02) for node in options.nodes}
    assert int.from_bytes(sync[:4], "little") == 0x080


# -- what the drives say


def test_limits_are_the_stricter_ones_of_maker_and_drives():
    nobodys = limits_of("lab6", found().reported_limits)
    theirs = limits_of("lab6", found(max_torque=1000).reported_limits)
    assert nobodys.effort_max.tolist() == ARM.effort_max.tolist()
    assert theirs.effort_max == pytest.approx(np.minimum(ARM.effort_max, ARM.gear_ratio))
    ends = {"position_limit_min": -(1 << 24), "position_limit_max": 1 << 24}
    narrow = limits_of("lab6", found(**ends).reported_limits)
    ends_rad = (1 << 24) * SCALING.position_resolution
    assert narrow.q_max == pytest.approx(np.minimum(ARM.q_max, ends_rad))
    assert narrow.q_min == pytest.approx(np.maximum(ARM.q_min, -ends_rad))


def test_gains_are_those_of_the_drives_once_they_are_known():
    robot = AxesRobot("arm", "lab6", **GIVEN, effort="current")
    before = robot.capabilities
    robot._session = SimpleNamespace(drives=found())
    after = robot.capabilities
    assert before.drive_gains == tuple(ARM.drive_gains)
    assert after.drive_gains == pytest.approx(1.0 * ARM.gear_ratio / 2.0)
    assert after.drive_gains_source != before.drive_gains_source


def test_the_identity_has_serials_and_what_was_reset():
    fault = LeftFault(2, "joint_3 (node 3)", (0x8611, 0x8130))
    who = found(serial=0xABC, revision=0x10002).identity("lab6", [fault])
    assert who.serial.split() == ["abc"] * 6
    assert who.firmware.split() == ["10002"] * 6
    assert "joint_3 (node 3) is in fault: following error (8611h)" in who.details["faults_reset"]


@pytest.mark.parametrize("code", [0x8130, 0x8611, 0x8700])
def test_faults_of_monitoring_may_be_reset_by_connecting(code):
    require_resettable([LeftFault(0, "joint_1 (node 1)", (code,))])


@pytest.mark.parametrize("codes", [(0x2310,), (0x4310, 0x8130), (0x8130, 0x2310), ()])
def test_other_faults_are_for_a_person(codes):
    with pytest.raises(RobotFault, match="joint_1"):
        require_resettable([LeftFault(0, "joint_1 (node 1)", codes)])


# -- segments


def test_a_segment_becomes_set_points_of_the_drives():
    q = np.linspace(0, 0.003, 20)[:, None] * np.ones(6)
    qd = np.gradient(q, axis=0) * 250
    made = track(segment(q, qd=np.where(np.arange(20)[:, None] % 19, qd, 0)))
    assert SCALING.position(made.position) == pytest.approx(q, abs=1e-7)
    assert made.segment == 3
    assert not made.torque.any()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (segment(np.full((2, 6), 0.003)), "begins 0.0030 rad from the present position of the arm"),
        (segment([[0.0] * 6, [0.0] * 5 + [0.1]]), "move joint 6 with 25.000 rad/s"),
        (segment([[0.0] * 6, [0.0] * 5 + [7.0]]), "joint range"),
    ],
)
def test_what_drives_would_follow_with_a_jump_is_refused(asked, said):
    with pytest.raises(CommandRefused, match=said):
        track(asked)


def ramp(step, rows=60):
    q = np.zeros((rows, 6))
    q[:, 5] = step * np.arange(rows)
    return q


def zigzag(step):
    q = np.zeros((60, 6))
    q[1:-1:2, 5] = step
    return q


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            segment(zigzag(0.03)),
            "accelerates joint 6 at row 1 with 3750.0 rad/s², computed from its positions",
        ),
        (segment(ramp(0.03)), "accelerates joint 6 at its (beginning|end) with 1875.0 rad/s²"),
        (segment(np.minimum(ramp(0.02), 0.4)), "with 1250.0 rad"),
        (segment(ramp(0.001), kind="hold"), "a hold has one"),
    ],
)
def test_positions_are_believed_not_what_is_said_of_them(asked, said):
    with pytest.raises(CommandRefused, match=said):
        track(asked)


@pytest.mark.parametrize("short_s", [0.1, 0.3])
def test_a_polynomial_at_the_limit_of_acceleration_is_taken(short_s):
    rows = round(short_s * 250)
    t = np.arange(rows + 1) / rows
    way = ARM.qdd_max * 0.999 * short_s**2 / (10 / 3**0.5)
    q = (10 * t**3 - 15 * t**4 + 6 * t**5)[:, None] * way
    assert track(segment(q)).segment == 3


def test_a_trapezoid_at_the_limit_of_acceleration_is_taken():
    a = np.concatenate((np.full(20, 1.0), np.zeros(5), np.full(20, -1.0)))
    v = np.concatenate(([0.0], np.cumsum(a))) * PERIOD_S
    q = np.concatenate(([0.0], np.cumsum((v[1:] + v[:-1]) / 2))) * PERIOD_S
    assert track(segment(q[:, None] * ARM.qdd_max)).segment == 3


def test_a_stop_that_no_joint_is_made_for_is_refused():
    with pytest.raises(SpecError, match=r"stop_rad_s2 is 20[^\0]*10\.47"):
        options_of(GIVEN | {"stop_rad_s2": 20.0}, "lab6")


def test_an_arm_led_by_a_spring_first_goes_to_where_the_segment_begins():
    asked, standing = segment(np.full((2, 6), 0.03)), np.zeros(6)
    made = track_of(asked, limits_of("lab6"), standing, 250.0, SCALING, None, led=True)
    q = SCALING.position(made.position)
    assert q[0] == pytest.approx(standing, abs=1e-7)
    assert q[-1] == pytest.approx(asked.q[-1], abs=1e-7)
    assert np.abs(np.diff(q, axis=0)).max() * 250.0 < 0.2
    assert SCALING.velocity(made.velocity) == pytest.approx(np.gradient(q, axis=0) * 250, abs=5e-3)


def test_the_way_to_the_begin_of_a_segment_keeps_the_limits():
    asked, limits = segment(np.full((2, 6), 0.05)), limits_of("lab6")
    slow = replace(limits, qd_max=0.1 * np.ones(6), qdd_max=0.5 * np.ones(6))
    made = track_of(asked, slow, np.zeros(6), 250.0, SCALING, None, led=True)
    q = SCALING.position(made.position)
    assert np.abs(np.diff(q, axis=0)).max() * 250.0 <= 0.1
    assert np.abs(np.diff(q, 2, axis=0)).max() * 250.0**2 <= 0.51


def test_what_a_brake_gave_since_the_plan_was_made_is_made_good_first():
    asked, standing = segment(np.full((2, 6), 0.001)), np.zeros(6)
    q = SCALING.position(track(asked, standing, first=True).position)
    assert q[0] == pytest.approx(standing, abs=1e-7)
    assert q[-1] == pytest.approx(asked.q[-1], abs=1e-7)


@pytest.mark.parametrize(
    ("asked", "first"),
    [
        (segment(np.full((2, 6), 0.003)), True),
        (segment(np.full((2, 6), 0.001)), False),
        (segment(np.full((1, 6), 0.001), kind="hold"), True),
    ],
    ids=["farther than a brake gives", "after a motion", "a hold"],
)
def test_nothing_else_is_made_good(asked, first):
    with pytest.raises(CommandRefused, match="from the present position of the arm"):
        track(asked, np.zeros(6), first=first)


# -- torques and loads


def test_the_torque_model_is_that_of_the_arm_with_its_load():
    model, load = TorqueModel("lab6"), Payload(2.0, (0.0, 0.01, 0.05))
    q = np.array([[0.1, 0.4, -0.3, 0.2, 0.5, 0.0]])
    bare = RobotModel.from_arm("lab6")
    assert model.holding(q) == pytest.approx(bare.gravity(q))
    model.mount(load)
    assert model.holding(q) == pytest.approx(bare.with_payload(load).gravity(q))
    made = track(segment(q[0]), standing=q[0], model=model)
    assert SCALING.torque(made.torque) == pytest.approx(model.holding(q), abs=0.1)
    model.mount(Payload())
    assert model.holding(q) == pytest.approx(bare.gravity(q))


def test_an_arm_on_a_wall_is_held_by_other_torques():
    q = np.zeros((1, 6))
    assert TorqueModel("lab6", gravity=(9.81, 0.0, 0.0)).holding(q) != pytest.approx(
        TorqueModel("lab6").holding(q)
    )


def test_a_load_is_declared_to_the_first_drive_and_read_back():
    drives, load = Objects(), Payload(1.25, (0.0, -0.01, 0.05), (1e-3, 1e-3, 1e-3, 0, 0, 0))
    assert declare(drives, 0x2100, load).agrees_with(load)
    assert sorted(drives.values) == [(0, 0x2100, sub) for sub in (1, 2, 3, 4)]
    assert drives.values[0, 0x2100, 1] == 0x3FA00000  # REAL32 of 1.25


# -- temperatures


def test_temperatures_are_asked_in_turns():
    drives = Asked()
    thermometer = Thermometer(drives, 0x2110)
    thermometer.ask_all()
    for _ in range(4):
        thermometer.look()
        thermometer._next_s = 0.0
    assert drives.axes == [[0, 1, 2], [0], [1], [2]]


def test_drives_that_tell_no_temperature_are_not_asked():
    drives = Asked()
    thermometer = Thermometer(drives, 0)
    thermometer.ask_all()
    thermometer.look()
    assert drives.axes == []


def test_where_python_can_is_missing_the_process_that_joins_the_bus_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[RobotProcess] = []
    monkeypatch.setitem(sys.modules, "can", None)
    monkeypatch.setattr(RobotProcess, "connect", lambda robot: asked.append(robot))
    robot = Cia402Robot.__new__(Cia402Robot)
    robot.connect()
    assert asked == [robot]


# What the next read raises, and what drives are told beside their process data.


ROWS = np.array([(0,)], dtype=[("status", "<u2")])


def trouble_of(line: Any, problem: str, **samples: Any) -> Trouble:
    told = [problem, ""]
    core: Any = SimpleNamespace(take_problem=lambda: told.pop(0) if told else "")
    of_cycles: Any = SimpleNamespace(**({"faulty": [], "silent": []} | samples))
    return Trouble("arm", core, line.master, of_cycles)


def test_axes_that_process_data_do_not_reach_are_stopped_by_objects() -> None:
    with drives(2) as line:  # pre-operational: they take no RPDOs
        line.nodes[1].registers[key(0x6041)] = 0x0250
        trouble = trouble_of(line, "joint_2: has restarted", silent=[1])
        trouble.look(ROWS)
        assert [node.registers[key(0x6040)] for node in line.nodes] == [2, 2]
        with pytest.raises(RobotFault, match=r"6041h: joint_2 \(node 2\) switch on disabled"):
            trouble.raise_it()


@pytest.mark.parametrize(("silent", "hint"), [([0, 1], "check the bus"), ([1], "remove the cause")])
def test_where_nobody_answers_the_bus_is_what_to_look_at(silent: list[int], hint: str) -> None:
    with drives(2) as line:
        trouble = trouble_of(line, "has not answered", silent=silent)
        trouble.look(ROWS)
        with pytest.raises(RobotFault) as caught:
            trouble.raise_it()
        assert hint in caught.value.hint


def test_nothing_is_sent_while_all_is_well() -> None:
    with drives(2) as line:
        line.sent.clear()
        trouble_of(line, "").look(ROWS)
        assert [can_id for can_id, _ in line.sent if can_id >= 0x600] == []


@measured_again
def test_silent_drives_do_not_keep_a_fault_from_being_told() -> None:
    with drives(2) as line:
        line.lost = lambda can_id, _: can_id == 0x581
        line.nodes[1].registers[key(0x603F)] = 0x2310
        rows = ROWS.copy()
        rows["status"] = int(Status.FAULT)
        trouble = trouble_of(line, "joint_1: its heartbeat is overdue", faulty=[0, 1], silent=[0])
        asked = InTime()
        trouble.look(rows)
        with pytest.raises(RobotFault, match=r"603Fh: joint_2 \(node 2\) .*2310h") as caught:
            trouble.raise_it()
        asked.require(0.5)
        assert "6041h" not in caught.value.message


def test_a_fault_told_by_an_emcy_alone_is_asked_for_once_all_axes_were_told_to_stop() -> None:
    """It comes before the process data that show it, so that no row says which axis it is."""
    with drives(2) as line:
        line.nodes[1].registers[key(0x6041)] = 0x0218
        line.nodes[1].registers[key(0x603F)] = 0x8611
        line.nodes[0].registers[key(0x603F)] = 0x8130  # its last error, long gone
        trouble = trouble_of(line, "joint_2 (node 2): following error (8611h)")
        line.sent.clear()
        trouble.look(ROWS)
        with pytest.raises(RobotFault, match=r"\(603Fh: joint_2 \(node 2\) [^;]*8611h\)\)\n"):
            trouble.raise_it()
        asked = [
            int.from_bytes(data[1:3], "little") for can_id, data in line.sent if can_id > 0x600
        ]
        assert asked == [0x6040, 0x6040, 0x6041, 0x6041, 0x603F]


# A stop that comes while the drives are being connected leaves them off.


STEPS = ["join", "open", "operational", "run", "reset_faults", "enable", "look", "switch", "ask"]
STEPS += ["forget"]


class Steps:
    """Plays a session: notes what is done, and has something happen at one step."""

    def __init__(self, at: str, happens: Any) -> None:
        self.done: list[str] = []
        self._at, self._happens = at, happens

    def step(self, name: str) -> Any:
        def do(*_: Any, **__: Any) -> None:
            self.done.append(name)
            if name == self._at:
                self._happens()

        return do

    def session(self, *_: Any) -> Any:
        self.step("join")()
        core = {name: self.step(name) for name in STEPS} | {"stop": lambda _: None}
        made = object.__new__(Session)
        made.core = SimpleNamespace(**core)  # type: ignore[assignment]
        made.acyclic = SimpleNamespace(operational=self.step("operational"), n=6)  # type: ignore[assignment]
        made.options = SimpleNamespace(trajectory_mode="cst", stop_rad_s2=1.0)  # type: ignore[assignment]
        made.mapping, made.faults_reset = MAPPINGS["position"], [object()]  # type: ignore[list-item]
        made.leave = self.step("leave")  # type: ignore[method-assign]
        made.require_plausible_torques = self.step("look")  # type: ignore[method-assign]
        made.thermometer = SimpleNamespace(ask_all=self.step("ask"))  # type: ignore[assignment]
        made.samples = SimpleNamespace(forget=self.step("forget"))  # type: ignore[assignment]
        made.trouble = SimpleNamespace(is_there=False)  # type: ignore[assignment]
        return made


@pytest.mark.parametrize("at", STEPS)
def test_a_stop_at_any_step_refuses_and_leaves_the_axes_off(monkeypatch, at: str) -> None:
    robot = AxesRobot("arm", "lab6", **GIVEN)
    steps = Steps(at, robot.stop)
    monkeypatch.setattr(robot, "_join", steps.session)
    with pytest.raises(CommandRefused, match="stopped while connecting"):
        robot.connect()
    assert steps.done[-1] == "leave"
    if STEPS.index(at) < STEPS.index("enable"):
        assert "enable" not in steps.done
    assert steps.done.count("switch") == (at in STEPS[STEPS.index("switch") :])


def test_a_robot_that_was_stopped_before_is_connected(monkeypatch) -> None:
    robot = AxesRobot("arm", "lab6", **GIVEN)
    steps = Steps("nowhere", robot.stop)
    monkeypatch.setattr(robot, "_join", steps.session)
    robot.stop()
    robot.connect()
    assert steps.done == STEPS


# What the driver says about the bus before a motion.


def test_what_has_gone_wrong_on_the_bus_is_told_with_its_number() -> None:
    told = str(Counts(missing=12, late=3, foreign=1))
    assert told == ("12 answers (TPDOs) missing, 3 of them late, 1 frames of foreign nodes")
    assert str(Counts(doubled=2)) == "2 received twice"


def test_a_bus_on_which_nothing_went_wrong_is_not_spoken_of() -> None:
    assert str(Counts()) == ""


def test_a_joint_outside_of_its_range_is_named_with_the_figures() -> None:
    limits = limits_of("lab6")
    names = [f"joint_{axis + 1}" for axis in range(6)]
    assert outside_of(limits.q_max, limits, names) == []
    at = np.zeros(6)
    at[1] = limits.q_min[1] - 0.5
    (said,) = outside_of(at, limits, names)
    low, high = np.degrees([limits.q_min[1], limits.q_max[1]])
    assert said == (
        f"joint_2 is at {low - np.degrees(0.5):.1f}°, outside its range of {low:.1f} to {high:.1f}°"
    )


# The mode by object, where the process data do not carry it.


class Modes:
    """Drives that show a mode after some looks; one stays where it is."""

    def __init__(self, shows, stuck=()):
        self.shows, self.stuck, self.looks = list(shows), stuck, 0
        self.written = [0] * len(self.shows)

    def name_of(self, axis):
        return f"joint_{axis + 1}"

    def upload(self, axis, entry):
        assert entry == od.MODE_DISPLAY
        self.looks += 1
        if self.looks > 3 and axis not in self.stuck:
            self.shows[axis] = self.written[axis]
        return self.shows[axis]

    def download(self, axis, entry, value):
        assert entry == od.MODE
        self.written[axis] = value


def test_only_the_minimal_mapping_lacks_the_mode():
    assert {name for name, mapping in MAPPINGS.items() if not mapping.carries_mode} == {"minimal"}


def test_a_mode_that_was_left_in_the_drives_is_replaced_and_waited_for():
    modes = Modes([od.CST, od.CST])
    set_mode(modes, range(2), od.CSP)
    assert modes.written == modes.shows == [od.CSP, od.CSP]


def test_a_drive_that_stays_in_its_mode_is_named_with_it():
    modes = Modes([od.CST, od.CST], stuck=(1,))
    with pytest.raises(CommandRefused, match=r"joint_2: mode 8 \(csp\).* shows 10 \(cst\)"):
        set_mode(modes, range(2), od.CSP, within_s=0.05)


# Gains of CST and CSV in the drives' units, checked in N·m and rad/s.


AXIS = AxisProfile(1 << 20, 121.0, 2.5, 1.3)
TURNED = replace(AXIS, polarity=0xC0, velocity_unit="0.001 rpm")  # position counts backwards
AXES = [AXIS, TURNED, replace(AXIS, direction=-1), AXIS, AXIS, AXIS]
GAIN_SCALING = Scaling(AXES)
DRIVES = [Drive({"max_torque": 1500}, axis) for axis in AXES]
GAINS = [{"stiffness_nm_rad": 800.0, "damping_nms_rad": 60.0}] * 6


def test_an_error_of_position_gives_the_torque_of_the_spring_whatever_the_signs_are():
    gains = gains_of(GAINS, DRIVES, ARM)
    error = GAIN_SCALING.raw_position(0.25) - GAIN_SCALING.raw_position(0.15)
    assert GAIN_SCALING.torque(gains.kp * error) == pytest.approx(80.0, rel=1e-4)


def test_an_error_of_velocity_gives_the_torque_of_the_damper():
    gains = gains_of(GAINS, DRIVES, ARM)
    torque = GAIN_SCALING.torque(gains.kd * GAIN_SCALING.raw_velocity(0.5))
    assert torque == pytest.approx(30.0, rel=1e-3)


def test_an_error_of_position_gives_a_velocity_that_closes_it():
    gains = gains_of(GAINS, DRIVES, ARM)
    counts = gains.kv * (GAIN_SCALING.raw_position(0.1) - GAIN_SCALING.raw_position(0.0))
    assert GAIN_SCALING.velocity(np.rint(counts)) == pytest.approx(0.1 * KV_PER_S, rel=1e-3)


def test_no_more_torque_is_commanded_than_drive_and_arm_allow():
    free = [Drive({}, axis) for axis in AXES]
    assert gains_of(GAINS, DRIVES, ARM).limit[0] == pytest.approx(1500)
    arms = gains_of(GAINS, free, ARM).limit
    assert np.array(arms) * abs(AXIS.nm_per_count) == pytest.approx(ARM.effort_max)


def test_by_default_the_loop_is_critically_damped_on_the_least_inertia():
    gains = gains_of([{}] * 6, DRIVES, ARM)
    inertia = 0.1 * ARM.effort_max[0] / ARM.qdd_max[0]
    stiffness = gains.kp[0] * AXIS.nm_per_count / AXIS.rad_per_increment
    damping = gains.kd[0] * AXIS.nm_per_count / AXIS.rad_s_per_count
    assert stiffness / inertia == pytest.approx(LOOP_RAD_S**2)
    assert damping / (2 * np.sqrt(stiffness * inertia)) == pytest.approx(1.0)
