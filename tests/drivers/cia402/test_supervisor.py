"""All axes through the states of CiA 402 at once, and stopped at once: without a bus."""

from __future__ import annotations

import pytest

from hil_drivers.cia402.axis import BrakeWatch
from hil_drivers.cia402.bus import Emergency, News
from hil_drivers.cia402.supervisor import Phase
from tests.support.cia402_parts import (
    CSP,
    CST,
    ENABLED,
    FAULT,
    FOLLOWS,
    OFF,
    ON,
    PERIOD_S,
    READY,
    Rig,
)

QUICK_STOP = 0x02


def test_enabling_goes_through_all_states_one_by_one() -> None:
    rig = Rig()
    rig.enable()
    assert [drive.status for drive in rig.drives] == [ENABLED] * 3
    assert rig.drives[0].written == [0x00, 0x06, 0x07, 0x0F]


def test_all_axes_are_enabled_at_the_same_time() -> None:
    rig = Rig(6)
    rig.cycles(2)
    rig.supervisor.enable(CSP)
    assert rig.until(Phase.ENABLED) < 15


def test_no_axis_is_let_go_before_all_are_switched_on() -> None:
    rig = Rig()
    rig.drives[2].stuck_at = READY
    rig.supervisor.enable(CSP)
    rig.cycles(100)
    assert [drive.status for drive in rig.drives] == [ON, ON, READY]
    rig.drives[2].stuck_at = 0
    rig.until(Phase.ENABLED)


def test_mode_is_set_and_shown_before_any_axis_leaves_off() -> None:
    rig = Rig()
    rig.drives[1].refuses_mode = True
    rig.supervisor.enable(CSP)
    rig.cycles(100)
    assert rig.phase is Phase.MODE
    assert [drive.status for drive in rig.drives] == [OFF] * 3
    rig.drives[1].refuses_mode = False
    rig.until(Phase.ENABLED)


def test_targets_are_where_the_axes_are_until_they_are_let_go() -> None:
    rig = Rig()
    rig.drives[0].position = -777
    rig.enable()
    assert rig.outputs.target_position == [-777, 2000, 3000]


def test_target_stays_where_the_axis_was_when_it_sags_after_it_was_let_go() -> None:
    rig = Rig()
    rig.cycles(2)
    rig.supervisor.enable(CSP)
    while rig.outputs.controlword[0] != 0x0F:
        rig.cycles()
    rig.drives[0].position = 900
    rig.until(Phase.ENABLED)
    assert rig.outputs.target_position[0] == 1000


def test_refused_mode_names_axis_and_mode_and_leaves_all_off() -> None:
    rig = Rig()
    rig.drives[1].refuses_mode = True
    rig.supervisor.enable(CSP)
    problem = rig.problem(2000)
    assert "axis 2 (node 12): setting the mode took longer than 2 s" in problem
    assert "mode 8 (csp) was requested, 6061h shows 0" in problem
    assert rig.supervisor.overdue
    rig.until(Phase.OFF)
    assert [drive.status for drive in rig.drives] == [OFF] * 3


@pytest.mark.parametrize(
    ("stuck_at", "name"),
    [(OFF, "switch on disabled"), (READY, "ready to switch on"), (ON, "switched on")],
)
def test_axis_that_stays_in_a_state_is_named_with_it(stuck_at: int, name: str) -> None:
    rig = Rig()
    rig.drives[2].stuck_at = stuck_at
    rig.supervisor.enable(CSP)
    problem = rig.problem(2000)
    assert f"axis 3 (node 13): enabling took longer than 5 s: {name}" in problem
    rig.drives[2].stuck_at = 0
    rig.until(Phase.OFF)


def test_fault_that_is_there_is_never_reset_by_enabling() -> None:
    rig = Rig()
    rig.drives[0].status = FAULT
    rig.supervisor.enable(CSP)
    assert "axis 1 (node 11): fault" in rig.problem()
    rig.until(Phase.OFF)
    rig.cycles(50)
    assert rig.drives[0].status == FAULT


def test_faults_are_reset_by_one_rising_edge_when_asked_for() -> None:
    rig = Rig()
    rig.drives[0].status = FAULT
    rig.cycles(5)
    rig.supervisor.reset()
    rig.until(Phase.OFF)
    assert rig.drives[0].status == OFF
    assert rig.drives[0].written.count(0x80) == 1


def test_fault_that_cannot_be_reset_is_told() -> None:
    rig = Rig()
    rig.drives[0].status = FAULT
    rig.drives[0].apply = lambda word, mode: None  # type: ignore[method-assign]
    rig.supervisor.reset()
    assert "axis 1 (node 11): resetting faults took longer than 2 s" in rig.problem(2000)


def test_fault_of_one_axis_quick_stops_all_in_the_same_step() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[1].status = FAULT
    rig.cycles()
    assert rig.outputs.controlword == [QUICK_STOP] * 3


def test_problem_names_the_faulty_axis_its_emergency_and_the_state_of_the_others() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[1].status = FAULT
    rig.cycles(2)
    rig.cyclic.heard = News(emergencies=[Emergency(1, 0x8611, 0x20, bytes(5))])
    problem = rig.problem()
    assert "axis 2 (node 12): fault" in problem
    assert "following error (8611h)" in problem
    assert "axis 1, axis 3: switch on disabled" in problem


def test_problem_is_told_once() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[1].status = FAULT
    assert rig.problem()
    assert rig.problem() == ""


def test_second_axis_that_faults_while_braking_is_in_the_same_message() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[0].status = FAULT
    rig.cycles(3)
    rig.cyclic.heard = News(emergencies=[Emergency(2, 0x2310, 1, bytes(5))])
    problem = rig.problem()
    assert "axis 1 (node 11)" in problem
    assert "axis 3 (node 13): continuous over-current at the output (2310h)" in problem


def test_emergency_stops_all_before_the_statusword_tells() -> None:
    rig = Rig()
    rig.enable()
    rig.cyclic.heard = News(emergencies=[Emergency(0, 0x4310, 8, bytes(5))])
    rig.cycles()
    assert rig.outputs.controlword == [QUICK_STOP] * 3
    assert rig.phase is Phase.BRAKING


def test_emergency_that_says_that_errors_are_gone_stops_nothing() -> None:
    rig = Rig()
    rig.enable()
    rig.cyclic.heard = News(emergencies=[Emergency(0, 0, 0, bytes(5))])
    rig.cycles(5)
    assert rig.phase is Phase.ENABLED


def test_emergency_from_before_explains_a_fault_that_enabling_finds() -> None:
    rig = Rig()
    rig.drives[2].status = FAULT
    rig.cyclic.heard = News(emergencies=[Emergency(2, 0x7305, 1, bytes(5))])
    rig.cycles(3)
    rig.supervisor.enable(CSP)
    assert "encoder 1 (7305h)" in rig.problem()


@pytest.mark.parametrize(
    ("news", "text"),
    [
        (News(booted=[1]), "axis 2 (node 12): has restarted"),
        (News(silent=[1]), "axis 2 (node 12): its heartbeat is overdue"),
        (News(bus_error="bus-off"), "bus-off"),
    ],
)
def test_news_that_end_a_motion(news: News, text: str) -> None:
    rig = Rig()
    rig.enable()
    rig.cyclic.heard = news
    rig.cycles()
    assert rig.outputs.controlword == [QUICK_STOP] * 3
    assert text in rig.problem()


def test_news_stop_nothing_while_all_axes_are_off() -> None:
    rig = Rig()
    rig.cycles(2)
    rig.cyclic.heard = News(booted=[0], silent=[1])
    rig.cycles(50)
    assert rig.phase is Phase.OFF
    assert rig.problem(20) == ""


def test_set_points_that_are_ignored_stop_all() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[0].status &= ~FOLLOWS
    rig.cycles()
    assert rig.outputs.controlword == [QUICK_STOP] * 3
    assert "axis 1 (node 11): ignores set-points (bit 12 low)" in rig.problem()


def test_drive_may_take_a_moment_until_it_follows() -> None:
    rig = Rig()
    rig.drives[1].ignores = True
    rig.supervisor.enable(CSP)
    rig.until(Phase.ENABLED)
    rig.cycles(10)
    rig.drives[1].status |= FOLLOWS
    rig.cycles(100)
    assert rig.phase is Phase.ENABLED


def test_drive_that_never_follows_is_told() -> None:
    rig = Rig()
    rig.drives[1].ignores = True
    rig.supervisor.enable(CSP)
    rig.until(Phase.ENABLED)
    assert "axis 2 (node 12): ignores set-points" in rig.problem()


def test_few_missing_answers_are_let_pass() -> None:
    rig = Rig(late_cycles=3)
    rig.enable()
    rig.drives[0].silent = True
    rig.cycles(3)
    rig.drives[0].silent = False
    rig.cycles(10)
    assert rig.phase is Phase.ENABLED


def test_axis_that_does_not_answer_any_more_stops_all() -> None:
    rig = Rig(late_cycles=3)
    rig.enable()
    rig.drives[0].silent = True
    rig.cycles(4)
    assert rig.outputs.controlword == [QUICK_STOP] * 3
    assert "axis 1 (node 11): has not answered 4 SYNCs in a row" in rig.problem()


def test_no_axis_that_does_not_answer_is_said_to_have_stopped() -> None:
    rig = Rig()
    rig.enable()
    for drive in rig.drives:
        drive.silent = True
    rig.supervisor.quick_stop("bus-off")
    said = rig.problem(20)
    assert said.startswith("bus-off")
    assert "No axis answers" in said
    assert "were stopped" not in said
    assert "operation enabled" not in said


def test_silent_axis_is_told_to_stop_for_a_second() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[0].silent = True
    rig.drives[0].stuck_at = rig.drives[0].status
    rig.cycles(10)
    assert 0.9 < rig.until(Phase.OFF) * PERIOD_S < 1.2


def test_axis_that_leaves_operation_enabled_on_its_own_stops_all() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[2].status = rig.drives[2].stuck_at = ON
    rig.cycles()
    assert rig.outputs.controlword == [QUICK_STOP] * 3
    assert "axis 3 (node 13): has left operation enabled: switched on" in rig.problem()


def test_axis_that_leaves_its_mode_on_its_own_stops_all() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[2].refuses_mode = True
    rig.cycles(2)
    assert "axis 3 (node 13): has left mode 8 (csp)" in rig.problem()


def test_quick_stop_waits_until_every_axis_is_off() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[1].braking = 20
    rig.supervisor.quick_stop()
    rig.cycles(15)
    assert rig.phase is Phase.BRAKING
    assert rig.outputs.controlword == [QUICK_STOP] * 3
    rig.until(Phase.OFF)
    assert rig.problem(30) == ""


def test_quick_stop_says_why_when_it_has_a_reason() -> None:
    rig = Rig()
    rig.enable()
    rig.supervisor.quick_stop("records were not taken")
    assert rig.problem().startswith("records were not taken. All axes were stopped")


@pytest.mark.parametrize("cycles", range(1, 12))
def test_quick_stop_while_enabling_ends_with_all_axes_off(cycles: int) -> None:
    rig = Rig()
    rig.cycles(2)
    rig.supervisor.enable(CSP)
    rig.cycles(cycles)
    rig.supervisor.quick_stop()
    rig.until(Phase.OFF)
    rig.cycles(5)
    assert [drive.status for drive in rig.drives] == [OFF] * 3
    assert rig.problem(30) == ""


def test_disabling_goes_down_one_state_at_a_time() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[0].written.clear()
    rig.supervisor.disable()
    rig.until(Phase.OFF)
    assert rig.drives[0].written == [0x0F, 0x07, 0x06, 0x00]


def test_axis_that_cannot_be_switched_off_is_named() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[1].stuck_at = ENABLED
    rig.supervisor.disable()
    assert "axis 2 (node 12): switching off took longer than 5 s" in rig.problem(2000)


def test_mode_switch_preloads_what_is_measured_and_waits_for_every_axis() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[0].torque = 123
    rig.cycles(2)
    rig.supervisor.switch(CST)
    assert rig.outputs.target_torque == [123, 0, 0]
    assert rig.outputs.target_position == [1000, 2000, 3000]
    assert rig.phase is Phase.SWITCHING
    rig.until(Phase.ENABLED)
    assert [drive.mode for drive in rig.drives] == [CST] * 3


def test_switch_back_to_positions_holds_where_the_axes_are_now() -> None:
    rig = Rig()
    rig.enable(CST)
    rig.drives[0].position = 1234
    rig.cycles(2)
    rig.supervisor.switch(CSP)
    rig.until(Phase.ENABLED)
    assert rig.outputs.target_position == [1234, 2000, 3000]


def test_refused_mode_switch_stops_all_and_names_the_axis() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[1].apply = lambda word, mode: None  # type: ignore[method-assign]
    rig.supervisor.switch(CST)
    problem = rig.problem(2000)
    assert "axis 2 (node 12): switching the mode took longer than 1 s" in problem
    assert "mode 10 (cst) was requested, 6061h shows 8 (csp)" in problem


def test_without_mode_in_the_process_data_it_is_not_waited_for() -> None:
    rig = Rig(mode_mapped=False)
    for drive in rig.drives:
        drive.refuses_mode = True
    rig.enable()
    rig.cycles(100)
    assert rig.phase is Phase.ENABLED


def test_fault_code_is_that_of_the_first_faulty_axis_until_it_is_gone() -> None:
    rig = Rig()
    rig.enable()
    rig.cyclic.heard = News(emergencies=[Emergency(1, 0x8611, 0, bytes(5))])
    rig.drives[1].status = FAULT
    rig.cycles()
    assert rig.supervisor.fault_code == 0x8611
    rig.until(Phase.OFF)
    rig.supervisor.reset()
    rig.cycles(10)
    assert rig.supervisor.fault_code == 0


def test_axes_are_called_by_their_names() -> None:
    rig = Rig(names=("base", "shoulder", "elbow"))
    rig.enable()
    rig.drives[1].status = FAULT
    assert "shoulder (node 12): fault" in rig.problem()


def braking_rig() -> Rig:
    """Axes that stop within 0.3 s, of 1 µrad per increment."""
    return Rig(braking=BrakeWatch(PERIOD_S, [-1e-6] * 3, [0.3] * 3))


def test_axis_that_does_not_slow_down_in_a_quick_stop_is_taken_the_voltage_from() -> None:
    rig = braking_rig()
    rig.enable()
    rig.drives[1].braking = 10_000
    rig.supervisor.quick_stop("stopped")
    at, words = 0, []
    while rig.phase is Phase.BRAKING and at < 1000:
        rig.drives[1].position += 2000  # 0.5 rad/s
        rig.cycles()
        words.append(rig.outputs.controlword.copy())
        at += 1
    first = next(k for k, told in enumerate(words) if told[1] == 0x00)
    assert 0.5 <= first * PERIOD_S < 0.6
    assert words[first][0] == words[first - 1][1] == QUICK_STOP
    assert "axis 2 (node 12): still moves at 0.50 rad/s 0.5 s after" in rig.problem()


def test_axis_that_slows_down_as_it_should_is_left_alone() -> None:
    rig = braking_rig()
    rig.enable()
    for drive in rig.drives:
        drive.braking = 90
    rig.supervisor.quick_stop()
    for cycle in range(90):
        rig.drives[1].position += max(4000 - 60 * cycle, 0)
        rig.cycles()
        assert rig.outputs.controlword[1] == QUICK_STOP or cycle > 88
    rig.until(Phase.OFF)
    assert rig.problem(30) == ""


def test_axis_that_stays_in_quick_stop_is_switched_off() -> None:
    rig = braking_rig()
    rig.enable()
    rig.drives[0].braking = 10_000
    rig.supervisor.quick_stop()
    rig.cycles(320)
    assert rig.outputs.controlword[0] == QUICK_STOP
    rig.cycles(10)
    assert rig.outputs.controlword[0] == 0x00
    assert "axis 1 (node 11): is still on 1.3 s after a quick stop" in rig.problem()


def test_axis_that_ignores_a_quick_stop_is_not_told_to_be_switched_on_afterwards() -> None:
    rig = braking_rig()
    rig.enable()
    rig.drives[2].stuck_at = ENABLED
    rig.supervisor.quick_stop()
    rig.until(Phase.OFF)
    rig.cycles(5)
    assert rig.outputs.controlword[2] == 0x00


def test_an_axis_that_does_not_say_so_is_not_said_to_have_stopped() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[1].silent = True
    said = rig.problem()
    assert said.startswith("axis 2 (node 12): has not answered")
    assert "A stop was sent to all axes; axis 1, axis 3: " in said
    assert said.endswith("; axis 2: stop not confirmed")
    assert "were stopped" not in said


def test_an_axis_that_answers_and_stays_enabled_is_not_said_to_have_stopped() -> None:
    rig = Rig()
    rig.enable()
    rig.drives[0].stuck_at = rig.drives[0].status
    rig.supervisor.quick_stop("records were not taken")
    assert rig.problem(20).endswith("axis 1: stop not confirmed")
