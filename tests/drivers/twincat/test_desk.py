"""The TwinCAT driver against the mock's program in this process, and the PC's heartbeat."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import (
    CommandRefused,
    HilError,
    PluginError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
)
from hil_drivers.twincat import controller
from hil_drivers.twincat.controller import Beat
from hil_drivers.twincat.robot import TwinCatRobot
from hil_mock_robot.twincat.program import Phase
from tests.support.in_time import InTime
from tests.support.plc_desk import Desk, desk_robot, line_to, little_move, on_the_desk


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    with on_the_desk(monkeypatch) as made:
        yield made


@pytest.fixture
def robot(desk: Desk) -> Iterator[TwinCatRobot]:
    made = desk_robot()
    made.connect()
    yield made
    desk.silent = desk.stands = desk.handler.loses_stops = False
    made.close()


def played_to_the_end(robot, within=400):
    rows = [robot.read() for _ in range(within)]
    return np.concatenate(rows)


def test_a_motion_is_played_as_it_was_planned(robot):
    segment = little_move()
    robot.prepare(segment)
    robot.start()
    rows = played_to_the_end(robot, 40)
    played = rows[(rows["status"] & 1) != 0]
    assert np.array_equal(played["q_target"], segment.q)


# An online change: everything lies elsewhere.


def after_an_online_change(robot, desk):
    robot.prepare(little_move())
    robot.start()
    desk.program.listeners.clear()
    before = bytes(desk.memory.bytes)
    desk.stands = True
    desk.memory.online_change()
    return before


def test_after_an_online_change_reading_ends_and_so_does_the_heartbeat(robot, desk):
    after_an_online_change(robot, desk)
    with pytest.raises(RobotFault, match="changed online") as told:
        robot.read()
    assert "connect again" in told.value.hint
    assert not robot._controller.beat.alive
    with pytest.raises(RobotFault, match="accepts no commands since a fault"):
        robot.prepare(little_move())


@pytest.mark.parametrize("act", ["prepare", "start", "payload", "stop", "close"])
def test_after_an_online_change_nothing_is_written_to_where_variables_were(robot, desk, act):
    robot.prepare(little_move())
    desk.stands = True
    desk.memory.online_change()
    before = bytes(desk.memory.bytes)
    robot._healthy = lambda: robot._controller
    acts = {
        "prepare": lambda: robot.prepare(little_move()),
        "start": robot.start,
        "payload": lambda: robot.set_payload(Payload(1.0)),
        "stop": robot.stop,
    }
    if act == "close":
        robot.close()
    else:
        with pytest.raises((RobotFault, RobotConnectionError), match="changed online"):
            acts[act]()
    assert bytes(desk.memory.bytes) == before


def test_a_beat_after_an_online_change_is_refused_and_the_last_one(robot, desk):
    desk.stands = True
    desk.memory.online_change()
    before = bytes(desk.memory.bytes)
    until = time.monotonic() + 2.0
    while robot._controller.beat.alive and time.monotonic() < until:
        time.sleep(0.01)
    assert not robot._controller.beat.alive
    assert isinstance(robot._controller.beat.problem, RobotFault)
    assert bytes(desk.memory.bytes) == before


def test_an_upload_during_which_the_program_is_changed_ends_with_that_chunk(desk):
    robot = desk_robot(chunk_bytes=1440)
    robot.connect()
    line, chunks = robot._controller._main, []
    write = line.write

    def changing(place, data, start=0):
        chunks.append(len(data))
        write(place, data, start)
        if len(chunks) == 3:
            desk.memory.online_change()

    line.write = changing
    with pytest.raises(RobotFault, match="changed online"):
        robot.prepare(little_move())
    assert len(chunks) == 3
    assert not robot._controller.beat.alive
    robot.close()


def test_after_an_online_change_a_new_connection_finds_everything(robot, desk):
    desk.memory.online_change()
    with pytest.raises(RobotFault):
        robot.read()
    desk.memory.view("stState")[0]["nSession"] = 0  # as the watchdog does
    robot.connect()
    robot.prepare(little_move())
    robot.start()
    assert len(played_to_the_end(robot, 40))


# A stop that the program does not see.


def test_a_stop_that_the_program_does_not_see_ends_the_heartbeat_and_is_an_error(robot, desk):
    desk.handler.loses_stops = True
    own = InTime()
    with pytest.raises(RobotConnectionError, match="did not confirm the stop") as told:
        robot.stop()
    took = own.taken()
    assert "shows stop number 0, not 1" in told.value.message
    assert not robot._controller.beat.alive
    took.require(0.15)


def test_a_stop_that_cannot_be_written_ends_the_heartbeat(robot, desk):
    desk.silent = True
    with pytest.raises(RobotConnectionError, match="did not confirm the stop"):
        robot.stop()
    assert not robot._controller.beat.alive


def test_a_stop_that_is_seen_keeps_the_heartbeat(robot, desk):
    robot.stop()
    robot.stop()
    assert robot._controller.beat.alive
    assert len(desk.told("stop")) == 2


def test_threads_that_stop_at_once_all_do(robot, desk):
    robot.prepare(little_move(n=4000))
    robot.start()
    with ThreadPoolExecutor(4) as several:
        done = [several.submit(robot.stop) for _ in range(4)]
    assert [each.exception() for each in done] == [None] * 4
    assert robot._controller.beat.alive
    assert desk.told("stop")[0] == {"moving": True}


# Set-points that were checked are those that are played.


def test_what_is_written_over_checked_set_points_is_not_played(robot, desk):
    segment = little_move()
    robot.prepare(segment)
    desk.memory.view("aSetPoints")["aQ"][:] = 2.0
    robot.start()
    rows = played_to_the_end(robot, 40)
    assert np.array_equal(rows[(rows["status"] & 1) != 0]["q_target"], segment.q)


# Commands without an answer.


@pytest.mark.parametrize("order", ["start", "payload", "prepare"])
def test_a_command_without_an_answer_is_followed_by_a_stop(robot, desk, order, monkeypatch):
    monkeypatch.setattr(controller, "LOAD_S", 0.05)
    monkeypatch.setattr(controller.Orders.give, "__defaults__", (0.05,))
    robot.prepare(little_move())
    look, desk.program.commands.look = desk.program.commands.look, lambda: None
    acts = {
        "start": robot.start,
        "payload": lambda: robot.set_payload(Payload(1.0)),
        "prepare": lambda: robot.prepare(little_move()),
    }
    with pytest.raises(RobotTimeout, match="has not answered"):
        acts[order]()
    assert len(desk.told("stop")) == 1
    desk.program.commands.look = look  # now it does what it was told
    desk.program.cycles(5)
    assert desk.program.phase == Phase.HOLDING
    with pytest.raises(RobotFault, match="accepts no commands since a fault"):
        robot.prepare(little_move())


def test_another_clients_command_is_not_taken_for_ours(robot, desk):
    command = desk.memory.view("stCommand")[0]
    write = robot._controller.variables.command

    def overwritten(data):
        write(data)
        answer = desk.memory.view("stAnswer")[0]
        answer["nSession"], answer["nResult"] = 7, 0
        assert answer["nCounter"] == command["nCounter"]

    robot._controller.orders._write = overwritten
    with pytest.raises(RobotTimeout):
        robot._controller.orders.give(controller.Order.HOLD, "hold", 0.05, nStop=0)
    robot._controller.orders._write = write


@pytest.mark.parametrize("field", ["nSession", "nCommand", "nCounter", "nCounterEnd"])
def test_an_answer_that_is_not_to_our_command_is_none(robot, desk, field):
    look = desk.program.commands.look

    def spoilt():
        look()
        desk.memory.view("stAnswer")[0][field] = 3

    desk.program.commands.look = spoilt
    with pytest.raises(RobotTimeout, match="has not answered"):
        robot._controller.orders.give(controller.Order.HOLD, "hold", 0.05, nStop=0)
    desk.program.commands.look = look


def test_commands_are_counted_from_a_random_number_on(desk):
    begun = set()
    for _ in range(3):
        robot = desk_robot()
        robot.connect()
        begun.add(int(desk.memory.view("stCommand")[0]["nCounter"]))
        robot.close()
    assert len(begun) == 3


# Somebody else stops.


def test_a_stop_of_somebody_else_does_not_keep_us_from_starting_ever_after(robot, desk):
    desk.memory.view("nStop")[0] += 5
    robot.read()
    robot.prepare(little_move())
    robot.start()
    assert desk.program.phase == Phase.PLAYING


def test_a_stop_of_somebody_else_after_prepare_refuses_the_start_and_says_so(robot, desk):
    robot.prepare(little_move())
    desk.memory.view("nStop")[0] += 5
    with pytest.raises(CommandRefused, match="the arm was stopped meanwhile") as told:
        robot.start()
    assert "nStop" in told.value.hint


def test_our_stop_is_one_also_where_somebody_else_has_counted_on(robot, desk):
    desk.memory.view("nStop")[0] += 1
    robot.read()
    robot.prepare(little_move())
    robot.start()
    robot.stop()
    assert desk.program.phase in (Phase.STOPPING, Phase.HOLDING)
    assert desk.told("stop")[-1] == {"moving": True}


# Checks at connect, and what is asked for while the arm moves.


def test_a_runtime_that_does_not_run_is_told(desk):
    desk.handler.state = 6
    with pytest.raises(RobotConnectionError, match="its runtime is in state STOP"):
        desk_robot().connect()


def test_a_variable_of_another_size_is_told(desk):
    from dataclasses import replace

    symbols = desk.memory.symbols
    name = "gvl_hil.ststate"
    symbols[name] = replace(symbols[name], size=symbols[name].size + 8)
    with pytest.raises(PluginError, match="stState has 112 bytes, the contract requires 104"):
        desk_robot().connect()


def test_an_array_of_another_length_than_it_says_is_told(desk):
    desk.memory.view("stInfo")[0]["nRingRows"] += 1
    with pytest.raises(PluginError, match=r"aRing has \d+ bytes, stInfo reports 16385 rows"):
        desk_robot().connect()


def test_nothing_is_uploaded_while_the_arm_moves(robot, desk):
    robot.prepare(little_move(n=4000))
    robot.start()
    writes = len(desk.writes)
    with pytest.raises(CommandRefused, match="still moving"):
        robot.prepare(little_move())
    assert all(len(data) < 100 for _, _, data in desk.writes[writes:])


def test_set_points_that_the_plc_reads_back_otherwise_are_refused(robot, desk):
    look = desk.program.commands.look

    def spoilt():
        look()
        desk.memory.view("stAnswer")[0]["nSumB"] += 1

    desk.program.commands.look = spoilt
    with pytest.raises(CommandRefused, match="the set-points read back from the PLC differ"):
        robot.prepare(little_move())


def test_without_a_heartbeat_nothing_is_prepared_and_the_reason_is_told(robot, desk):
    beat = robot._controller.beat
    beat.end()
    beat.problem = RobotConnectionError("the cable is out")
    with pytest.raises(RobotConnectionError, match="heartbeat any more: the cable is out"):
        robot.prepare(little_move())


def test_a_stop_forgets_what_was_loaded(robot, desk):
    robot.prepare(little_move())
    robot.stop()
    answer = robot._controller.orders
    with pytest.raises(CommandRefused, match="no set-points are loaded"):
        answer.give(controller.Order.START, "start", nSegment=1, nStop=1)


def test_a_silent_plc_is_waited_for_no_longer_than_asked(robot, desk):
    desk.timeouts.clear()
    robot.read(0.05)
    assert desk.timeouts[0] == 50
    assert desk.timeouts[-1] == 1000


def test_after_a_fault_the_set_point_begins_where_the_joints_are(desk):
    robot = desk_robot()
    robot.connect()
    desk.arm.sags_rad = 0.02
    desk.program.fail(3, "drive")
    with pytest.raises(RobotFault, match="fault 3: drive"):
        played_to_the_end(robot, 5)
    robot.connect()
    row = robot.read()[-1]
    assert row["q_target"] == pytest.approx(row["q"])
    assert row["q_target"][0] == pytest.approx(-0.02)
    robot.close()


def test_the_net_id_of_this_computer_can_be_chosen(desk):
    robot = desk_robot(local_net_id="192.168.10.9.3.1")
    robot.connect()
    robot.close()
    assert set(desk.local) == {"192.168.10.9.3.1"}


# Return codes.


CODES = (
    (0x6, RobotConnectionError, "no PLC runtime answers"),
    (0x7, RobotConnectionError, "there is no route"),
    (0x708, RobotTimeout, "is busy"),
    (0x710, RobotFault, "changed online"),
    (0x711, RobotFault, "changed online"),
    (0x712, RobotConnectionError, "its runtime does not answer"),
    (0x719, RobotTimeout, "reports an internal time-out"),
    (0x705, CommandRefused, "read 1 bytes"),
)


@pytest.mark.parametrize(("code", "kind", "said"), CODES, ids=[hex(each[0]) for each in CODES])
def test_a_return_code_is_told_in_words(desk, code, kind, said):
    line = line_to()
    desk.codes = [(0xF008, code)]
    with pytest.raises(kind, match=said) as told:
        line.version()
    assert told.value.hint


def test_a_name_that_is_none_is_a_variable_that_is_missing(desk):
    with pytest.raises(PluginError, match=r"has no variable GVL_Hil\.nNone"):
        line_to().place("GVL_Hil.nNone")


def test_a_part_of_a_request_that_fails_is_an_error(desk):
    line = line_to()
    place = line.place("GVL_Hil.stState")
    with pytest.raises(CommandRefused, match="0x703"):
        line.read_versioned(place, 10**8, 200)


# The PC's heartbeat: what ends it, and what does not.


def beaten(*problems: HilError | None, wanted: int) -> tuple[Beat, list[int]]:
    """A beat whose writes fail in turn with these; it is ended after so many of them, or 10 s."""
    counts, enough, left = [], threading.Event(), list(problems)

    def write(session: int, count: int) -> None:
        counts.append(count)
        if len(counts) >= wanted:
            enough.set()
        if left and (problem := left.pop(0)) is not None:
            raise problem

    beat = Beat(write, 7)
    beat.start()
    assert enough.wait(10.0)
    time.sleep(0.01)
    return beat, counts


def test_every_beat_has_another_count() -> None:
    beat, counts = beaten(wanted=3)
    assert beat.alive
    beat.end()
    assert counts[:3] == [1, 2, 3]
    assert not beat.alive


def test_a_beat_without_an_answer_is_followed_by_the_next() -> None:
    late = RobotTimeout("the PLC is busy")
    beat, counts = beaten(late, wanted=2)
    assert beat.alive
    assert beat.problem is late
    beat.end()
    assert len(counts) >= 2


def test_a_lost_connection_ends_the_heartbeat_and_is_kept_as_the_reason() -> None:
    lost = RobotConnectionError("the cable is out")
    beat, counts = beaten(None, lost, wanted=2)
    beat._thread.join(10.0)
    assert not beat.alive
    assert beat.problem is lost
    assert len(counts) == 2


def test_a_hushed_heartbeat_writes_nothing_more() -> None:
    beat, counts = beaten(wanted=1)
    beat.silence()
    beat._thread.join(10.0)
    told = len(counts)
    assert not beat.alive
    time.sleep(0.06)
    assert len(counts) == told
