"""Whatever participants do, all see one order, and nobody misses what was sent after it came."""

from __future__ import annotations

import random
import socket
from dataclasses import dataclass, field

import pytest

from hil.can.frames import FRAME, Frame
from hil.can.hub import Hub
from tests.support.canbus_parts import can_channel, frame, raw_end, serve_until_idle  # noqa: F401

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
