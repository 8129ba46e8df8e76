"""One cycle over CAN, on a port that plays a script: what is sent, and what is counted as what."""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Iterable

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
from hil_drivers.cia402.bus import Inputs, News, Outputs
from hil_drivers.cia402.can_cycle import CanCyclic
from hil_drivers.cia402.mapping import ALL_MODES, MINIMAL, POSITION

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
    assert "no room" in cycles.news().bus_error
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
