"""Answers that come cycles later than their SYNC: none of them is taken for a fresh one."""

from __future__ import annotations

import struct
from collections import deque

import pytest

from hil.can.frames import pack_frame, unpack_frame
from hil_drivers.cia402.bus import Inputs, Outputs
from hil_drivers.cia402.can_cycle import CONFIRMED, CanCyclic
from hil_drivers.cia402.mapping import MINIMAL
from hil_drivers.cia402.supervisor import Judge

NODES = (1, 2)
PERIOD_S = 0.004
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
        self.after_s: list[float | None] = [USUAL_S] * len(NODES)
        self._coming: deque[tuple[float, bytes]] = deque()
        self._syncs, self._last = -1, dict.fromkeys(NODES, 0.0)

    def send(self, frame: bytes | memoryview) -> bool:
        if unpack_frame(bytes(frame)).id == 0x080:
            self._syncs += 1
            for node, after_s in zip(NODES, self.after_s, strict=True):
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
        self.cyclic = CanCyclic(self.drives, MINIMAL, NODES, PERIOD_S)
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
            self.drives.after_s = [left_s] * len(NODES)
            assert self.cycles(1) == [[False, False]]
        self.drives.after_s = [USUAL_S] * len(NODES)


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
