"""The bus between processes: floods, and participants and hosts that die."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import can
import pytest

from hil.can.hub import HostedHub, Hub, hub_thread
from hil.core.errors import PluginError
from tests.support.canbus_parts import bus_hub, can_channel, frame, numbers, raw_end, unix_bus  # noqa: F401
from tests.support.other_process import other_process

pytestmark = pytest.mark.wire

FLOOD = 20_000

HOST = """
import os
from hil.can.hub import Hub
with Hub(os.environ["CHANNEL"]) as hub:
    hub.local.heard = lambda got: hub.local.send(got.id + 1, got.data)
    print("ready", flush=True)
    while True:
        hub.serve(0.1)
"""

FLOODS = """
import os, can
bus = can.Bus(interface="hil_unix", channel=os.environ["CHANNEL"])
print("ready", flush=True)
input()
for number in range(int(os.environ["N"])):
    bus.send(can.Message(arbitration_id=1, data=number.to_bytes(8, "little"), is_extended_id=False))
bus.shutdown()
"""


def test_a_flood_between_two_processes_arrives_whole_and_in_order(
    bus_hub: HostedHub,  # noqa: F811
) -> None:
    env = {"CHANNEL": bus_hub.path, "N": str(FLOOD)}
    with raw_end(bus_hub.path) as reader, other_process(FLOODS, **env) as sender:
        assert sender.stdin is not None
        sender.stdin.write("go\n")
        sender.stdin.flush()
        reader.settimeout(10.0)
        assert numbers(reader, FLOOD) == list(range(FLOOD))


def test_two_floods_are_seen_in_the_same_order_by_all(bus_hub: HostedHub) -> None:  # noqa: F811
    n = 5000
    env = {"CHANNEL": bus_hub.path, "N": str(n)}
    with (
        raw_end(bus_hub.path) as first,
        raw_end(bus_hub.path) as second,
        other_process(FLOODS, **env) as a,
        other_process(FLOODS, **env) as b,
    ):
        for sender in (a, b):
            assert sender.stdin is not None
            sender.stdin.write("go\n")
            sender.stdin.flush()
        seen = numbers(first, 2 * n)
        assert numbers(second, 2 * n) == seen
        assert sorted(seen) == sorted(2 * list(range(n)))


def test_the_hosts_answers_come_in_order(can_channel: str) -> None:  # noqa: F811
    with other_process(HOST, CHANNEL=can_channel), unix_bus(can_channel) as bus:
        for number in range(500):
            data = number.to_bytes(2, "little")
            bus.send(can.Message(arbitration_id=0x10, data=data, is_extended_id=False))
            got = bus.recv(2.0)
            assert got is not None
            assert (got.arbitration_id, bytes(got.data)) == (0x11, data)


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_with_a_bit_rate_frames_take_at_least_their_time(
    can_channel: str,  # noqa: F811
    speed: float,
) -> None:
    with (
        hub_thread(can_channel, bitrate=1e6, speed=speed),
        raw_end(can_channel) as a,
        raw_end(can_channel) as b,
    ):
        begun = time.monotonic()
        for number in range(300):
            a.send(frame(1, number))
            assert numbers(b, 1) == [number]
        assert time.monotonic() - begun > 300 * 135e-6 / speed


def test_a_killed_host_is_noticed_and_its_channel_taken_over(can_channel: str) -> None:  # noqa: F811
    with other_process(HOST, CHANNEL=can_channel) as host:
        with pytest.raises(PluginError, match=f"in use: pid {host.pid} "):
            Hub(can_channel)
        with unix_bus(can_channel) as bus:
            os.kill(host.pid, signal.SIGKILL)
            host.wait()
            with pytest.raises(can.CanOperationError, match="the hub closed the connection"):
                bus.recv(2.0)
    assert Path(can_channel).is_socket()  # left behind
    with Hub(can_channel) as hub:
        raw_end(can_channel).close()
        hub.serve()


def test_a_killed_participant_is_forgotten(bus_hub: HostedHub) -> None:  # noqa: F811
    with other_process(FLOODS, CHANNEL=bus_hub.path, N="1") as gone:
        assert bus_hub.ask(lambda hub: [peer.pid for peer in hub.peers]) == [gone.pid]
        os.kill(gone.pid, signal.SIGKILL)
        gone.wait()
        until = time.monotonic() + 2.0
        while bus_hub.ask(lambda hub: hub.peers) and time.monotonic() < until:
            time.sleep(0.01)
    assert bus_hub.ask(lambda hub: hub.peers) == ()
