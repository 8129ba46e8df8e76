"""`hil_unix` as users of python-can and canopen meet it, and where its channels live."""

from __future__ import annotations

import asyncio
import os
import queue
import select
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest
from canopen.objectdictionary import ODVariable

from hil.can import channels
from hil.can.channels import named_channels, socket_path
from hil.can.frames import FRAME, pack_frame
from hil.can.hub import HostedHub, Hub, hub_thread
from hil.can.unix import UnixBus
from hil.core.errors import PluginError
from tests.support.canbus_parts import (  # noqa: F401
    bus_hub,
    can_channel,
    raw_end,
    unix_bus,
)
from tests.support.in_time import InTime, measured_again


@pytest.fixture
def pair(bus_hub: HostedHub) -> Iterator[tuple[can.BusABC, can.BusABC]]:  # noqa: F811
    with unix_bus(bus_hub.path) as a, unix_bus(bus_hub.path) as b:
        yield a, b


def message(can_id: int = 0x181, data: bytes = b"12345678", **more: bool) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **more})


def test_python_can_finds_the_interface() -> None:
    assert "hil_unix" in can.VALID_INTERFACES


def test_a_message_arrives_as_it_was_sent(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    sent = [
        message(0x7FF, b""),
        message(0x181, b"\x00\xff"),
        message(0x12345678, b"12345678", is_extended_id=True),
        can.Message(arbitration_id=0x701, is_extended_id=False, is_remote_frame=True, dlc=1),
    ]
    before = time.time()
    for each in sent:
        a.send(each)
    for each in sent:
        got = b.recv(1.0)
        assert got is not None
        assert got.equals(each, timestamp_delta=None, check_channel=False)
        assert before <= got.timestamp <= time.time()


def test_nobody_hears_itself(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    a.send(message(1))
    assert b.recv(1.0) is not None
    assert a.recv(0) is None


@measured_again
def test_reading_waits_no_longer_than_told(pair: tuple[can.BusABC, can.BusABC]) -> None:
    asked = InTime()
    assert pair[0].recv(0.05) is None
    assert time.monotonic() - asked.at > 0.04
    asked.require(1.0)


def test_filters_pass_what_they_name(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    b.set_filters([{"can_id": 0x180, "can_mask": 0x780}])
    for can_id in (0x80, 0x181, 0x281, 0x182):
        a.send(message(can_id))
    got = [b.recv(1.0), b.recv(1.0)]
    assert [each.arbitration_id for each in got if each] == [0x181, 0x182]


def test_it_can_be_selected(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    assert select.select([b], [], [], 0)[0] == []
    a.send(message())
    assert select.select([b], [], [], 1.0)[0] == [b]


def test_a_notifier_is_told_in_order(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair
    got: queue.SimpleQueue[int] = queue.SimpleQueue()
    with can.Notifier(b, [lambda each: got.put(each.arbitration_id)], timeout=0.05):
        for can_id in range(200):
            a.send(message(can_id))
        assert [got.get(timeout=2.0) for _ in range(200)] == list(range(200))


def test_a_notifier_in_asyncio_is_told(pair: tuple[can.BusABC, can.BusABC]) -> None:
    a, b = pair

    async def first() -> can.Message:
        reader = can.AsyncBufferedReader()
        with can.Notifier(b, [reader], loop=asyncio.get_running_loop()):
            a.send(message(0x123))
            return await asyncio.wait_for(reader.get_message(), 2.0)

    assert asyncio.run(first()).arbitration_id == 0x123


def test_canopen_reads_and_writes_objects_over_it(can_channel: str) -> None:  # noqa: F811
    objects = canopen.ObjectDictionary()
    speed = ODVariable("speed", 0x2000)
    speed.data_type = canopen.objectdictionary.UNSIGNED32
    objects.add_object(speed)
    master, slave = canopen.Network(), canopen.Network()
    master.NOTIFIER_CYCLE = slave.NOTIFIER_CYCLE = 0.05
    with hub_thread(can_channel):
        master.connect(interface="hil_unix", channel=can_channel)
        slave.connect(interface="hil_unix", channel=can_channel)
        try:
            slave.create_node(5, objects)
            node = master.add_node(5, objects)
            node.sdo[0x2000].raw = 123456
            assert node.sdo[0x2000].raw == 123456
            with pytest.raises(canopen.SdoAbortedError, match="0x06020000"):
                node.sdo.upload(0x2001, 0)
        finally:
            master.disconnect()
            slave.disconnect()


def test_raw_and_python_can_ends_understand_each_other(
    pair: tuple[can.BusABC, can.BusABC],
) -> None:
    a, b = pair
    assert isinstance(a, UnixBus)
    a.socket.send(pack_frame(0x181, b"raw"))
    got = b.recv(1.0)
    assert got is not None
    assert (got.arbitration_id, bytes(got.data)) == (0x181, b"raw")
    b.send(message(0x201, b"can"))
    a.socket.settimeout(1.0)
    assert a.socket.recv(FRAME.size) == pack_frame(0x201, b"can")


def test_without_a_hub_it_says_who_hosts_it(can_channel: str) -> None:  # noqa: F811
    with pytest.raises(can.CanInitializationError, match="has no host") as raised:
        unix_bus(can_channel)
    assert can_channel in str(raised.value)
    assert "hil mock can" in str(raised.value)


def test_the_socket_of_a_dead_hub_says_the_same(can_channel: str) -> None:  # noqa: F811
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:
        left.bind(can_channel)
    with pytest.raises(can.CanInitializationError, match="refused"):
        unix_bus(can_channel)


def test_a_name_that_is_none_is_refused() -> None:
    with pytest.raises(can.CanInitializationError, match="not a valid channel"):
        unix_bus("no/name")


def test_when_the_hub_ends_both_directions_say_so(can_channel: str) -> None:  # noqa: F811
    with hub_thread(can_channel) as hub:
        bus = unix_bus(can_channel)
        hub.ask(lambda _: None)  # it was accepted
    with bus:
        for _ in range(2):
            with pytest.raises(can.CanOperationError, match="the hub closed the connection"):
                bus.recv(1.0)
        with pytest.raises(can.CanOperationError, match="the hub closed the connection"):
            bus.send(message())


def test_off_the_bus_sending_fails_until_it_is_let_back(
    bus_hub: HostedHub,  # noqa: F811
    pair: tuple[can.BusABC, can.BusABC],
) -> None:
    a, b = pair
    bus_hub.ask(lambda hub: hub.bus_off(hub.peers[0]))
    told = a.recv(1.0)
    assert told is not None
    assert told.is_error_frame
    assert a.state is can.BusState.ERROR
    with pytest.raises(can.CanOperationError, match="off the bus"):
        a.send(message())
    bus_hub.ask(Hub.recover)
    assert a.recv(1.0) is not None
    assert a.state is can.BusState.ACTIVE
    a.send(message(0x42))
    got = b.recv(1.0)
    assert got is not None
    assert got.arbitration_id == 0x42


def test_too_much_for_the_bit_rate_is_an_error_of_the_sender(can_channel: str) -> None:  # noqa: F811
    with hub_thread(can_channel, bitrate=10e3), unix_bus(can_channel) as bus:
        for _ in range(100):
            bus.send(message())
        told = bus.recv(1.0)
        assert told is not None
        assert told.is_error_frame
        with pytest.raises(can.CanOperationError, match="transmit queue full, 1 frames"):
            bus.send(message())
        bus.send(message())  # said once


def send_for_ever(bus: can.BusABC) -> None:
    while True:
        bus.send(message(), timeout=0.05)


def test_when_nobody_takes_its_frames_sending_gives_up(can_channel: str) -> None:  # noqa: F811
    with (
        Hub(can_channel),  # it does not serve
        unix_bus(can_channel) as bus,
        pytest.raises(can.CanOperationError, match="transmit queue full"),
    ):
        send_for_ever(bus)


def test_can_fd_is_refused(pair: tuple[can.BusABC, can.BusABC]) -> None:
    with pytest.raises(ValueError, match="not CAN FD"):
        pair[0].send(can.Message(is_fd=True, data=bytes(12)))


def test_channels_of_this_user_are_detected(
    can_channel: str,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(Path(can_channel).parent))
    with hub_thread("lab"):
        assert can.detect_available_configs("hil_unix") == [
            {"interface": "hil_unix", "channel": "lab"}
        ]
        with can.Bus(interface="hil_unix", channel="lab", bitrate=1_000_000):
            pass


# Where channels live, and who may host them.


@pytest.fixture
def above(can_channel: str, monkeypatch: pytest.MonkeyPatch) -> Path:  # noqa: F811
    """The folder in which the runtime folder will be."""
    folder = Path(can_channel).parent
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


def test_a_name_is_a_socket_in_a_folder_of_this_user_alone(above: Path) -> None:
    with Hub("can0") as hub:
        assert hub.path == above / f"hil-can-{os.getuid()}" / "can0.sock"
        assert stat.S_IMODE(hub.path.parent.stat().st_mode) == 0o700
        assert stat.S_IMODE(hub.path.stat().st_mode) == 0o600
        assert named_channels() == ["can0"]
    assert named_channels() == []


def test_without_a_runtime_folder_the_temporary_one_is_used(
    above: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr(channels.tempfile, "gettempdir", lambda: str(above))
    assert socket_path("can1").parent.parent == above


@pytest.mark.parametrize("name", ["", "../can0", "a/b", ".hidden", "can 0", "can\x00", "-x"])
def test_what_is_no_name_is_refused(name: str) -> None:
    with pytest.raises(PluginError, match="not a valid channel"):
        socket_path(name)


def test_a_path_too_long_for_a_socket_is_refused() -> None:
    with pytest.raises(PluginError, match="107 bytes"):
        socket_path("/tmp/" + 120 * "x")


def test_a_folder_others_can_get_into_is_refused(above: Path) -> None:
    folder = above / f"hil-can-{os.getuid()}"
    folder.mkdir(mode=0o755)
    with pytest.raises(PluginError, match="other users have access to") as raised:
        Hub("can0")
    assert f"chmod 700 {folder}" in str(raised.value)


def test_a_folder_of_another_user_is_refused(above: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (above / f"hil-can-{os.getuid() + 1}").mkdir(mode=0o700)
    uid = os.getuid() + 1
    monkeypatch.setattr(channels.os, "getuid", lambda: uid)
    with pytest.raises(PluginError, match="belongs to another user"):
        Hub("can0")


def test_a_link_in_place_of_the_folder_is_refused(above: Path) -> None:
    (above / "elsewhere").mkdir(mode=0o700)
    (above / f"hil-can-{os.getuid()}").symlink_to(above / "elsewhere")
    with pytest.raises(PluginError, match="is not a folder"):
        Hub("can0")


def test_a_channel_in_a_missing_folder_is_refused(above: Path) -> None:
    with pytest.raises(PluginError, match="cannot be used: No such file"):
        Hub(above / "missing" / "can.sock")


def test_one_hub_hosts_a_channel_and_the_next_is_told_which(can_channel: str) -> None:  # noqa: F811
    with Hub(can_channel):
        with pytest.raises(PluginError, match="in use: pid ") as raised:
            Hub(can_channel)
        assert str(os.getpid()) in str(raised.value)
        raw_end(can_channel).close()  # still there
    Hub(can_channel).close()


def test_the_socket_of_a_dead_hub_is_replaced(can_channel: str) -> None:  # noqa: F811
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:
        left.bind(can_channel)
    with Hub(can_channel):
        raw_end(can_channel).close()


def test_what_is_no_socket_is_left_alone(can_channel: str) -> None:  # noqa: F811
    Path(can_channel).write_text("precious")
    with pytest.raises(PluginError, match="is not a socket"):
        Hub(can_channel)
    assert Path(can_channel).read_text() == "precious"
    Path(can_channel).unlink()
    Hub(can_channel).close()  # and nothing is held any more


def test_a_closed_hub_leaves_nothing_behind(can_channel: str) -> None:  # noqa: F811
    hub = Hub(can_channel)
    hub.close()
    hub.close()
    assert list(Path(can_channel).parent.iterdir()) == []
