"""What crosses the line to a driver's process: frames, errors, and what is neither."""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.core import errors
from hil.core.errors import (
    HilError,
    RobotConnectionError,
    RobotError,
    RobotFault,
    RobotTimeout,
    SpecError,
)
from hil.robot import state_dtype
from hil.robot.ipc import (
    MAGIC,
    MOST_BODY,
    MOST_HEADER,
    PREFIX,
    EndOfLine,
    Line,
    error_document,
    error_from,
    pack,
    plain_options,
    unpack,
)


@pytest.fixture
def ends() -> Iterator[tuple[Line, socket.socket]]:
    ours, theirs = socket.socketpair()
    line = Line(ours)
    with theirs:
        yield line, theirs
    line.close()


def parts(frame: bytes) -> tuple[bytes, bytes]:
    _, head, body = PREFIX.unpack_from(frame)
    assert len(frame) == PREFIX.size + head + body
    return frame[PREFIX.size : PREFIX.size + head], frame[PREFIX.size + head :]


def state_rows(count: int) -> np.ndarray:
    rows = np.zeros(count, state_dtype(7))
    rows["q"] = np.random.default_rng(1).normal(size=(count, 7))
    rows["effort"] = np.nan
    rows["segment"] = -1
    return rows


@pytest.mark.parametrize(
    "array",
    [state_rows(16), state_rows(0), np.arange(12.0).reshape(3, 4), np.zeros((2, 0)), np.int16(3)],
    ids=["rows", "no rows", "matrix", "no columns", "scalar"],
)
def test_arrays_arrive_as_they_were(array: np.ndarray) -> None:
    array = np.asarray(array)
    header, (arrived, again) = unpack(*parts(pack({"id": 5, "x": [1, None]}, [array, array])))
    assert header == {"id": 5, "x": [1, None]}
    assert (arrived.dtype, arrived.shape) == (array.dtype, array.shape)
    assert arrived.tobytes() == again.tobytes() == array.tobytes()
    assert arrived.flags.writeable


def test_rows_in_any_memory_layout_can_be_sent() -> None:
    every_second = state_rows(9)[::2]
    _, (arrived,) = unpack(*parts(pack({}, [every_second])))
    assert arrived.tobytes() == every_second.tobytes()


def test_objects_are_not_sent() -> None:
    with pytest.raises(RobotConnectionError, match="cannot be sent"):
        pack({}, [np.array([{}], dtype=object)])


@pytest.mark.parametrize(
    "text", ["|O", "O", "V8", "<U1", '[["q", "|O", []]]', '[["q", "<f8", [-1]]]']
)
def test_no_dtype_but_numbers_is_understood(text: str) -> None:
    head = json.dumps({"arrays": [[text, [1]]]}).encode()
    with pytest.raises(RobotConnectionError, match="invalid message of the driver process"):
        unpack(head, bytes(8))


def test_arrays_that_do_not_fill_the_frame_are_refused() -> None:
    for shape in ([3], [1], [-2], [10**12], ["2"], [2.0], [True, 2]):
        head = json.dumps({"arrays": [["<f8", shape]]}).encode()
        with pytest.raises(RobotConnectionError, match="invalid message of the driver process"):
            unpack(head, bytes(16))


HEADERS = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just("<f8"),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.just("arrays"), inner),
    max_leaves=12,
)


@pytest.mark.thorough
@settings(deadline=None, max_examples=300)
@given(
    head=st.binary(max_size=60) | HEADERS.map(lambda h: json.dumps(h).encode()),
    body=st.binary(max_size=40),
)
def test_whatever_comes_is_a_frame_or_an_error_of_ours(head: bytes, body: bytes) -> None:
    try:
        header, arrays = unpack(head, body)
    except RobotConnectionError:
        return
    assert isinstance(header, dict)
    assert sum(array.nbytes for array in arrays) == len(body)


def test_a_deeply_nested_header_is_refused() -> None:
    with pytest.raises(RobotConnectionError, match="invalid message of the driver process"):
        unpack(b"[" * 200_000, b"")


@pytest.mark.parametrize(
    "raw",
    [
        b"Segmentation fault, core dumped",
        struct.pack("<4sII", MAGIC, MOST_HEADER + 1, 0),
        struct.pack("<4sII", MAGIC, 2, MOST_BODY + 1),
    ],
    ids=["text", "long header", "long body"],
)
def test_garbage_ends_the_line_and_nothing_is_read_for_it(
    ends: tuple[Line, socket.socket], raw: bytes
) -> None:
    line, other = ends
    other.sendall(raw)
    with pytest.raises(RobotConnectionError, match="invalid message of the driver process"):
        line.receive(1.0)
    other.sendall(pack({"id": 1}))
    with pytest.raises(RobotConnectionError, match="out of step"):
        line.receive(1.0)


def test_a_frame_may_come_byte_by_byte_and_over_several_time_outs(
    ends: tuple[Line, socket.socket],
) -> None:
    line, other = ends
    frame = pack({"id": 9}, [np.arange(3.0)])
    for i in range(len(frame) - 1):
        other.sendall(frame[i : i + 1])
        if i % 10 == 0:
            with pytest.raises(RobotTimeout):
                line.receive(0.0)
    other.sendall(frame[-1:])
    header, (array,) = line.receive(0.0)
    assert (header, array.tolist()) == ({"id": 9}, [0.0, 1.0, 2.0])


def test_frames_that_come_together_are_told_apart(ends: tuple[Line, socket.socket]) -> None:
    line, other = ends
    other.sendall(pack({"id": 1}) + pack({"id": 2}))
    assert [line.receive(1.0)[0]["id"] for _ in range(2)] == [1, 2]


def test_the_end_of_the_line_is_told(ends: tuple[Line, socket.socket]) -> None:
    line, other = ends
    other.sendall(pack({"id": 1})[:-1])
    other.close()
    with pytest.raises(EndOfLine):
        line.receive(1.0)
    with pytest.raises(EndOfLine):
        line.send(pack({"id": 2}), 1.0)


def test_a_line_that_is_cut_wakes_who_receives_on_it(ends: tuple[Line, socket.socket]) -> None:
    line, _ = ends
    threading.Timer(0.05, line.cut).start()
    with pytest.raises(EndOfLine):
        line.receive(5.0)


def test_who_is_gone_is_gone_whatever_is_sent_next(ends: tuple[Line, socket.socket]) -> None:
    """A line that has ended is not one that is out of step: the next call asks who died."""
    line, other = ends
    other.close()
    for _ in range(3):
        with pytest.raises(EndOfLine):
            line.send(pack({"call": "stop"}))


def test_what_the_other_side_does_not_take_times_out(ends: tuple[Line, socket.socket]) -> None:
    line, _ = ends
    with pytest.raises(RobotTimeout, match="has not taken"):
        line.send(pack({}, [np.zeros(1_000_000)]), 0.05)
    with pytest.raises(RobotConnectionError, match="out of step"):
        line.send(pack({}), 0.05)


OURS = [
    kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, HilError)
]


@pytest.mark.parametrize("kind", OURS)
def test_every_error_of_ours_arrives_as_itself(kind: type[HilError]) -> None:
    sent = json.dumps(error_document(kind("what", hint="how"), "read"))
    arrived = error_from(json.loads(sent))
    assert type(arrived) is kind
    assert (str(arrived), arrived.hint) == (str(kind("what", hint="how")), "how")


def test_a_drivers_own_error_arrives_as_what_it_specialises() -> None:
    class JointOnFire(RobotFault):
        pass

    assert type(error_from(error_document(JointOnFire("hot"), "read"))) is RobotFault


def test_an_unexpected_error_arrives_with_the_end_of_its_traceback() -> None:
    try:
        raise KeyError("no such register")
    except KeyError as error:
        arrived = error_from(error_document(error, "prepare"))
    assert type(arrived) is RobotError
    assert "prepare: unexpected KeyError: 'no such register'" in str(arrived)
    assert 'raise KeyError("no such register")' in str(arrived)


@pytest.mark.parametrize("kind", ["SystemExit", "annotations", "exit_code_of", "Nonsense", ""])
def test_an_unknown_class_becomes_a_robot_error(kind: str) -> None:
    assert type(error_from({"kind": kind, "message": "m", "hint": ""})) is RobotError


def test_options_of_a_station_file_cross_unchanged() -> None:
    options = {"a": [1, 2.5, None], "b": {"c": "text", "d": True}}
    assert plain_options(options) == options


@pytest.mark.parametrize("value", [np.float64, {1: 2}, [object()], {"x": b""}])
def test_an_option_that_json_cannot_hold_is_refused_with_its_place(value: object) -> None:
    with pytest.raises(SpecError, match=r"option address\b.*cannot be sent"):
        plain_options({"address": value})
