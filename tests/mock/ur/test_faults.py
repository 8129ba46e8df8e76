"""Faults of the mock UR controller: what can be asked for, when they strike, what the line does."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil_mock_robot.server.faults import Schedule
from hil_mock_robot.ur.dashboard import IdleProgram
from hil_mock_robot.ur.faults import Target, UrFault, UrFaults
from hil_mock_robot.ur.machine import CODE
from hil_mock_robot.ur.modes import RobotMode, RuntimeState, SafetyMode
from hil_mock_robot.ur.motion import StopJoints
from hil_mock_robot.ur.rtde import Ownership
from hil_mock_robot.ur.rtde_wire import Framer, Kind, Line, package
from tests.support.ur_machine import Wire, machine_of, movej, pass_time

TICK = 0.008


# What can be asked for


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("cut", "faults is 'cut'"),
        ([3], r"faults\[0\] is 3"),
        ([{"kind": "quake", "at_s": 1}], r"faults\[0\] is .*quake"),
        ([{"kind": "cut"}], r"faults\[0\] is"),
        ([{"kind": "cut", "at_s": 1}, {"kind": "cut", "at_s": 1, "motion": 2}], r"faults\[1\]"),
        ([{"kind": "cut", "at_s": -1}], r"cut\)\.at_s is -1"),
        ([{"kind": "cut", "at_s": True}], r"at_s is True"),
        ([{"kind": "cut", "at_s": math.nan}], r"at_s is nan"),
        ([{"kind": "cut", "at_s": math.inf}], r"at_s is inf"),
        ([{"kind": "cut", "at_s": 1, "packages": 3}], "has no key packages"),
        ([{"kind": "cut", "at_s": 1, "after_s": 3}], "after_s is 3"),
        ([{"kind": "cut", "motion": 0}], "motion is 0"),
        ([{"kind": "cut", "motion": 1.5}], "motion is 1.5"),
        ([{"kind": "late", "at_s": 1}], "lacks by_s"),
        ([{"kind": "jitter", "at_s": 1, "by_s": 99}], "by_s is 99"),
        ([{"kind": "drop", "at_s": 1, "packages": 0}], "packages is 0"),
        ([{"kind": "overheat", "at_s": 1, "joint": 7}], "joint is 7"),
        ([{"kind": "reboot", "at_s": 1, "powered": "yes"}], "powered is 'yes'"),
        ([{"kind": "protective_stop", "at_s": 1, "code": 4}], "code is 4"),
        ([{"kind": "silence", "at_s": 1, "for_s": "long"}], "for_s is 'long'"),
        ([{"kind": "silence", "at_s": 1, 5: 1}], "has no key 5"),
    ],
)
def test_what_cannot_be_is_refused_in_words(given, words):
    with pytest.raises(SpecError, match=words) as refused:
        UrFault.all_of(given)
    assert refused.value.hint


def test_a_file_holds_a_list_or_faults_and_says_its_name_when_it_does_not(tmp_path):
    path = tmp_path / "faults.yaml"
    for text in ("- {kind: cut, at_s: 1}", "faults:\n  - {kind: cut, at_s: 1}"):
        path.write_text(text)
        (cut,) = UrFault.read(path)
        assert (cut.kind, cut.at_s, cut.for_s) == ("cut", 1.0, 0.0)
    for text in ("- {kind: quake, at_s: 1}", "a: [", "mistakes: []"):
        path.write_text(text)
        with pytest.raises(SpecError, match=r"faults\.yaml"):
            UrFault.read(path)
    with pytest.raises(SpecError, match="nowhere"):
        UrFault.read(tmp_path / "nowhere.yaml")


def test_what_lasts_ends_when_it_is_told_to_or_never():
    assert UrFault.one_of("f", {"kind": "silence"}).for_s == math.inf
    assert UrFault.one_of("f", {"kind": "silence", "for_s": 2}).for_s == 2.0
    assert UrFault.one_of("f", {"kind": "reboot"}).for_s == 3.0


# When they strike


def strikes(schedule, ticks, began=None):
    """(tick, kind, begins) of everything that happens."""
    found = []
    for tick in range(1, ticks + 1):
        if began and tick in began:
            schedule.began(began[tick])
        begun, over = schedule.turn()
        found += [(tick, fault.kind, True) for fault in begun]
        found += [(tick, fault.kind, False) for fault in over]
    return found


def test_a_dated_fault_begins_with_its_tick_and_lasts_as_long_as_said():
    faults = [
        UrFault.make("silence", at_s=0.08, for_s=0.04),
        UrFault.make("emergency_stop", at_s=0.081),
    ]
    assert strikes(Schedule(faults, TICK), 20) == [
        (10, "silence", True),
        (11, "emergency_stop", True),
        (15, "silence", False),
    ]


def test_a_fault_waits_for_its_motion_or_program():
    faults = [
        UrFault.make("cut", motion=2, after_s=0.04, for_s=0.0),
        UrFault.make("freeze", program=1),
    ]
    began = {3: "motion", 5: "program", 10: "motion"}
    assert strikes(Schedule(faults, TICK), 20, began) == [
        (5, "freeze", True),
        (14, "cut", True),
        (15, "cut", False),
    ]


def test_what_is_cleared_neither_lasts_nor_comes():
    schedule = Schedule([UrFault.make("silence", at_s=0.0), UrFault.make("cut", at_s=0.08)], TICK)
    strikes(schedule, 3)
    assert [fault.kind for fault in schedule.clear(keep="reboot")] == ["silence"]
    assert strikes(schedule, 20) == []


# The line


def data(number):
    return package(Kind.DATA, bytes([1]) + number.to_bytes(8, "big"))


def on(line):
    """What faults act on, of which there is only a line."""
    return Target(SimpleNamespace(line=line))


def line_with(*faults, seed=3):
    line, wire = Line(TICK, seed), Wire()
    end = line.over(wire)
    end.send(data(0))
    for fault in faults:
        fault.begin(on(line))
    return line, end, wire


def sent_over(line, end, wire, count):
    """Number → tick at which it came, for packages 1 to `count`, sent one a tick."""
    wire.take()
    arrived = []
    for tick in range(1, count + 1):
        line.tick()
        end.send(data(tick))
        for kind, payload in Framer().feed(wire.take()):
            assert kind == Kind.DATA
            arrived.append((int.from_bytes(payload[1:9], "big"), tick))
    return arrived


def test_a_sound_line_passes_packages_as_they_are():
    line, end, wire = line_with()
    assert line.sound
    assert sent_over(line, end, wire, 3) == [(1, 1), (2, 2), (3, 3)]


def test_dropped_and_duplicated_packages():
    assert sent_over(*line_with(UrFault.make("drop", packages=2)), 4) == [(3, 3), (4, 4)]
    twice = [(1, 1), (1, 1), (2, 2), (3, 3)]
    assert sent_over(*line_with(UrFault.make("duplicate")), 3) == twice


def test_a_line_is_sound_again_after_the_last_spoilt_package():
    line, end, wire = line_with(UrFault.make("drop"))
    assert not line.sound
    sent_over(line, end, wire, 2)
    assert line.sound


def test_late_packages_come_complete_in_order_and_all_at_once_when_it_is_over():
    late = UrFault.make("late", by_s=3 * TICK)
    line, end, wire = line_with(late)
    assert sent_over(line, end, wire, 6) == [(1, 4), (2, 5), (3, 6)]
    late.end(on(line))
    line.tick()
    line.tick()
    line.tick()
    assert len(Framer().feed(wire.take())) == 3
    assert line.sound


def test_jitter_delays_differently_keeps_the_order_and_is_the_same_for_the_same_seed():
    def arrivals(seed):
        return sent_over(*line_with(UrFault.make("jitter", by_s=5 * TICK), seed=seed), 200)

    arrived = arrivals(3)
    assert [number for number, _ in arrived] == list(range(1, len(arrived) + 1))
    delays = {tick - number for number, tick in arrived}
    assert min(delays) >= 0
    assert len(delays) > 3
    assert max(delays) <= 5
    assert arrivals(3) == arrived != arrivals(4)


def test_frozen_packages_repeat_the_last_one_before():
    assert [number for number, _ in sent_over(*line_with(UrFault.make("freeze")), 3)] == [0, 0, 0]


def test_silence_swallows_replies_too():
    _, end, wire = line_with(UrFault.make("silence"))
    wire.take()
    end.send(data(1))
    end.send(package(Kind.START, b"\x01"))
    assert wire.take() == b""


@pytest.mark.parametrize("by_bytes", [-4, 5])
def test_a_package_of_the_wrong_length_says_so_in_its_header(by_bytes):
    _, end, wire = line_with(UrFault.make("wrong_length", by_bytes=by_bytes))
    wire.take()
    end.send(data(1))
    end.send(data(2))
    lengths = [len(payload) for _, payload in Framer().feed(wire.take())]
    assert lengths == [9 + by_bytes, 9]


def test_a_package_lost_meanwhile_leaves_the_next_ones_of_the_wrong_length():
    wrong = UrFault.make("wrong_length", packages=2, by_bytes=-4)
    _, end, wire = line_with(wrong, UrFault.make("drop"))
    wire.take()
    for number in range(1, 5):
        end.send(data(number))
    assert [len(payload) for _, payload in Framer().feed(wire.take())].count(5) == 2


def test_garbage_is_as_long_as_what_it_replaces_and_never_the_reply_to_a_question():
    _, end, wire = line_with(UrFault.make("garbage"))
    wire.take()
    end.send(package(Kind.START, b"\x01"))
    assert wire.take() == package(Kind.START, b"\x01")
    end.send(data(1))
    spoilt = wire.take()
    assert len(spoilt) == len(data(1))
    assert spoilt != data(1)


def test_a_cut_line_hangs_up_and_goes_on_doing_so_until_it_is_over():
    cut = UrFault.make("cut", for_s=1.0)
    line, end, wire = line_with(cut)
    assert end.closed
    assert wire.closed
    assert line.over(Wire()).closed
    cut.end(on(line))
    assert not line.over(Wire()).closed


def test_a_cut_may_strike_only_those_who_own_inputs():
    class Client:
        hung_up = 0

        def hang_up(self):
            self.hung_up += 1

    owners, writer, reader = Ownership(), Client(), Client()
    owners.take(["input_int_register_0", "input_int_register_1"], writer)
    troubled(machine_of(), owners=owners).add({"kind": "cut", "only": "inputs"})
    assert (writer.hung_up, reader.hung_up) == (1, 0)
    with pytest.raises(SpecError, match="only"):
        UrFault.one_of("f", {"kind": "cut", "only": "readers"})


# The machine


def troubled(machine, *planned, owners=None):
    return UrFaults(machine, planned, owners)


def turn(machine, faults, seconds):
    for _ in range(round(seconds / machine.tick_s)):
        faults.tick()
        machine.tick()


def aside(machine):
    machine.move(movej(machine.setpoint[0] + 0.5, 1.0, 2.0, machine.tick_s))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "safety", "code"),
    [
        ("protective_stop", SafetyMode.PROTECTIVE_STOP, 158),
        ("emergency_stop", SafetyMode.ROBOT_EMERGENCY_STOP, 0),
        ("safeguard_stop", SafetyMode.SAFEGUARD_STOP, 0),
        ("safety_fault", SafetyMode.FAULT, 0),
        ("overheat", SafetyMode.PROTECTIVE_STOP, CODE),
    ],
)
def test_a_stop_strikes_in_the_motion_it_was_meant_for_and_the_arm_rests(kind, safety, code):
    machine = machine_of()
    faults = troubled(machine, UrFault.make(kind, motion=1, after_s=0.2))
    turn(machine, faults, 0.5)
    assert machine.modes.running
    aside(machine)
    turn(machine, faults, 0.192)
    assert machine.modes.running
    assert np.abs(machine.reading.true_qd).max() > 0.1
    turn(machine, faults, 0.3)
    assert (machine.modes.safety, machine.modes.stop_code) == (safety, code)
    assert np.abs(machine.reading.true_qd).max() < 0.01


def test_a_safeguard_that_closes_again_lets_a_paused_program_go_on_when_told_to():
    machine = machine_of()
    faults = troubled(machine, UrFault.make("safeguard_stop", at_s=0.1, for_s=0.2))
    machine.play(IdleProgram("work"))
    turn(machine, faults, 0.2)
    assert machine.runtime is RuntimeState.PAUSED
    machine.resume()
    assert machine.runtime is RuntimeState.PAUSED
    turn(machine, faults, 0.3)
    assert (machine.modes.safety, machine.runtime) == (SafetyMode.NORMAL, RuntimeState.PAUSED)
    machine.resume()
    assert machine.runtime is RuntimeState.PLAYING
    assert machine.modes.running


def test_a_safeguard_does_not_end_a_protective_stop():
    machine = machine_of()
    faults = troubled(machine, UrFault.make("safeguard_stop", at_s=0.1, for_s=0.2))
    turn(machine, faults, 0.2)
    machine.protective_stop(158)
    turn(machine, faults, 0.3)
    assert machine.modes.safety is SafetyMode.PROTECTIVE_STOP


def test_stopping_motions_are_not_counted():
    machine = machine_of()
    faults = troubled(machine, UrFault.make("protective_stop", motion=2))
    aside(machine)
    turn(machine, faults, 0.2)
    machine.move(StopJoints(8.0, machine.tick_s))
    turn(machine, faults, 0.5)
    assert machine.modes.running
    aside(machine)
    turn(machine, faults, 0.1)
    assert not machine.modes.running


@pytest.mark.thorough
def test_a_joint_that_grows_warm_is_told_once_and_a_hot_one_stops_the_arm_again_until_it_cools():
    machine, told = machine_of(), []
    machine.listeners.append(told.append)
    machine.body.heat(2, 82.0)
    pass_time(machine, 0.5)
    assert [event.name for event in told] == ["C62A1"]
    assert machine.modes.running
    machine.body.heat(2, 90.0)
    pass_time(machine, 6.0)
    assert machine.modes.unlock()
    pass_time(machine, 0.1)
    assert machine.modes.safety is SafetyMode.PROTECTIVE_STOP
    pass_time(machine, 6.0)
    machine.body.heat(2, 30.0)
    assert machine.modes.unlock()
    pass_time(machine, 0.1)
    assert machine.modes.running


def test_a_collision_is_a_protective_stop_with_the_code_of_its_kind():
    machine = machine_of()
    machine.body.push(np.array([-200.0, 0, 0, 0, 0, 0]))
    pass_time(machine, 1.0)
    assert machine.modes.safety is SafetyMode.PROTECTIVE_STOP
    assert machine.modes.stop_code in (1, 2)
    assert machine.body.braked


def test_a_reboot_starts_the_clock_at_0_without_program_load_or_power():
    machine = machine_of()
    faults = troubled(machine, UrFault.make("reboot", at_s=0.5, for_s=1.0))
    aside(machine)
    machine.body.declare(Payload(2.0))
    machine.write("input_int_register_0", 7)
    turn(machine, faults, 0.496)
    faults.tick()
    assert faults.mock.dark
    assert machine.body.braked
    for _ in range(125):
        assert faults.mock.dark
        faults.tick()
    assert not faults.mock.dark
    assert (machine.ticks, machine.runtime) == (0, RuntimeState.STOPPED)
    assert machine.modes.robot is RobotMode.POWER_OFF
    assert machine.inputs["input_int_register_0"] == 0
    assert machine.outputs["timestamp"] == 0.0
    assert machine.body.declared.is_empty


def test_what_hangs_at_the_flange_still_does_after_a_reboot():
    machine = machine_of()

    def weighs():
        return float(machine.body.simulation.plant.model.body_mass.sum())

    empty = weighs()
    machine.body.declare(Payload(3.0, (0.0, 0.0, 0.1)))
    machine.cut_power()
    machine.boot(powered=True)
    assert machine.outputs["payload"] == 0.0
    assert weighs() == pytest.approx(empty + 3.0)
    machine.body.declare(Payload(1.0))
    assert weighs() == pytest.approx(empty + 1.0)


def test_a_payload_that_is_refused_is_not_read_back_until_the_fault_is_over():
    machine = machine_of()
    faults = troubled(machine, UrFault.make("payload_refused", at_s=0.0, for_s=0.4))
    turn(machine, faults, 0.1)
    machine.body.declare(Payload(1.5))
    turn(machine, faults, 0.1)
    assert machine.outputs["payload"] == 0.0
    turn(machine, faults, 0.4)
    machine.body.declare(Payload(1.5))
    turn(machine, faults, 0.1)
    assert machine.outputs["payload"] == 1.5


def test_inputs_that_somebody_else_owns_are_free_again_afterwards():
    machine, owners = machine_of(), Ownership()
    mine = object()
    owners.take(["speed_slider_mask"], mine)
    faults = troubled(machine, UrFault.make("inputs_owned", at_s=0.0, for_s=0.4), owners=owners)
    turn(machine, faults, 0.1)
    assert not owners.free("input_int_register_0", mine)
    assert owners.free("speed_slider_mask", mine)
    turn(machine, faults, 0.4)
    assert owners.free("input_int_register_0", mine)


def test_ports_are_mute_or_the_cable_is_out_only_as_long_as_said():
    machine = machine_of()
    faults = troubled(
        machine,
        UrFault.make("dashboard_hang", at_s=0.0, for_s=0.2),
        UrFault.make("unplugged", at_s=0.1, for_s=0.2),
        UrFault.make("remote_off", at_s=0.0, for_s=0.2),
    )
    turn(machine, faults, 0.16)
    assert faults.mock.unplugged
    assert faults.mock.mute == {29999}
    assert not machine.modes.remote
    turn(machine, faults, 0.2)
    assert not faults.mock.unplugged
    assert not faults.mock.mute
    assert machine.modes.remote


def test_clear_ends_what_lasts_but_no_reboot():
    machine = machine_of()
    faults = troubled(machine)
    for kind in ("silence", "remote_off", "reboot"):
        faults.add({"kind": kind})
    faults.tick()
    faults.clear()
    assert machine.line.sound
    assert machine.modes.remote
    assert faults.mock.dark
    for _ in range(round(3.0 / machine.tick_s)):
        faults.tick()
    assert not faults.mock.dark
