"""Frames with one call of the kernel, and one by one where it has none: the same on the line."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from hil.can import bursts
from hil.can.bursts import MOST, Burst, Catch
from hil.can.frames import pack_frame

FRAMES = [pack_frame(0x80, b"")] + [pack_frame(0x200 + n, bytes([n] * n)) for n in range(1, 7)]

Ends = tuple[socket.socket, socket.socket]


@pytest.fixture
def ends() -> Iterator[Ends]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        yield ours, theirs


@pytest.fixture(autouse=True, params=["one call", "one by one"])
def kernel(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "one by one":
        monkeypatch.setattr(bursts, "_send_many", None)
        monkeypatch.setattr(bursts, "_receive_many", None)
    elif bursts._send_many is None:
        pytest.skip("this C library has no sendmmsg")


def burst() -> Burst:
    return Burst([bytearray(frame) for frame in FRAMES])


def test_every_frame_of_a_burst_is_a_packet(ends: Ends) -> None:
    assert burst().send(ends[0]) == len(FRAMES)
    assert [ends[1].recv(100) for _ in FRAMES] == FRAMES


def test_the_first_of_a_burst_can_be_sent_without_the_others(ends: Ends) -> None:
    assert burst().send(ends[0], 3) == 3
    assert Catch().take(ends[1]) == FRAMES[:3]


def test_those_for_which_there_was_no_room_are_the_last_ones(ends: Ends) -> None:
    ends[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4608)
    many = [pack_frame(0x100, bytes([n])) for n in range(200)]
    sent = Burst([bytearray(frame) for frame in many]).send(ends[0])
    assert 0 < sent < len(many)
    assert Catch(len(many)).take(ends[1]) == many[:sent]


def test_a_full_line_takes_none_and_is_no_error(ends: Ends) -> None:
    one = burst()
    while one.send(ends[0]):
        pass
    assert one.send(ends[0]) == 0


def test_a_line_that_is_gone_is_an_error(ends: Ends) -> None:
    ends[1].close()
    with pytest.raises(OSError, match="pipe"):
        burst().send(ends[0])


def test_nothing_is_there_yet(ends: Ends) -> None:
    assert Catch().take(ends[0]) == []


def test_no_more_than_asked_for_are_taken(ends: Ends) -> None:
    burst().send(ends[1])
    take = Catch(4).take
    assert [take(ends[0]), take(ends[0])] == [FRAMES[:4], FRAMES[4:]]
    assert len(FRAMES) <= MOST


def test_frames_before_the_end_of_the_line_are_taken_first(ends: Ends) -> None:
    burst().send(ends[1])
    ends[1].close()
    catch = Catch()
    assert catch.take(ends[0]) == FRAMES
    with pytest.raises(ConnectionError, match="closed the connection"):
        catch.take(ends[0])


def test_frames_of_one_who_left_without_reading_are_taken(ends: Ends) -> None:
    ends[0].send(FRAMES[0])  # stays unread: the end will be a reset
    burst().send(ends[1])
    ends[1].close()
    assert Catch().take(ends[0]) == FRAMES


@pytest.mark.parametrize("packet", [b"xyz", bytes(17), bytes(100)])
def test_what_is_no_frame_is_an_error_after_the_frames_before_it(ends: Ends, packet: bytes) -> None:
    for each in (FRAMES[0], packet, FRAMES[1]):
        ends[1].send(each)
    catch = Catch()
    assert catch.take(ends[0]) == FRAMES[:1]
    for _ in range(2):
        with pytest.raises(ConnectionError, match="not a frame"):
            catch.take(ends[0])
