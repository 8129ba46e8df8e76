"""The lossless RTDE reader against a scripted controller, and its rows as robot records."""

from __future__ import annotations

import struct
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.core.errors import RobotConnectionError, RobotTimeout, SpecError
from hil.recording.mcap_writer import require_rows_of
from hil.robot import Status, state_dtype
from hil_drivers.ur.rtde import FIELDS, Cutter, Layout, Receiver, names_for
from hil_drivers.ur.rtde import TYPES as WIRE_TYPES
from hil_drivers.ur.state import (
    further_rows,
    further_topic,
    program_running,
    require_source,
    state_rows,
)
from tests.support import rtde_peer as peer
from tests.support.fuzzing import examples
from tests.support.rtde_peer import Conversation, Peer
from tests.support.waiting import until

NAMES = ("timestamp", "actual_q", "robot_mode", "flag")
TYPES = ("DOUBLE", "VECTOR6D", "INT32", "UINT8")
wire = pytest.mark.wire


def layout() -> Layout:
    return Layout(1, NAMES, TYPES)


def data_package(t: float, *, q: float = 0.0, mode: int = 7, recipe: int = 1) -> bytes:
    return peer.package("U", bytes([recipe]) + struct.pack(">d6diB", t, *[q] * 6, mode, 3))


def cut(data: bytes, cuts: list[int] = []) -> tuple[Cutter, bytes]:  # noqa: B006
    cutter = Cutter(layout(), 125.0)
    return cutter, b"".join(cutter.feed(piece, 1.0) for piece in peer.pieces(data, cuts))


def times(data: bytes) -> list[float]:
    return layout().times(data).tolist()


# --- bytes to rows ---


def test_rows_hold_every_type_in_the_byte_order_of_this_machine():
    rows = layout().rows(data_package(2.0, q=-1.5, mode=-1) + data_package(2.008), [10.0, 11.0])
    assert rows["timestamp"].tolist() == [2.0, 2.008]
    assert rows["host_time"].tolist() == [10.0, 11.0]
    assert rows["actual_q"][0].tolist() == [-1.5] * 6
    assert rows["robot_mode"].tolist() == [-1, 7]
    assert rows["flag"].tolist() == [3, 3]


def test_order_of_widths_does_not_matter():
    mixed = Layout(2, ("timestamp", "flag", "bits", "mode"), ("DOUBLE", "BOOL", "UINT64", "INT32"))
    content = struct.pack(">d?Qi", 1.0, True, 2**40, -5)
    row = mixed.rows(peer.package("U", b"\x02" + content), 0.0)[0]
    assert (row["timestamp"], row["flag"], row["bits"], row["mode"]) == (1.0, 1, 2**40, -5)


@examples(100)
@given(cuts=st.lists(st.integers(0, 10_000), max_size=12))
def test_the_stream_may_be_cut_anywhere(cuts):
    whole = peer.text("hello") + b"".join(data_package(i / 125) for i in range(30))
    whole += peer.package("P", b"\x01") + data_package(30 / 125)
    cutter, data = cut(whole, cuts)
    assert times(data) == [i / 125 for i in range(31)]
    assert (cutter.counts.packages, cutter.counts.texts, cutter.counts.others) == (31, 1, 1)
    assert [str(text) for text in cutter.texts] == ["test: hello"]
    assert cutter.problem is None


@examples(150)
@given(
    noise=st.binary(max_size=200),
    place=st.integers(0, 2000),
    cuts=st.lists(st.integers(0, 3000), max_size=5),
)
def test_whatever_comes_the_states_before_it_are_whole_and_nothing_fails(noise, place, cuts):
    """Also: garbage never becomes a state, unless it looks exactly like one."""
    whole = b"".join(data_package(i / 125, q=i) for i in range(20))
    place %= len(whole)
    _, data = cut(whole[:place] + noise + whole[place:], cuts)
    before = place // layout().size
    assert data[: before * layout().size] == whole[: before * layout().size]
    assert len(data) % layout().size == 0


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (b"\x00\x05\xff\xff\xff", "not an RTDE package"),
        (b"\x00\x02U", "not an RTDE package"),
        (peer.package("U", b"\x01" + b"\0" * 20), "24 bytes instead of 65"),
        (data_package(1.0)[:-1], ""),
        (peer.package("U", b"\x01" + b"\0" * 99), "103 bytes instead of 65"),
        (data_package(1.0, recipe=2), "recipe 2"),
        (data_package(float("nan")), "invalid time stamp nan"),
    ],
)
def test_what_is_no_state_of_ours_ends_the_stream_with_words(bad, says):
    cutter, data = cut(data_package(0.5) + bad)
    assert times(data) == [0.5]
    if says:
        assert cutter.problem is not None
        assert says in cutter.problem[0]
        assert cutter.feed(data_package(2.0), 1.0) == b""
    else:
        assert cutter.problem is None
        assert cutter.torn == len(bad)


def test_a_clock_that_goes_back_is_a_restart_and_keeps_what_was_before():
    stream = [*(100 + i / 125 for i in range(5)), 0.0, 0.008]
    cutter, data = cut(b"".join(map(data_package, stream)))
    assert times(data) == stream[:5]
    assert cutter.problem is not None
    assert "restarted" in cutter.problem[0]
    assert cutter.counts.packages == 5


def test_a_state_out_of_order_is_no_restart():
    cutter, data = cut(b"".join(map(data_package, [1.0, 1.016, 1.008])))
    assert times(data) == [1.0, 1.016]
    assert cutter.problem is not None
    assert "out of order" in cutter.problem[0]


def test_gaps_and_duplicates_are_counted_across_reads():
    stream = [0.0, 0.008, 0.008, 0.016, 0.048, 0.056]
    whole = b"".join(map(data_package, stream))
    cutter, data = cut(whole, [3 * 65, 4 * 65])
    assert times(data) == stream
    assert (cutter.counts.missing, cutter.counts.duplicates) == (3, 1)


# --- the handshake ---


@wire
def test_a_cb3_controller_gives_what_it_has_and_the_rest_is_missing():
    types = {k: v for k, v in peer.types_of_hil().items() if k not in peer.NOT_IN_CB3_3_15}
    del types["payload_inertia"]
    with Peer(peer.stream(3), types) as robot, Receiver("127.0.0.1", port=robot.port) as receiver:
        rows = take(receiver, 3)
        assert receiver.version == peer.CB3
        assert receiver.frequency_hz == 125.0
        assert receiver.missing["payload_inertia"] == "not available in this software"
        assert set(receiver.missing) == {*peer.NOT_IN_CB3_3_15, "payload_inertia"}
        assert "payload_inertia" not in (rows.dtype.names or ())
        assert rows["timestamp"].tolist() == [0.0, 0.008, 0.016]
        assert robot.talks[0].frequency == 125.0
        assert len(robot.talks[0].asked) == 2


@wire
def test_an_e_series_controller_is_asked_for_everything_at_500_hz():
    with (
        Peer(peer.stream(1), version=peer.E_SERIES) as robot,
        Receiver("127.0.0.1", port=robot.port) as receiver,
    ):
        assert receiver.frequency_hz == 500.0
        assert not receiver.missing
        assert set(robot.talks[0].asked[0]) == set(peer.types_of_hil())


@wire
def test_an_output_in_use_is_missing_and_says_so():
    types = peer.types_of_hil() | {"payload": "IN_USE", "payload_cog": "COLOUR"}
    with Peer(peer.stream(1), types) as robot, Receiver("127.0.0.1", port=robot.port) as receiver:
        assert "another RTDE client" in receiver.missing["payload"]
        assert "'COLOUR'" in receiver.missing["payload_cog"]


@wire
def test_without_position_there_is_nothing_to_record():
    types = peer.types_of_hil() | {"actual_q": "NOT_FOUND"}
    with Peer(peer.stream(1), types) as robot:
        refuse(robot, "does not send actual_q")


@wire
def test_text_messages_during_the_handshake_are_kept_and_confuse_nothing():
    def script(talk: Conversation) -> None:
        talk.handshake(lambda kind: peer.text(f"before {kind}"))
        talk.send(talk.data(1.0) + peer.text("later"))
        peer.until_gone(talk)

    with Peer(script) as robot, Receiver("127.0.0.1", port=robot.port) as receiver:
        assert receiver.version == peer.CB3
        assert take(receiver, 1)["timestamp"].tolist() == [1.0]
        until(lambda: len(receiver.messages) == 5)
        assert [m.text for m in receiver.messages][::4] == ["before V", "later"]


@wire
@pytest.mark.parametrize("mute_at", ["V", "v", "O", "S"])
def test_a_controller_that_falls_mute_in_the_handshake_is_an_error_in_time(mute_at):
    def script(talk: Conversation) -> None:
        while (said := talk.receive())[0] != mute_at:
            talk.send(talk.answer(*said))
        talk.send(peer.text("safety not confirmed"))
        peer.until_gone(talk)

    with Peer(script) as robot:
        began = time.monotonic()
        refuse(robot, r"(?s)has not answered .* within 0.3 s.*safety not confirmed", step_s=0.3)
        assert time.monotonic() - began < 50.0


@wire
@pytest.mark.parametrize(
    ("at", "instead", "says"),
    [
        ("V", peer.package("V", b"\0"), "does not support RTDE protocol 2"),
        ("V", b"HTTP/1.1 400 Bad Request\r\n\r\n", "not RTDE"),
        ("v", peer.package("v", b"\0" * 8), "8 bytes instead of 16"),
        ("v", peer.package("P", b"\1"), "by a package 'P'"),
        ("O", peer.package("O", b"\1DOUBLE,DOUBLE"), "2 types for"),
        ("S", peer.package("S", b"\0"), "refuses to send"),
        ("S", b"", "closed the connection"),
    ],
)
def test_wrong_answers_are_errors_in_words(at, instead, says):
    def script(talk: Conversation) -> None:
        while (said := talk.receive())[0] != at:
            talk.send(talk.answer(*said))
        talk.send(instead)

    with Peer(script) as robot:
        refuse(robot, says)


@wire
def test_nobody_there_says_where():
    with Peer(peer.stream(1)) as robot:
        port = robot.port
    with pytest.raises(RobotConnectionError, match=f"no RTDE server answers at 127.0.0.1:{port}"):
        Receiver("127.0.0.1", port=port, step_s=0.5).open()


@wire
def test_a_frequency_beyond_the_controllers_is_refused():
    with Peer(peer.stream(1)) as robot:
        refuse(robot, "at most 125", frequency_hz=500)


@wire
def test_close_from_another_thread_ends_the_handshake():
    with Peer(lambda talk: peer.until_gone(talk)) as robot:
        receiver = Receiver("127.0.0.1", port=robot.port, step_s=200)
        threading.Timer(0.2, receiver.close).start()
        began = time.monotonic()
        with pytest.raises(RobotConnectionError):
            receiver.open()
        assert time.monotonic() - began < 100.0


# --- states ---


@wire
def test_every_state_arrives_once_and_in_order_whatever_the_pieces():
    def script(talk: Conversation) -> None:
        talk.handshake()
        data = b"".join(talk.data(i / 125) for i in range(2000))
        for piece in peer.pieces(data, range(0, len(data), 7919)):
            talk.send(piece)
        peer.until_gone(talk)

    with Peer(script) as robot, Receiver("127.0.0.1", port=robot.port) as receiver:
        rows = take(receiver, 2000)
        assert rows["timestamp"].tolist() == [i / 125 for i in range(2000)]
        assert np.all(np.diff(rows["host_time"]) >= 0)
        assert (receiver.counts.packages, receiver.counts.missing) == (2000, 0)
        newest = receiver.newest
        assert newest is not None
        assert newest["timestamp"] == [1999 / 125]


@wire
@pytest.mark.parametrize(
    ("end", "says"),
    [
        (lambda talk: None, "closed the connection after 5 states"),
        (lambda talk: talk.send(talk.data(1.0)[:100]), "in the middle of a package"),
        (lambda talk: talk.send(b"\xde\xad\xbe\xef" * 4), "not an RTDE package: de ad be ef"),
        (lambda talk: talk.send(talk.data(-50.0)), "restarted"),
        (lambda talk: time.sleep(3.0), "been silent"),
    ],
)
def test_the_end_of_states_comes_after_the_last_one_and_stays(end, says):
    with Peer(peer.stream(5, then=end)) as robot:
        receiver = Receiver("127.0.0.1", port=robot.port, silence_s=0.5)
        receiver.open()
        assert len(take(receiver, 5)) == 5
        for _ in range(2):
            with pytest.raises(RobotConnectionError, match=says):
                receiver.take(5.0)
        assert not receiver.alive
        assert receiver.age_s == np.inf
        receiver.close()


@wire
def test_texts_alone_are_silence():
    def script(talk: Conversation) -> None:
        talk.handshake()
        talk.send(talk.data(0.0))
        for _ in range(40):
            talk.send(peer.text("still alive"))
            time.sleep(0.05)

    with Peer(script) as robot, Receiver("127.0.0.1", port=robot.port, silence_s=0.5) as receiver:
        take(receiver, 1)
        with pytest.raises(RobotConnectionError, match=r"(?s)no state for.*still alive"):
            receiver.take(5.0)


@wire
def test_a_slow_robot_is_a_time_out_and_its_age_grows():
    with Peer(peer.stream(1)) as robot, Receiver("127.0.0.1", port=robot.port) as receiver:
        take(receiver, 1)
        with pytest.raises(RobotTimeout, match=r"no state for 0.2 s"):
            receiver.take(0.2)
        assert 0.1 < receiver.age_s < 2.0
        assert receiver.alive


@wire
def test_rows_nobody_takes_wait_in_order_and_too_many_are_an_error_not_a_loss(monkeypatch):
    monkeypatch.setattr("hil_drivers.ur.rtde.PATIENCE_S", 0.3)

    def script(talk: Conversation) -> None:
        talk.handshake()
        for i in range(100_000):
            talk.send(talk.data(i / 125))

    with (
        Peer(script) as robot,
        Receiver("127.0.0.1", port=robot.port, capacity_s=4.0) as receiver,
    ):
        until(lambda: not receiver.alive)
        rows = receiver.take(1.0)
        assert np.array_equal(rows["timestamp"], np.arange(len(rows)) / 125)
        assert 500 <= len(rows) == receiver.counts.packages
        with pytest.raises(RobotConnectionError, match="was not read in time"):
            receiver.take(1.0)


@wire
def test_a_forgiving_queue_lets_go_of_the_oldest_rows_and_goes_on(monkeypatch):
    monkeypatch.setattr("hil_drivers.ur.rtde.PATIENCE_S", 0.05)

    def script(talk: Conversation) -> None:
        talk.handshake()
        for i in range(6000):
            talk.send(talk.data(i / 125))
        peer.until_gone(talk)

    with (
        Peer(script) as robot,
        Receiver("127.0.0.1", port=robot.port, capacity_s=4.0) as receiver,
    ):
        receiver.keep(None, forgiving=True)
        until(lambda: receiver.newest is not None and receiver.newest["timestamp"] == 5999 / 125)
        rows = receiver.take(1.0)
        assert rows["timestamp"][-1] == 5999 / 125
        assert 250 <= len(rows) < 6000
        assert np.diff(rows["timestamp"]) == pytest.approx(1 / 125)


@wire
def test_a_state_that_is_repeated_is_no_news_and_in_the_end_a_lost_connection():
    def script(talk: Conversation) -> None:
        talk.handshake()
        talk.send(talk.data(1.0) + talk.data(1.008))
        while True:
            talk.send(talk.data(1.008))
            time.sleep(0.01)

    with Peer(script) as robot, Receiver("127.0.0.1", port=robot.port, silence_s=1.0) as receiver:
        take(receiver, 2)
        until(lambda: receiver.age_s > 0.3)
        assert len(receiver.take(1.0))
        until(lambda: not receiver.alive)
        receiver.take(1.0)
        with pytest.raises(RobotConnectionError, match=r"with a stopped clock for 1\.\d s"):
            receiver.take(1.0)


@wire
def test_a_full_queue_waits_for_its_reader_and_loses_nothing():
    with (
        Peer(peer.stream(3000)) as robot,
        Receiver("127.0.0.1", port=robot.port, capacity_s=1.0) as receiver,
    ):
        time.sleep(0.3)
        rows = take(receiver, 3000)
        assert np.array_equal(rows["timestamp"], np.arange(3000) / 125)


@wire
def test_close_wakes_a_waiting_reader_and_can_be_repeated():
    with Peer(peer.stream(0)) as robot:
        receiver = Receiver("127.0.0.1", port=robot.port, silence_s=200.0)
        receiver.open()
        threading.Timer(0.2, receiver.close).start()
        began = time.monotonic()
        with pytest.raises(RobotConnectionError, match="closed"):
            receiver.take(200.0)
        assert time.monotonic() - began < 100.0
        receiver.close()
        receiver.close()
        assert not [t for t in threading.enumerate() if t.name.startswith("rtde")]


@wire
def test_after_a_loss_it_can_be_opened_again():
    with Peer(peer.stream(4, then=lambda talk: None)) as robot:
        receiver = Receiver("127.0.0.1", port=robot.port)
        for _ in range(2):
            receiver.open()
            assert len(take(receiver, 4)) == 4
            with pytest.raises(RobotConnectionError):
                receiver.take(5.0)
        receiver.close()
        assert len(robot.talks) == 2


@wire
def test_open_twice_is_one_connection():
    with Peer(peer.stream(2)) as robot, Receiver("127.0.0.1", port=robot.port) as receiver:
        receiver.open()
        assert len(robot.talks) == 1


def test_before_open_everything_says_so():
    receiver = Receiver("127.0.0.1")
    for look in (lambda: receiver.version, lambda: receiver.take(0.1), lambda: receiver.missing):
        with pytest.raises(RobotConnectionError, match="not connected"):
            look()
    assert receiver.newest is None
    assert receiver.age_s == np.inf
    receiver.close()


# --- helpers ---


def take(receiver: Receiver, count: int):
    """At least `count` rows."""
    rows = receiver.take(5.0)
    while len(rows) < count:
        rows = np.concatenate((rows, receiver.take(5.0)))
    return rows


def refuse(robot: Peer, says: str, *, step_s: float = 2.0, frequency_hz: float | None = None):
    receiver = Receiver("127.0.0.1", frequency_hz, robot.port, step_s=step_s)
    with pytest.raises(RobotConnectionError, match=says):
        receiver.open()
    assert not receiver.alive
    receiver.close()


# RTDE rows as the base robot record and the further topic.


FIELD_TYPES = {field.name: field.type for field in FIELDS}
MASKED_FAULT = Status.MASKED | Status.FAULT


def raw(count: int = 1, without: tuple[str, ...] = (), **values: object) -> np.ndarray:
    """Rows as the receiver gives them, of a healthy arm at rest; each output has its own value."""
    names = [name for name in FIELD_TYPES if name not in without]
    rows = np.zeros(count, Layout(1, names, [FIELD_TYPES[name] for name in names]).dtype)
    for number, name in enumerate(names, 1):
        rows[name] = number
    healthy = {"robot_mode": 7, "safety_mode": 1, "runtime_state": 2, "target_qd": 0.0}
    for name, value in (healthy | values).items():
        if name in names:
            rows[name] = value
    return rows


@pytest.mark.parametrize(
    ("field", "output"),
    [
        ("device_time", "timestamp"),
        ("q", "actual_q"),
        ("qd", "actual_qd"),
        ("effort", "actual_current"),
        ("temperature", "joint_temperatures"),
        ("q_target", "target_q"),
        ("qd_target", "target_qd"),
        ("qdd_target", "target_qdd"),
        ("effort_target", "target_current"),
    ],
)
def test_each_output_becomes_its_field(field, output):
    rows = raw(2)
    state = state_rows(rows)
    assert state.dtype == state_dtype(6)
    assert np.array_equal(state[field], rows[output])
    assert state["segment"].tolist() == [-1, -1]


def test_the_torque_source_decides_what_the_effort_is():
    rows = raw()
    torque = state_rows(rows, "current-as-torque")
    assert np.array_equal(torque["effort"], rows["actual_current_as_torque"])
    assert np.array_equal(torque["effort_target"], rows["target_moment"])
    assert np.array_equal(state_rows(rows, "target-moment")["effort"], rows["target_moment"])


def test_a_torque_source_that_the_controller_lacks_is_refused():
    _, missing = names_for(3)
    with pytest.raises(SpecError, match="does not send: not available on a CB3"):
        require_source("current-as-torque", missing)
    require_source("current", missing)


def test_what_is_missing_is_nan_and_no_fault():
    state = state_rows(raw(without=("joint_temperatures", "safety_mode", "robot_mode")))
    assert np.isnan(state["temperature"]).all()
    assert state["status"] == Status.HOLDING
    assert state["fault_code"] == 0


@pytest.mark.parametrize(
    ("values", "status"),
    [
        ({}, Status.HOLDING),
        ({"target_qd": [0, 0, 0, 0.1, 0, 0]}, Status.MOVING),
        ({"safety_mode": 2}, Status.HOLDING),
        ({"safety_mode": 3}, Status.HOLDING | MASKED_FAULT),
        ({"safety_mode": 7, "robot_mode": 3}, Status.HOLDING | MASKED_FAULT),
        ({"robot_mode": 5}, Status.HOLDING | Status.MASKED),
        ({"robot_mode": 6}, Status.HOLDING | Status.MASKED),
    ],
)
def test_status_says_moving_holding_fault_and_what_must_not_be_used(values, status):
    state = state_rows(raw(**values))
    assert state["status"] == status
    safety = values.get("safety_mode", 1)
    assert state["fault_code"] == (safety if safety > 2 else 0)
    assert state["mode"] == values.get("robot_mode", 7)


def test_the_measured_velocity_tells_holding_where_none_is_commanded():
    assert state_rows(raw(without=("target_qd",), actual_qd=0.2))["status"] == Status.MOVING


def test_everything_else_is_recorded_as_it_came_in_a_topic_that_is_always_the_same():
    topic = further_topic(125.0)
    rows = raw(3)
    further = further_rows(rows, topic)
    require_rows_of({topic.name: topic}, topic.name, further)
    told = {"timestamp", "actual_q", "actual_qd", "joint_temperatures"}
    told |= {"target_q", "target_qd", "target_qdd"}
    assert {name.lower() for name in FIELD_TYPES if name not in told} == set(
        further.dtype.names[2:]
    )
    for name in set(FIELD_TYPES) - told:
        assert np.array_equal(further[name.lower()], rows[name]), name


def test_what_the_controller_lacks_is_nan_or_minus_one_in_the_topic():
    lacking = ("payload", "tcp_offset", "safety_status", "script_control_line")
    further = further_rows(raw(without=lacking), further_topic(500.0))[0]
    assert np.isnan(further["payload"])
    assert np.isnan(further["tcp_offset"]).all()
    assert further["safety_status"] == -1
    assert further["script_control_line"] == 2**32 - 1


def test_a_program_runs_until_it_stops_also_while_paused():
    rows = raw(6)
    rows["runtime_state"] = range(6)
    assert program_running(rows).tolist() == [False, False, True, True, True, True]
    assert not program_running(raw(without=("runtime_state",))).any()


def test_fields_are_sorted_by_width_so_that_a_few_copies_make_rows_of_packages():
    widths = [np.dtype(WIRE_TYPES[kind][0]).itemsize for kind in FIELD_TYPES.values()]
    assert widths == sorted(widths, reverse=True)


def test_the_question_for_all_of_them_is_short_enough():
    assert len(",".join(FIELD_TYPES)) < 2048
