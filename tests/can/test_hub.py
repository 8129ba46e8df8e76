"""The hub of a bus between processes, served step by step, also by random participants."""

from __future__ import annotations

import os
import random
import select
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

import pytest

from hil.can import hub
from hil.can.frames import (
    ERROR,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    FRAME,
    TX_OVERFLOW,
    Frame,
    pack_frame,
)
from hil.can.hub import Hub, hub_thread
from tests.support.canbus_parts import can_channel, frame, numbers, raw_end, serve_until_idle  # noqa: F401


class Bench:
    """A hub and its participants."""

    def __init__(self, channel: str, **options: float) -> None:
        self.hub = Hub(channel, **options)  # type: ignore[arg-type]
        self.heard: list[Frame] = []
        self.hub.local.heard = self.heard.append

    def end(self) -> socket.socket:
        end = raw_end(self.hub.path)
        self.hub.serve()
        return end


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def bench(can_channel: str, stack: ExitStack) -> Bench:  # noqa: F811
    made = Bench(can_channel)
    stack.enter_context(made.hub)
    return made


def ends(bench: Bench, stack: ExitStack, n: int) -> list[socket.socket]:
    return [stack.enter_context(bench.end()) for _ in range(n)]


def is_silent(end: socket.socket) -> bool:
    return not select.select([end], [], [], 0)[0]


def is_hung_up(end: socket.socket) -> bool:
    try:
        while raw := end.recv(FRAME.size):
            assert len(raw) == FRAME.size
    except ConnectionResetError:
        pass
    return True


def error_of(end: socket.socket) -> tuple[int, bytes]:
    can_id, _, data = FRAME.unpack(end.recv(FRAME.size))
    assert can_id & ERROR
    return can_id & ~ERROR, data


def test_everybody_but_the_sender_gets_a_frame(bench: Bench, stack: ExitStack) -> None:
    a, b, c = ends(bench, stack, 3)
    a.send(pack_frame(0x181, b"abc"))
    serve_until_idle(bench.hub)
    assert b.recv(99) == c.recv(99) == pack_frame(0x181, b"abc")
    assert is_silent(a)
    assert [(each.id, each.data) for each in bench.heard] == [(0x181, b"abc")]


def test_the_host_sends_to_all_and_does_not_hear_itself(bench: Bench, stack: ExitStack) -> None:
    a, b = ends(bench, stack, 2)
    bench.hub.local.send(0x80, b"")
    assert a.recv(99) == b.recv(99) == pack_frame(0x80, b"")
    assert bench.heard == []


def test_all_see_the_same_order(bench: Bench, stack: ExitStack) -> None:
    a, b, c, d = ends(bench, stack, 4)
    for number in range(100):
        (a, b)[number % 2].send(frame(1, number))
        if number % 7 == 0:
            bench.hub.serve()
    serve_until_idle(bench.hub)
    order = [int.from_bytes(each.data, "little") for each in bench.heard]
    assert sorted(order) == list(range(100))
    assert numbers(c, 100) == numbers(d, 100) == order
    assert numbers(a, 50) == [number for number in order if number % 2]


def test_an_answer_comes_after_what_it_answers(bench: Bench, stack: ExitStack) -> None:
    a, b = ends(bench, stack, 2)
    bench.hub.local.heard = lambda got: bench.hub.local.send(0x181, got.data)
    a.send(pack_frame(0x80, b"1"))
    a.send(pack_frame(0x80, b"2"))
    serve_until_idle(bench.hub)
    got = [FRAME.unpack(b.recv(99)) for _ in range(4)]
    assert [(can_id, data[:1]) for can_id, _, data in got] == [
        (0x80, b"1"),
        (0x181, b"1"),
        (0x80, b"2"),
        (0x181, b"2"),
    ]


def test_who_is_connected_gets_what_is_sent_afterwards(bench: Bench, stack: ExitStack) -> None:
    (a,) = ends(bench, stack, 1)
    late = stack.enter_context(raw_end(bench.hub.path))  # the hub has not served since
    a.send(frame(1, 7))
    serve_until_idle(bench.hub)
    assert numbers(late, 1) == [7]


def test_who_connects_while_the_hub_is_at_work_does_too(
    bench: Bench, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    (a,) = ends(bench, stack, 1)
    late: list[socket.socket] = []

    def batch(peer: hub.Peer) -> tuple[list[bytes], bool]:
        if not late:
            late.append(stack.enter_context(raw_end(bench.hub.path)))
            a.send(frame(1, 8))
        return real(peer)

    real = hub.Peer.batch
    monkeypatch.setattr(hub.Peer, "batch", batch)
    a.send(frame(1, 7))
    serve_until_idle(bench.hub)
    assert 8 in numbers(late[0], 2)


def test_what_was_sent_before_hanging_up_arrives(bench: Bench, stack: ExitStack) -> None:
    a, b = ends(bench, stack, 2)
    b.send(frame(2, 0))
    serve_until_idle(bench.hub)  # waits unread for a: its end will be a reset
    for number in range(50):
        a.send(frame(1, number))
    a.close()
    b.send(frame(2, 1))  # finds a gone before what it sent was read
    serve_until_idle(bench.hub)
    assert numbers(b, 50) == list(range(50))
    assert len(bench.hub.peers) == 1


def test_errors_of_the_host_are_the_hosts(bench: Bench, stack: ExitStack) -> None:
    def broken(got: Frame) -> None:
        raise OSError("disk full")

    a, b = ends(bench, stack, 2)
    bench.hub.local.heard = broken
    a.send(frame(1, 1))
    with pytest.raises(OSError, match="disk full"):
        serve_until_idle(bench.hub)
    bench.hub.local.heard = None
    a.send(frame(1, 2))
    serve_until_idle(bench.hub)
    assert numbers(b, 2) == [1, 2]


def test_a_slow_reader_holds_up_nobody_and_loses_nothing(bench: Bench, stack: ExitStack) -> None:
    a, quick, slow = ends(bench, stack, 3)
    for number in range(3000):
        a.send(frame(1, number))
        bench.hub.serve()
        assert numbers(quick, 1) == [number]
    got: list[int] = []
    while len(got) < 3000:
        bench.hub.serve()
        got += numbers(slow, 1)
    assert got == list(range(3000))


def test_who_never_reads_is_hung_up_on(
    bench: Bench, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub, "MOST_WAITING", 500)
    a, quick, stuck = ends(bench, stack, 3)
    for number in range(2000):
        a.send(frame(1, number))
        bench.hub.serve()
        assert numbers(quick, 1) == [number]
    assert len(bench.hub.peers) == 2
    assert is_hung_up(stuck)


@pytest.mark.parametrize("packet", [b"xyz", bytes(17), bytes(100)])
def test_who_does_not_speak_in_frames_is_hung_up_on(
    bench: Bench, stack: ExitStack, packet: bytes
) -> None:
    stranger, a, b = ends(bench, stack, 3)
    stranger.send(packet)
    a.send(frame(1, 5))
    serve_until_idle(bench.hub)
    assert is_hung_up(stranger)
    assert numbers(b, 1) == [5]


@pytest.mark.parametrize(
    "raw",
    [
        FRAME.pack(ERROR | ERROR_BUS_OFF, 8, bytes(8)),
        FRAME.pack(0x181, 9, bytes(8)),
        FRAME.pack(0x800, 0, bytes(8)),
    ],
)
def test_frames_that_cannot_be_do_not_pass(bench: Bench, stack: ExitStack, raw: bytes) -> None:
    a, b = ends(bench, stack, 2)
    a.send(raw)
    a.send(frame(1, 5))
    serve_until_idle(bench.hub)
    assert numbers(b, 1) == [5]
    assert len(bench.heard) == 1


def test_nothing_passes_to_or_from_who_is_off_the_bus(bench: Bench, stack: ExitStack) -> None:
    a, b = ends(bench, stack, 2)
    bench.hub.bus_off(bench.hub.peers[0])
    assert error_of(a) == (ERROR_BUS_OFF, bytes(8))
    a.send(frame(1, 1))
    b.send(frame(1, 2))
    serve_until_idle(bench.hub)
    assert is_silent(a)
    assert is_silent(b)
    assert [int.from_bytes(each.data, "little") for each in bench.heard] == [2]


def test_who_is_let_back_takes_part_again(bench: Bench, stack: ExitStack) -> None:
    a, b = ends(bench, stack, 2)
    bench.hub.bus_off()
    bench.hub.recover()
    assert [error_of(a)[0], error_of(a)[0]] == [ERROR_BUS_OFF, ERROR_RESTARTED]
    assert [error_of(b)[0], error_of(b)[0]] == [ERROR_BUS_OFF, ERROR_RESTARTED]
    a.send(frame(1, 3))
    serve_until_idle(bench.hub)
    assert numbers(b, 1) == [3]


def test_a_new_connection_is_on_the_bus(bench: Bench, stack: ExitStack) -> None:
    (a,) = ends(bench, stack, 1)
    bench.hub.bus_off()
    (again,) = ends(bench, stack, 1)
    bench.hub.local.send(1, b"x")
    assert again.recv(99) == pack_frame(1, b"x")
    assert error_of(a)[0] == ERROR_BUS_OFF
    assert is_silent(a)


def test_what_goes_wrong_in_the_thread_is_told_to_who_asked(
    can_channel: str,  # noqa: F811
) -> None:
    def broken(hub: Hub) -> None:
        raise ValueError("no such peer")

    with hub_thread(can_channel) as hosted:
        with pytest.raises(ValueError, match="no such peer"):
            hosted.ask(broken)
        assert hosted.ask(lambda hub: hub.peers) == ()


def test_the_hub_knows_whose_processes_take_part(bench: Bench, stack: ExitStack) -> None:
    ends(bench, stack, 1)
    assert bench.hub.peers[0].pid == os.getpid()


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def wired(can_channel: str, stack: ExitStack) -> tuple[Bench, Clock]:  # noqa: F811
    clock = Clock()
    bench = Bench(can_channel, bitrate=1e6, clock=clock)  # type: ignore[arg-type]
    stack.enter_context(bench.hub)
    return bench, clock


def test_with_a_bit_rate_frames_take_their_time(
    wired: tuple[Bench, Clock], stack: ExitStack
) -> None:
    bench, clock = wired
    a, b = ends(bench, stack, 2)
    a.send(frame(1, 5))
    bench.hub.serve()
    assert bench.hub.due_s == pytest.approx(135e-6)
    assert is_silent(b)
    clock.now = 136e-6
    bench.hub.serve()
    assert numbers(b, 1) == [5]
    assert len(bench.heard) == 1


def test_with_a_bit_rate_the_lowest_identifier_goes_first(
    wired: tuple[Bench, Clock], stack: ExitStack
) -> None:
    bench, clock = wired
    a, b = ends(bench, stack, 2)
    for can_id in (0x600, 0x300, 0x80):
        a.send(frame(can_id))
    bench.hub.serve()
    for can_id in (0x282, 0x181):
        bench.hub.local.send(can_id, bytes(8))
    clock.now = 1.0
    bench.hub.serve()
    order = [FRAME.unpack(b.recv(99))[0] for _ in range(5)]
    assert order == [0x600, 0x181, 0x282, 0x300, 0x80]


def test_a_sender_hears_that_its_transmit_queue_was_full(
    wired: tuple[Bench, Clock], stack: ExitStack
) -> None:
    bench, clock = wired
    a, b = ends(bench, stack, 2)
    for number in range(70):
        a.send(frame(1, number))
    for _ in range(4):
        bench.hub.serve()
    assert [error_of(a) for _ in range(5)] == 5 * [
        (ERROR_CONTROLLER, bytes([0, TX_OVERFLOW, 0, 0, 0, 0, 0, 0]))
    ]
    assert bench.hub.peers[0].dropped == 5
    clock.now = 1.0
    bench.hub.serve()
    assert numbers(b, 65) == list(range(65))


def test_the_hosts_own_queue_is_bounded_as_well(wired: tuple[Bench, Clock]) -> None:
    bench, _ = wired
    for number in range(70):
        bench.hub.local.send(0x181, bytes([number]))
    assert bench.hub.local.dropped == 5


def test_what_was_sent_before_hanging_up_passes_on_a_slow_wire_too(
    wired: tuple[Bench, Clock], stack: ExitStack
) -> None:
    bench, clock = wired
    a, b = ends(bench, stack, 2)
    for number in range(70):  # more than its queue takes, and nobody left to tell
        a.send(frame(1, number))
    a.close()
    for _ in range(5):
        bench.hub.serve()
    clock.now = 1.0
    bench.hub.serve()
    assert numbers(b, 65) == list(range(65))
    assert len(bench.hub.peers) == 1


def test_who_goes_off_the_bus_takes_along_what_it_has_not_sent(
    wired: tuple[Bench, Clock], stack: ExitStack
) -> None:
    bench, clock = wired
    a, b = ends(bench, stack, 2)
    for number in range(3):
        a.send(frame(1, number))
    bench.hub.serve()
    bench.hub.bus_off(bench.hub.peers[0])
    clock.now = 1.0
    bench.hub.serve()
    assert numbers(b, 1) == [0]  # it was on the wire
    assert is_silent(b)


# Whatever participants do, all see one order, and nobody misses what was sent after it came.


SEEDS = range(12)
ACTIONS = 600


def number_in(raw: bytes) -> int:
    return int.from_bytes(FRAME.unpack(raw)[2], "little")


@dataclass
class Member:
    """A participant, and what it should know.

    Attributes:
        since: Number of the next frame when it had connected.
        sent: Numbers of its own frames.
        got: Numbers it has received.
    """

    end: socket.socket
    since: int
    sent: set[int] = field(default_factory=set)
    got: list[int] = field(default_factory=list)

    def read(self, most: int) -> None:
        try:
            while most and (raw := self.end.recv(FRAME.size)):
                self.got.append(number_in(raw))
                most -= 1
        except BlockingIOError:
            pass


class Traffic:
    """Members that connect, send, read and leave as they like."""

    def __init__(self, hub: Hub, dice: random.Random) -> None:
        self.hub, self.dice = hub, dice
        self.order: list[int] = []
        self.here: list[Member] = []
        self.next = self.unserved = 0
        hub.local.heard = self.heard

    def heard(self, got: Frame) -> None:
        self.order.append(int.from_bytes(got.data, "little"))
        if self.dice.random() < 0.1:
            self.order.append(self.next)
            self.hub.local.send(0x80, self.next.to_bytes(8, "little"))
            self.next += 1

    def connect(self) -> None:
        if len(self.here) < 6:
            end = raw_end(self.hub.path)
            end.setblocking(False)
            self.here.append(Member(end, self.next))

    def send(self) -> None:
        if self.here:
            member = self.dice.choice(self.here)
            n = self.dice.randint(1, 40)
            self.unserved += n
            if self.unserved > 100:  # a socket takes 278 before it blocks
                self.catch_up()
            for _ in range(n):
                member.end.send(frame(self.dice.randrange(0x7FF), self.next))
                member.sent.add(self.next)
                self.next += 1

    def catch_up(self) -> None:
        for _ in range(10):
            self.hub.serve()
        self.unserved = 0

    def read(self) -> None:
        if self.here:
            self.dice.choice(self.here).read(self.dice.randint(1, 100))

    def leave(self) -> None:
        if len(self.here) > 2:
            member = self.here.pop(self.dice.randrange(len(self.here)))
            member.end.close()

    def run(self) -> None:
        whats = [self.connect, self.send, self.read, self.hub.serve, self.leave]
        for _ in range(ACTIONS):
            self.dice.choices(whats, [2, 6, 6, 4, 1])[0]()

    def settle(self) -> None:
        before = -1
        while before != (before := sum(len(member.got) for member in self.here)):
            serve_until_idle(self.hub)
            for member in self.here:
                member.read(10**9)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", SEEDS)
def test_one_order_for_all_and_nothing_missed(can_channel: str, seed: int) -> None:  # noqa: F811
    with Hub(can_channel) as hub:
        traffic = Traffic(hub, random.Random(seed))
        traffic.run()
        traffic.settle()
        assert sorted(traffic.order) == list(range(traffic.next))  # nobody's frames were lost
        assert len(hub.peers) == len(traffic.here)
        for member in traffic.here:
            member.end.close()
            others = [number for number in traffic.order if number not in member.sent]
            assert member.got == others[len(others) - len(member.got) :]
            assert {number for number in others if number >= member.since} <= set(member.got)
