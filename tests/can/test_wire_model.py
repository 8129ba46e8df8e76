"""The model of the wire: bits of a frame, and its times by a clock of the test's own."""

from __future__ import annotations

import pytest

from hil.can.frames import EXTENDED, FRAME, REMOTE, bus_load, frame_bits, pack_frame
from hil.can.wire_model import Wire, arbitration

LONGEST_S = 135e-6
"""A frame of eight bytes at 1 Mbit/s with all stuff bits."""


def wire_of(*ends: str, **options: float) -> Wire:
    wire = Wire(1e6, **options)  # type: ignore[arg-type]
    for end in ends:
        wire.join(end)
    return wire


def ids(wire: Wire, now_s: float) -> list[int]:
    return [FRAME.unpack(passed.raw)[0] for passed in wire.passed(now_s)]


def eight(can_id: int) -> bytes:
    return pack_frame(can_id, bytes(8))


def test_a_frame_passes_when_its_bits_have() -> None:
    wire = wire_of("a")
    wire.offer("a", eight(1), 10.0)
    assert wire.due_s == pytest.approx(10 + LONGEST_S)
    assert wire.passed(10 + 0.9 * LONGEST_S) == []
    assert ids(wire, 10 + 1.1 * LONGEST_S) == [1]
    assert wire.due_s is None


def test_seconds_of_the_bus_pass_faster_on_request() -> None:
    wire = wire_of("a", speed=10.0)
    wire.offer("a", eight(1), 0.0)
    assert wire.due_s == pytest.approx(LONGEST_S / 10)


def test_the_lowest_identifier_goes_first_once_the_wire_is_free() -> None:
    wire = wire_of("a", "b", "c")
    for end, can_id in (("a", 0x700), ("b", 0x300), ("c", 0x80)):
        wire.offer(end, eight(can_id), 0.0)
    assert ids(wire, 1.0) == [0x700, 0x80, 0x300]


def test_one_controller_sends_in_the_order_of_its_queue() -> None:
    wire = wire_of("a", "b")
    for end, can_id in (("b", 0x100), ("a", 0x700), ("a", 0x80), ("b", 0x300)):
        wire.offer(end, eight(can_id), 0.0)
    assert ids(wire, 1.0) == [0x100, 0x300, 0x700, 0x80]


def test_controllers_behind_one_end_compete_with_each_other() -> None:
    wire = Wire(1e6)
    wire.join("many", sorts=True)
    for number, can_id in enumerate((0x700, 0x281, 0x182, 0x281, 0x181)):
        wire.offer("many", pack_frame(can_id, bytes([9 - number])), 0.0)
    passed = [FRAME.unpack(frame.raw) for frame in wire.passed(1.0)]
    assert [(can_id, data[0]) for can_id, _, data in passed] == [
        (0x700, 9),
        (0x181, 5),
        (0x182, 7),
        (0x281, 8),
        (0x281, 6),
    ]


def test_a_frame_that_comes_too_late_does_not_compete() -> None:
    wire = wire_of("a", "b")
    wire.offer("a", eight(0x500), 0.0)
    wire.offer("a", eight(0x600), 0.0)
    wire.offer("b", eight(0x100), 1.5 * LONGEST_S)  # 600 has been on the wire since 1.0
    assert ids(wire, 1.0) == [0x500, 0x600, 0x100]


def test_standard_frames_win_over_extended_and_data_over_remote() -> None:
    fields = [0x100, 0x100 | REMOTE, 0x100 << 18 | EXTENDED, 0x100 << 18 | EXTENDED | REMOTE, 0x101]
    assert [arbitration(field) for field in fields] == sorted(map(arbitration, fields))
    assert len(set(map(arbitration, fields))) == len(fields)


def test_a_full_queue_refuses_until_something_has_left_it() -> None:
    wire = wire_of("a", depth=3)
    taken = [wire.offer("a", eight(n), 0.0) for n in range(6)]
    assert taken == [True] * 4 + [False] * 2  # one on the wire, three wait
    assert wire.refused == 2
    assert wire.offer("a", eight(7), 1.1 * LONGEST_S)
    assert ids(wire, 1.0) == [0, 1, 2, 3, 7]


def test_behind_one_end_the_highest_identifiers_are_dropped_first() -> None:
    wire = Wire(1e6, depth=3)
    wire.join("many", sorts=True)
    for can_id in (0x7FF, 0x281, 0x282, 0x283):
        assert wire.offer("many", eight(can_id), 0.0)
    assert not wire.offer("many", eight(0x181), 0.0)  # 283 makes room for it
    assert not wire.offer("many", eight(0x300), 0.0)  # finds none
    assert ids(wire, 1.0) == [0x7FF, 0x181, 0x281, 0x282]


def test_what_was_sent_before_leaving_still_passes() -> None:
    wire = wire_of("a", "b")
    for end in ("a", "a", "b"):
        wire.offer(end, eight(ord(end)), 0.0)
    wire.leave("a")
    assert ids(wire, 1.0) == [ord("a"), ord("a"), ord("b")]
    wire.join("a")  # another one of that name starts anew
    assert wire.waiting("a") == 0


def test_who_forgets_can_send_again() -> None:
    wire = wire_of("a")
    for number in range(3):
        wire.offer("a", eight(number), 0.0)
    wire.forget("a")
    wire.offer("a", eight(9), 0.0)
    assert ids(wire, 1.0) == [0, 9]


def test_busy_time_is_that_of_the_bits() -> None:
    wire = wire_of("a")
    for _ in range(10):
        wire.offer("a", eight(1), 0.0)
    wire.passed(1.0)
    assert wire.busy_s == pytest.approx(10 * LONGEST_S)
    assert wire.frames == 10


def test_what_passed_while_nobody_looked_is_due_at_once() -> None:
    wire = wire_of("a")
    wire.offer("a", eight(1), 0.0)
    wire.offer("a", eight(2), 1.0)
    assert wire.due_s == pytest.approx(LONGEST_S)


def cycles(wire: Wire, rate_hz: float, n: int, since_s: float = 0.0) -> list[float]:
    """SYNC and six commands of the master, two answers of six drives: how late the last one is."""
    late = []
    for cycle in range(n):
        at_s = since_s + cycle / rate_hz
        for can_id in (0x80, *range(0x201, 0x207)):
            wire.offer("master", pack_frame(can_id, bytes(7)), at_s)
        for can_id in (*range(0x181, 0x187), *range(0x281, 0x287)):
            wire.offer("drives", eight(can_id), at_s)
        passed = wire.passed(at_s + 1 / rate_hz)
        late.append(max((frame.at_s for frame in passed), default=at_s) - at_s)
    return late


def test_a_bus_with_room_carries_every_cycle_within_it() -> None:
    wire = wire_of("master", "drives")
    late = cycles(wire, 250, 50)
    assert wire.refused == 0
    assert wire.frames == 50 * 19
    assert max(late) == pytest.approx(min(late))
    assert max(late) < 1 / 250


def test_on_an_overloaded_bus_queues_grow_and_frames_are_refused() -> None:
    wire = wire_of("master", "drives")
    waiting, refused = [], []
    for since_s in (0.0, 1e-3, 2e-3):
        cycles(wire, 1000, 1, since_s)
        waiting.append(wire.waiting("master") + wire.waiting("drives"))
        refused.append(wire.refused)
    cycles(wire, 1000, 50, 3e-3)
    assert waiting[0] < waiting[1] < waiting[2]
    assert refused[0] == 0 < wire.refused
    assert wire.busy_s == pytest.approx(53e-3, abs=2 * LONGEST_S)  # full, and no more


def test_under_overload_the_lowest_identifiers_are_still_in_time() -> None:
    wire = wire_of("urgent", "flood")
    late = []
    for cycle in range(100):
        at_s = cycle * 1e-3
        for _ in range(20):
            wire.offer("flood", eight(0x300), at_s)
        wire.offer("urgent", eight(0x80), at_s)
        passed = wire.passed(at_s + 0.99e-3)
        late += [frame.at_s - at_s for frame in passed if frame.end == "urgent"]
    assert len(late) == 100
    assert max(late) < 2.01 * LONGEST_S  # behind one frame at most


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"depth": 0}, {"speed": -1.0}])
def test_what_cannot_be_a_wire_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="above 0"):
        wire_of(**options)


# Frame bits against the published worst case, bus load against the measured table.


@pytest.mark.parametrize("n_bytes", range(9))
def test_worst_case_is_that_of_the_schedulability_analysis(n_bytes: int) -> None:
    # Davis, Burns, Bril, Lukkien (2007), eqs. 1 and 2, with the interframe space.
    assert frame_bits(n_bytes).worst == 55 + 10 * n_bytes
    assert frame_bits(n_bytes, extended=True).worst == 80 + 10 * n_bytes


def test_a_frame_of_eight_bytes_without_stuffing_has_111_bits() -> None:
    assert frame_bits(8).nominal == 111
    assert frame_bits(8, extended=True).nominal == 131


@pytest.mark.parametrize("n_bytes", [-1, 9, 64])
def test_no_classic_frame_is_longer_than_eight_bytes(n_bytes: int) -> None:
    with pytest.raises(ValueError, match="0 to 8"):
        frame_bits(n_bytes)


@pytest.mark.parametrize(
    ("lengths", "nominal", "worst"),
    [
        ([0] + 12 * [6], 1187, 1435),
        ([0] + 12 * [7] + 6 * [8], 1949, 2365),
        ([0] + 18 * [8], 2045, 2485),
        ([0] + 12 * [6] + 6 * [7] + 6 * [8], 2471, 2995),
    ],
)
def test_load_of_six_axes_at_1_khz(lengths: list[int], nominal: int, worst: int) -> None:
    load = bus_load(lengths, 1000, 1e6)
    assert load == pytest.approx((nominal / 1000, worst / 1000))


def test_load_falls_with_the_rate_and_the_bit_rate() -> None:
    assert bus_load([8], 250, 1e6).worst == pytest.approx(bus_load([8], 500, 1e6).worst / 2)
    assert bus_load([8], 250, 5e5).worst == pytest.approx(bus_load([8], 250, 1e6).worst * 2)
