"""How the mock controller's time passes."""

import json

import pytest

from hil_mock_robot.server.journal import Journal, read_journal
from hil_mock_robot.ur import pacing
from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.journal import Witness
from hil_mock_robot.ur.side import SideService
from tests.support.ur_machine import Wire, machine_of


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(pacing.time, "monotonic", lambda: now[0])
    return now


def test_a_late_tick_is_caught_up_at_twice_the_pace_so_that_no_two_packages_wait_together(clock):
    pacer = pacing.RealTime(0.002)
    clock[0] += 0.005  # nobody gave us the processor
    made = []
    for _ in range(8):
        clock[0] += pacer.wait_s()
        made.append(clock[0] - 100.0)
        pacer.ticked()
    assert made == pytest.approx([0.005, 0.006, 0.007, 0.008, 0.009, 0.010, 0.012, 0.014])


def test_what_was_missed_for_long_is_not_raced_after(clock):
    pacer = pacing.RealTime(0.002)
    clock[0] += 1.0
    pacer.ticked()
    assert pacer.behind_s == pytest.approx(0.998)
    assert pacer.wait_s() == pytest.approx(0.001)


def busy(pacer, clock, seconds):
    """Let each tick of 0.1 s take 0.2 s of the wall clock, for so long."""
    until = clock[0] + seconds
    while clock[0] < until:
        clock[0] += max(pacer.wait_s(), 0.2)
        pacer.ticked()


def test_the_pace_is_the_share_of_device_time_that_passed(clock):
    pacer = pacing.RealTime(0.1)
    busy(pacer, clock, 20.0)
    assert pacer.pace == pytest.approx(0.5, abs=0.05)
    assert pacer.behind_s == pytest.approx(10.0, abs=0.5)


def test_the_pace_is_one_again_ten_seconds_later(clock):
    pacer = pacing.RealTime(0.1)
    busy(pacer, clock, 20.0)
    clock[0] += pacing.OVER_S + 0.1
    assert pacer.pace == 1.0


def test_a_mock_that_falls_behind_says_so_once_a_minute(clock):
    pacer, said = pacing.RealTime(0.1), []
    pacer.listeners.append(pacing.SlipWarning(said.append).slipped)
    busy(pacer, clock, 150.0)
    assert len(said) == 3
    assert "behind the wall clock" in said[0]
    assert "not protocol errors" in said[0]


def test_a_single_hiccup_is_not_worth_a_line(clock):
    pacer, said = pacing.RealTime(0.1), []
    pacer.listeners.append(pacing.SlipWarning(said.append).slipped)
    for _ in range(200):
        clock[0] += pacer.wait_s()
        pacer.ticked()
    busy(pacer, clock, 0.1)
    assert said == []


def test_a_slip_is_a_line_of_the_journal(clock, tmp_path):
    journal = Journal(str(tmp_path / "journal"), "ur5")
    journal.open()
    pacer = pacing.RealTime(0.1)
    pacer.listeners.append(Witness(machine_of(), journal).slipped)
    clock[0] += 1.0
    pacer.ticked()
    (line,) = read_journal(tmp_path / "journal")
    assert (line["event"], line["behind_s"], line["pace"]) == ("slip", 0.9, 0.91)


def test_the_side_channel_says_how_far_the_mock_is_behind(clock):
    machine, wire, pacer = machine_of(), Wire(), pacing.RealTime(0.1)
    session = SideService(1, machine, UrFaults(machine), pacer).accept(wire)
    busy(pacer, clock, 20.0)
    session.received(b'{"do": "state"}\n')
    state = json.loads(bytes(wire.sent))
    assert state["behind_s"] == pytest.approx(10.0, abs=0.5)
    assert state["pace"] == pytest.approx(0.5, abs=0.05)


def test_a_mock_that_has_no_pace_to_keep_is_never_behind():
    machine, wire = machine_of(), Wire()
    session = SideService(1, machine, UrFaults(machine), pacing.FreeRun()).accept(wire)
    session.received(b'{"do": "state"}\n')
    state = json.loads(bytes(wire.sent))
    assert (state["behind_s"], state["pace"]) == (None, None)
