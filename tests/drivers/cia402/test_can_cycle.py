"""Cycles over CAN, on ports that play a script: answers, late answers, other masters."""

from __future__ import annotations

import itertools
import struct
import threading
import time
from collections import deque
from collections.abc import Iterable

import can
import numpy as np
import pytest

from hil.can.frames import (
    ERROR,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    TX_OVERFLOW,
    pack_frame,
    unpack_frame,
)
from hil.core.errors import RobotConnectionError
from hil_drivers.cia402.bus import Inputs, News, Outputs
from hil_drivers.cia402.can_bus import CanBus
from hil_drivers.cia402.can_channel import PythonCanPort
from hil_drivers.cia402.can_cycle import (
    CONFIRMED,
    CanCyclic,
    quick_stop_frames,
    require_no_master,
    stop_directly,
)
from hil_drivers.cia402.mapping import ALL_MODES, MINIMAL, POSITION
from hil_drivers.cia402.options import Options, options_of
from hil_drivers.cia402.supervisor import Judge

NODES = (3, 7)
PERIOD_S = 0.004
SOON_S = 0.004


class ScriptedPort:
    """What comes back to the k-th SYNC is told beforehand.

    Attributes:
        sent: All frames.
        answers: Per SYNC, frames that come after it.
        between: Frames that are there before the next SYNC.
        room: Frames that the transmit queue still takes.
    """

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.answers: deque[list[bytes]] = deque()
        self.between: deque[bytes] = deque()
        self.room = 10**9

    def send(self, frame: bytes | memoryview) -> bool:
        if self.room <= 0:
            return False
        self.room -= 1
        self.sent.append(bytes(frame))
        if unpack_frame(bytes(frame)).id == 0x080:
            self.between.extend(self.answers.popleft() if self.answers else [])
        return True

    def receive(self, until_s: float) -> bytes | None:
        return self.between.popleft() if self.between else None

    def wait(self, until_s: float) -> bool:
        return bool(self.between)

    def ids(self) -> list[int]:
        return [unpack_frame(raw).id for raw in self.sent]


def tpdo1(node: int, position: int, status: int = 0x1237) -> bytes:
    return pack_frame(0x180 + node, struct.pack("<Hib", status, position, 8))


def tpdo2(node: int, velocity: int = 0) -> bytes:
    return pack_frame(0x280 + node, struct.pack("<ihh", velocity, 20, 30))


def all_answers(position: int) -> list[bytes]:
    return [make(node, position) for make in (tpdo1, tpdo2) for node in NODES]


class Cycles:
    """An exchange over a scripted port."""

    def __init__(self, mapping: object = POSITION, **options: object) -> None:
        self.port, self.outputs = ScriptedPort(), Outputs.idle(len(NODES))
        self.notified: list[tuple[int, bytes]] = []
        self.cyclic = CanCyclic(
            self.port,
            mapping,  # type: ignore[arg-type]
            NODES,
            PERIOD_S,
            notify=lambda can_id, data, time_s: self.notified.append((can_id, data)),
            **options,  # type: ignore[arg-type]
        )

    def cycle(self, answers: Iterable[bytes]) -> Inputs:
        """One exchange with these answers to its SYNC."""
        self.port.answers.append(list(answers))
        return self.cyclic.exchange(self.outputs, time.monotonic() + SOON_S)

    def idle(self, *frames: bytes) -> None:
        """These come between two cycles."""
        self.port.between.extend(frames)
        self.cyclic.idle(0.0)

    def news(self) -> News:
        return self.cyclic.news() or News()


def test_sync_goes_before_the_commands_in_the_order_of_the_axes() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(0))
    cycles.port.sent.clear()
    cycles.cycle(all_answers(0))
    assert cycles.port.ids() == [0x080, 0x203, 0x207]


def test_commands_are_packed_as_mapped() -> None:
    cycles = Cycles()
    cycles.outputs.controlword[:] = [0x0F, 0x06]
    cycles.outputs.mode[:] = [8, 9]
    cycles.outputs.target_position[:] = [-5, 70_000]
    cycles.cycle(all_answers(0))
    frames = [unpack_frame(raw) for raw in cycles.port.sent[-3:-1]]
    assert frames[0].data == struct.pack("<Hbi", 0x0F, 8, -5)
    assert frames[1].data == struct.pack("<Hbi", 0x06, 9, 70_000)


def test_second_command_pdo_carries_velocity_torque_and_offset() -> None:
    cycles = Cycles(ALL_MODES)
    cycles.outputs.target_velocity[:] = [1, 2]
    cycles.outputs.target_torque[:] = [3, 4]
    cycles.outputs.torque_offset[:] = [5, -6]
    cycles.cycle(all_answers(0))
    last = {unpack_frame(raw).id: unpack_frame(raw).data for raw in cycles.port.sent}
    assert last[0x307] == struct.pack("<ihh", 2, 4, -6)


def test_answers_are_unpacked_by_axis() -> None:
    cycles = Cycles()
    inputs = cycles.cycle([tpdo2(7, -9), tpdo1(7, -200), tpdo1(3, 100, 0x0250), tpdo2(3, 8)])
    assert inputs.position == [100, -200]
    assert inputs.statusword == [0x0250, 0x1237]
    assert inputs.velocity == [8, -9]
    assert (inputs.mode_display, inputs.torque, inputs.current) == ([8, 8], [20, 20], [30, 30])
    assert inputs.fresh == [True, True]


def test_mapping_without_mode_leaves_it_zero() -> None:
    cycles = Cycles(MINIMAL)
    answers = [pack_frame(0x180 + n, struct.pack("<Hi", 0x1237, 5)) for n in NODES]
    inputs = cycles.cycle(answers)
    assert inputs.position == [5, 5]
    assert inputs.mode_display == [0, 0]
    assert inputs.fresh == [True, True]


def test_raw_bytes_of_both_directions_are_kept_for_the_record() -> None:
    cycles = Cycles()
    cycles.outputs.target_position[:] = [1, -2]
    cycles.cycle(all_answers(77))
    assert cycles.cyclic.sent.shape == (1, 2, 8)
    assert cycles.cyclic.sent[0, 1, 3:7].tobytes() == struct.pack("<i", -2)
    assert cycles.cyclic.answered.shape == (2, 2, 8)
    assert cycles.cyclic.answered[0, 0, 2:6].tobytes() == struct.pack("<i", 77)


def test_cycles_are_numbered_and_timed_by_their_sync() -> None:
    cycles = Cycles()
    assert cycles.cyclic.cycle == -1
    before = time.time()
    cycles.cycle(all_answers(0))
    assert cycles.cyclic.cycle == 0
    assert before <= cycles.cyclic.sync_time <= time.time()


def test_marker_goes_right_before_the_sync_when_it_changes_and_only_then() -> None:
    cycles = Cycles(master_id=120)
    cycles.cycle(all_answers(0))
    assert cycles.port.ids()[:2] == [0x180 + 120, 0x080]
    cycles.outputs.segment, cycles.outputs.status = 4, 1
    cycles.port.sent.clear()
    cycles.cycle(all_answers(0))
    assert unpack_frame(cycles.port.sent[0]).data == struct.pack("<iH", 4, 1)
    assert cycles.port.ids()[1] == 0x080
    cycles.port.sent.clear()
    cycles.cycle(all_answers(0))
    assert 0x180 + 120 not in cycles.port.ids()


def test_master_heartbeat_goes_every_50_ms_of_device_time() -> None:
    cycles = Cycles()
    for _ in range(100):
        cycles.cycle(all_answers(0))
    beats = [unpack_frame(raw) for raw in cycles.port.sent if unpack_frame(raw).id == 0x77F]
    assert len(beats) == pytest.approx(100 * PERIOD_S / 0.05, abs=1)
    assert beats[0].data == b"\x05"


def test_missing_answer_leaves_the_axis_stale_with_its_old_values() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(10))
    inputs = cycles.cycle([tpdo1(3, 20), tpdo2(3), tpdo2(7)])
    assert inputs.fresh == [True, False]
    assert inputs.position == [20, 10]
    assert cycles.cyclic.counts.missing == 1


def test_lost_answer_does_not_hurt_the_next_cycle() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(10))
    cycles.cycle(all_answers(20)[:3])
    inputs = cycles.cycle(all_answers(30))
    assert inputs.fresh == [True, True]
    assert inputs.position == [30, 30]
    assert (cycles.cyclic.counts.missing, cycles.cyclic.counts.late) == (1, 0)


def test_answer_before_the_next_sync_is_counted_late_and_not_used() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(10))
    cycles.cycle([tpdo1(3, 20), tpdo2(3), tpdo2(7)])
    cycles.idle(tpdo1(7, 20))
    inputs = cycles.cycle(all_answers(30))
    assert inputs.position == [30, 30]
    assert (cycles.cyclic.counts.missing, cycles.cyclic.counts.late) == (1, 1)


def test_answer_after_the_next_sync_is_that_of_the_cycle_before() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(10))
    cycles.cycle([tpdo1(3, 20), tpdo2(3), tpdo2(7)])
    inputs = cycles.cycle([tpdo1(7, 20), *all_answers(30)])
    assert inputs.position == [30, 30]
    assert inputs.fresh == [True, True]
    assert cycles.cyclic.counts.late == 1


def test_answers_of_several_cycles_that_come_at_once_are_sorted_out() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(10))
    for _ in range(3):
        assert cycles.cycle([]).fresh == [False, False]
    inputs = cycles.cycle([*all_answers(20), *all_answers(30), *all_answers(40), *all_answers(50)])
    assert inputs.position == [50, 50]
    assert inputs.fresh == [True, True]
    assert (cycles.cyclic.counts.missing, cycles.cyclic.counts.late) == (12, 12)


def test_after_nobody_has_answered_single_answers_are_those_of_the_cycle_before() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(10))
    cycles.cycle([])
    inputs = cycles.cycle(all_answers(20))
    assert inputs.fresh == [False, False]
    assert inputs.position == [10, 10]
    cycles.idle(*all_answers(30))
    assert cycles.cycle(all_answers(40)).position == [40, 40]
    assert cycles.cyclic.counts.late == 8


def test_a_cycle_that_nobody_has_seen_costs_one_more_and_no_further() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(10))
    cycles.cycle([])
    cycles.cycle(all_answers(20))
    cycles.idle()
    inputs = cycles.cycle(all_answers(30))
    assert inputs.fresh == [True, True]
    assert inputs.position == [30, 30]


def test_answer_that_comes_twice_is_counted_and_the_newest_is_used() -> None:
    cycles = Cycles()
    inputs = cycles.cycle([tpdo1(3, 1), tpdo1(3, 2), *all_answers(3)[1:]])
    assert inputs.position[0] == 2
    assert cycles.cyclic.counts.doubled == 1


def test_answer_of_another_length_is_malformed_and_missing() -> None:
    cycles = Cycles()
    short = pack_frame(0x183, b"\x37\x12\x00")
    inputs = cycles.cycle([short, *all_answers(5)[1:]])
    assert inputs.fresh == [False, True]
    assert cycles.cyclic.counts.malformed == 1


def test_frames_that_no_drive_of_ours_sends_are_foreign_and_passed_on() -> None:
    cycles = Cycles()
    cycles.cycle([pack_frame(0x345, b"\x01"), *all_answers(5)])
    assert cycles.cyclic.counts.foreign == 1
    assert cycles.notified == [(0x345, b"\x01")]


def test_sdo_answers_are_passed_on_and_nothing_strange() -> None:
    cycles = Cycles()
    cycles.idle(pack_frame(0x583, bytes(8)))
    assert cycles.notified == [(0x583, bytes(8))]
    assert cycles.cyclic.counts.foreign == 0


def test_process_data_are_not_passed_on() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(1))
    assert cycles.notified == []


def test_emergencies_are_news_with_axis_code_register_and_data() -> None:
    cycles = Cycles()
    cycles.idle(pack_frame(0x087, struct.pack("<HB5s", 0x8611, 0x21, b"abcde")))
    (emergency,) = cycles.news().emergencies
    assert (emergency.axis, emergency.code, emergency.register) == (1, 0x8611, 0x21)
    assert emergency.data == b"abcde"
    assert not cycles.news().any


def test_boot_up_is_news_only_when_watched() -> None:
    cycles = Cycles()
    boot = pack_frame(0x703, b"\x00")
    cycles.idle(boot)
    assert not cycles.news().any
    cycles.cyclic.watch(True)
    cycles.idle(boot)
    assert cycles.news().booted == [0]


def silence(cycles: Cycles, seconds: float, beating: int | None = None) -> News:
    """Cycles for so much device time; one axis sends heartbeats."""
    news = News()
    for k in range(round(seconds / PERIOD_S)):
        more = [pack_frame(0x700 + NODES[beating], b"\x05")] if beating is not None else []
        cycles.cycle([*more, *all_answers(k)])
        news.silent.extend(cycles.news().silent)
    return news


def test_heartbeat_that_is_overdue_is_told_once() -> None:
    cycles = Cycles()
    cycles.cyclic.watch(True)
    assert silence(cycles, 0.28).silent == []
    assert silence(cycles, 1.0).silent == [0, 1]


def test_axis_that_is_heard_again_may_fall_silent_again() -> None:
    cycles = Cycles()
    cycles.cyclic.watch(True)
    silence(cycles, 0.4)
    assert silence(cycles, 0.4, beating=0).silent == []
    assert silence(cycles, 0.4).silent == [0]


def test_heartbeat_in_time_is_no_news() -> None:
    cycles = Cycles()
    cycles.cyclic.watch(True)
    assert silence(cycles, 1.0, beating=0).silent == [1]


def test_heartbeats_are_not_missed_before_they_are_watched() -> None:
    cycles = Cycles()
    assert silence(cycles, 1.0).silent == []


def test_bus_off_is_news() -> None:
    cycles = Cycles()
    cycles.idle(pack_frame(ERROR | ERROR_BUS_OFF, bytes(8)))
    assert "bus-off" in cycles.news().bus_error


def test_full_transmit_queue_is_an_error_of_the_bus_when_it_stays_full() -> None:
    cycles = Cycles()
    cycles.cycle(all_answers(0))
    cycles.port.room = 1
    cycles.cycle(all_answers(1))
    assert cycles.news().bus_error == ""
    for _ in range(3):
        cycles.port.room = 1
        cycles.cycle(all_answers(1))
    assert "could not be sent" in cycles.news().bus_error
    assert cycles.cyclic.counts.overflows >= 3


def test_overflow_that_the_controller_reports_is_counted() -> None:
    cycles = Cycles()
    data = bytes([0, TX_OVERFLOW, 0, 0, 0, 0, 0, 0])
    cycles.idle(pack_frame(ERROR | ERROR_CONTROLLER, data))
    assert cycles.cyclic.counts.overflows == 1


def test_pump_passes_frames_on_and_sends_the_heartbeat() -> None:
    cycles = Cycles()
    cycles.port.between.append(pack_frame(0x583, bytes(8)))
    cycles.cyclic.pump(time.monotonic() + 0.01)
    assert cycles.notified == [(0x583, bytes(8))]
    assert 0x77F in cycles.port.ids()


def test_log_gets_every_frame_in_order_with_its_time() -> None:
    log: list[tuple[float, bytes]] = []
    cycles = Cycles(log=lambda time_s, raw: log.append((time_s, raw)))
    cycles.cycle(all_answers(9))
    ids = [unpack_frame(raw).id for _, raw in log]
    assert ids == [0x1FF, 0x080, 0x203, 0x207, 0x77F, 0x183, 0x187, 0x283, 0x287]
    times = np.array([time_s for time_s, _ in log])
    assert (np.diff(times) >= 0).all()
    assert abs(times[0] - time.time()) < 5


# Answers that come cycles later than their SYNC: none of them is taken for a fresh one.


LATE_NODES = (1, 2)
USUAL_S = 2e-4


class Clock:
    """Of the wall; time goes on when somebody waits."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    time = monotonic

    def sleep(self, lasts_s: float) -> None:
        self.now_s += max(lasts_s, 0.0)


class Drives:
    """A port whose drives answer the k-th SYNC with position k, whenever the test says.

    Attributes:
        after_s: Per axis, from a SYNC to its answer [s]; None: it is lost.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.after_s: list[float | None] = [USUAL_S] * len(LATE_NODES)
        self._coming: deque[tuple[float, bytes]] = deque()
        self._syncs, self._last = -1, dict.fromkeys(LATE_NODES, 0.0)

    def send(self, frame: bytes | memoryview) -> bool:
        if unpack_frame(bytes(frame)).id == 0x080:
            self._syncs += 1
            for node, after_s in zip(LATE_NODES, self.after_s, strict=True):
                if after_s is not None:
                    self._answer(node, self._clock.now_s + after_s)
        return True

    def _answer(self, node: int, at: float) -> None:
        raw = pack_frame(0x180 + node, struct.pack("<Hi", 0x1237, self._syncs))
        at = self._last[node] = max(at, self._last[node])  # a drive answers in order
        self._coming = deque(sorted([*self._coming, (at, raw)], key=lambda each: each[0]))

    def receive(self, until_s: float) -> bytes | None:
        return self._coming.popleft()[1] if self.wait(until_s) else None

    def wait(self, until_s: float) -> bool:
        next_s = self._coming[0][0] if self._coming else float("inf")
        self._clock.sleep(min(next_s, until_s) - self._clock.now_s)
        return next_s <= self._clock.now_s


class Exchange:
    """Cycles at their time, each checked: what is said to be fresh is of this very SYNC."""

    def __init__(self, clock: Clock) -> None:
        self.drives = Drives(clock)
        self.cyclic = CanCyclic(self.drives, MINIMAL, LATE_NODES, PERIOD_S)
        self._begin, self.inputs = clock.now_s, Inputs.none_yet(2)
        self.cycles(5)

    def cycles(self, number: int) -> list[list[bool]]:
        """Per cycle, per axis, whether it was fresh."""
        fresh: list[list[bool]] = []
        for _ in range(number):
            inputs = self.inputs = self.cyclic.exchange(
                Outputs.idle(2), self._begin + 0.9 * PERIOD_S
            )
            for axis, came in enumerate(inputs.fresh):
                assert not came or inputs.position[axis] == self.cyclic.cycle, (axis, fresh)
            fresh.append(list(inputs.fresh))
            self._begin += PERIOD_S
            self.cyclic.idle(self._begin)
        return fresh

    def stall(self, cycles: int, also_s: float = 0.0) -> None:
        """All answers to so many SYNCs come at once, right after the last of them."""
        for k in range(cycles):
            left_s = (cycles - k) * PERIOD_S + also_s + k * 1e-6
            self.drives.after_s = [left_s] * len(LATE_NODES)
            assert self.cycles(1) == [[False, False]]
        self.drives.after_s = [USUAL_S] * len(LATE_NODES)


@pytest.fixture
def exchange(monkeypatch: pytest.MonkeyPatch) -> Exchange:
    clock = Clock()
    monkeypatch.setattr("hil_drivers.cia402.can_cycle.time", clock)
    return Exchange(clock)


def test_burst_of_sixteen_late_answers_is_sorted_out_at_once(exchange: Exchange) -> None:
    exchange.stall(16, also_s=1e-4)
    assert exchange.cycles(5) == [[True, True]] * 5
    counts = exchange.cyclic.counts
    assert (counts.missing, counts.late, counts.doubled) == (32, 32, 0)


def test_burst_that_comes_in_two_parts_leaves_no_wrong_row_between_them(exchange: Exchange) -> None:
    for k in range(16):
        parts_s = (16 - k) * PERIOD_S + (0.0 if k < 9 else 1.5 * PERIOD_S)
        exchange.drives.after_s = [parts_s + k * 1e-6] * 2
        exchange.cycles(1)
    exchange.drives.after_s = [3 * PERIOD_S, 3 * PERIOD_S]
    fresh = exchange.cycles(1)
    exchange.drives.after_s = [USUAL_S + 2 * PERIOD_S] * 2
    fresh += exchange.cycles(1)
    exchange.drives.after_s = [USUAL_S] * 2
    fresh += exchange.cycles(8)
    assert fresh[:2] == [[False, False]] * 2
    assert fresh[-3:] == [[True, True]] * 3


def test_answers_that_trickle_in_one_a_cycle_are_never_fresh_while_more_are_owed(
    exchange: Exchange,
) -> None:
    exchange.drives.after_s = [4 * PERIOD_S + USUAL_S] * 2  # soon after a later SYNC
    assert exchange.cycles(4 + CONFIRMED - 1) == [[False, False]] * (4 + CONFIRMED - 1)


def test_answers_late_by_over_a_period_for_many_cycles_are_never_fresh(exchange: Exchange) -> None:
    exchange.drives.after_s = [1.7 * PERIOD_S] * 2
    assert exchange.cycles(60) == [[False, False]] * 60
    exchange.drives.after_s = [USUAL_S] * 2
    assert exchange.cycles(6)[-4:] == [[True, True]] * 4


def test_one_axis_that_is_late_by_over_a_period_is_never_fresh(exchange: Exchange) -> None:
    exchange.drives.after_s = [USUAL_S, 1.7 * PERIOD_S]
    assert exchange.cycles(60) == [[True, False]] * 60


def test_a_single_lost_frame_costs_one_row_of_one_axis(exchange: Exchange) -> None:
    exchange.drives.after_s = [USUAL_S, None]
    fresh = exchange.cycles(1)
    exchange.drives.after_s = [USUAL_S, USUAL_S]
    fresh += exchange.cycles(10)
    assert fresh == [[True, False]] + [[True, True]] * 10
    assert (exchange.cyclic.counts.missing, exchange.cyclic.counts.late) == (1, 0)


def test_several_lost_frames_are_over_when_single_answers_have_shown_it(exchange: Exchange) -> None:
    exchange.drives.after_s = [USUAL_S, None]
    exchange.cycles(3)
    exchange.drives.after_s = [USUAL_S, USUAL_S]
    came = [axis_2 for _, axis_2 in exchange.cycles(CONFIRMED + 4)]
    assert came == [False] * (CONFIRMED - 1) + [True] * 5


def test_an_axis_whose_answers_come_late_is_told_from_one_that_is_silent(
    exchange: Exchange,
) -> None:
    exchange.drives.after_s = [1.7 * PERIOD_S, None]
    exchange.cycles(3)
    inputs = exchange.inputs
    assert (inputs.fresh, inputs.late) == ([False, False], [True, False])


def cycles_until_given_up(*, late: bool) -> int:
    judge, inputs = Judge(1, False, 3), Inputs.none_yet(1)
    inputs.late = [late]
    for number in range(100):
        judge.count(inputs)
        if not judge.answers(0):
            return number
    raise AssertionError("never")


def test_an_axis_that_is_behind_has_three_times_as_many_cycles_as_a_silent_one() -> None:
    assert cycles_until_given_up(late=False) == 3
    assert cycles_until_given_up(late=True) == 9


# Another master on the bus, two nodes with one id: found before and while the arm is driven.


MASTER = 127
ENABLE = b"\x0f\x00\x08\x00\x00\x00\x00"
_numbers = itertools.count(1)


class Heard:
    """A port on which these frames have come; nothing may be sent."""

    def __init__(self, *frames: bytes) -> None:
        self._frames = list(frames)

    def send(self, frame: bytes | memoryview) -> bool:
        raise AssertionError("somebody sent")

    def receive(self, until_s: float) -> bytes | None:
        if self._frames:
            return self._frames.pop(0)
        time.sleep(max(until_s - time.monotonic(), 0.0))
        return None

    def wait(self, until_s: float) -> bool:
        return bool(self._frames)


@pytest.mark.parametrize(
    ("frame", "called"),
    [
        (pack_frame(0x080, b""), r"SYNC \(080h\)"),
        (pack_frame(0x77F, b"\x05"), r"heartbeat of this master's node id 127 \(77Fh\)"),
        (pack_frame(0x203, bytes(7)), r"RPDO1 of node 3 \(203h\)"),
        (pack_frame(0x307, bytes(8)), r"RPDO2 of node 7 \(307h\)"),
        (pack_frame(0x403, bytes(8)), r"RPDO3 of node 3"),
        (pack_frame(0x507, bytes(8)), r"RPDO4 of node 7"),
    ],
)
def test_what_another_master_sends_is_named_and_refused(frame: bytes, called: str) -> None:
    with pytest.raises(RobotConnectionError, match=f"another master is on the bus: 2 × .*{called}"):
        require_no_master(Heard(frame, frame), NODES, MASTER, 0.01)


def test_drives_that_are_alone_and_other_nodes_are_no_master() -> None:
    frames = [pack_frame(0x703, b"\x7f"), pack_frame(0x183, bytes(7)), pack_frame(0x083, bytes(8))]
    foreign = [pack_frame(0x204, bytes(7)), pack_frame(0x77E, b"\x05"), pack_frame(0x583, bytes(8))]
    require_no_master(Heard(*frames, *foreign), NODES, MASTER, 0.01)


def station(channel: str) -> Options:
    return options_of({"bus": {"interface": "virtual", "channel": channel}}, "lab6")


def test_joining_a_bus_with_another_master_sends_nothing_and_says_so() -> None:
    channel, over = f"cia402-masters-{next(_numbers)}", threading.Event()
    sync = can.Message(arbitration_id=0x080, is_extended_id=False)
    with can.Bus(interface="virtual", channel=channel) as other:

        def another() -> None:
            while not over.wait(0.004):
                other.send(sync)

        thread = threading.Thread(target=another)
        thread.start()
        try:
            with pytest.raises(RobotConnectionError, match=r"another master.*SYNC \(080h\)"):
                CanBus(station(channel), [f"axis {n}" for n in range(6)])
        finally:
            over.set()
            thread.join()
        assert other.recv(0.0) is None


def test_own_frames_are_not_heard() -> None:
    channel = f"cia402-masters-{next(_numbers)}"
    with can.Bus(interface="virtual", channel=channel) as bus:
        port = PythonCanPort(bus)
        port.send(pack_frame(0x080, b""))
        require_no_master(port, NODES, MASTER, 0.01)


def driven(**options: object) -> Cycles:
    cycles = Cycles(**options)
    cycles.cycle(all_answers(0))
    cycles.cyclic.watch(True)
    return cycles


@pytest.mark.parametrize("can_id", [0x080, 0x203, 0x307])
def test_command_that_we_did_not_send_is_told_while_the_arm_is_driven(can_id: int) -> None:
    cycles = driven()
    cycles.idle(pack_frame(can_id, b"\x0f\x00"))
    assert "another master is on the bus" in cycles.news().bus_error


def test_quick_stop_from_outside_is_no_other_master() -> None:
    cycles = driven()
    for frame in quick_stop_frames(station("any")):
        cycles.idle(bytes(frame))
    assert not cycles.news().any
    cycles.idle(pack_frame(0x203, ENABLE))
    assert "another master" in cycles.news().bus_error


def doubled(cycles: Cycles, count: int) -> str:
    for k in range(count):
        cycles.cycle([*all_answers(k), tpdo1(3, k + 9)])
        cycles.idle()
    return cycles.news().bus_error


def test_answers_that_are_doubled_for_many_cycles_are_two_nodes_with_one_id() -> None:
    cycles = driven(late_cycles=10)
    assert doubled(cycles, 10) == ""
    assert doubled(cycles, 1) == "two nodes answer as node 3"


def test_answers_that_are_doubled_now_and_then_are_only_counted() -> None:
    cycles = driven(late_cycles=3)
    for k in range(20):
        assert doubled(cycles, 3) == ""
        cycles.cycle(all_answers(k))
    assert cycles.cyclic.counts.doubled == 60


def test_full_queue_is_an_error_after_late_cycles() -> None:
    cycles = driven(late_cycles=5)
    for k in range(6):
        assert cycles.news().bus_error == ""
        cycles.port.room = 1
        cycles.cycle(all_answers(k))
    assert (
        "frames could not be sent on the bus in more than 5 consecutive cycles"
        in cycles.news().bus_error
    )


def test_quick_stop_from_outside_is_sent_three_times_with_a_pause() -> None:
    told = station(f"cia402-masters-{next(_numbers)}")
    with can.Bus(interface="virtual", channel=told.bus.channel) as drives:
        assert stop_directly(told)
        heard = [drives.recv(0.0) for _ in range(3 * 7)]
        assert drives.recv(0.0) is None
    syncs = [each for each in heard if each is not None and each.arbitration_id == 0x080]
    assert [heard.index(sync) for sync in syncs] == [6, 13, 20]
    assert all(b.timestamp - a.timestamp >= 0.002 for a, b in itertools.pairwise(syncs))
