"""The TwinCAT driver's parts, and the mock PLC's, without a socket between them."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from hil.core.errors import RobotConnectionError, SpecError
from hil.robot import Segment
from hil_drivers.twincat.options import options_of
from hil_drivers.twincat.reading import HostClock, Ring, state_rows
from hil_drivers.twincat.variables import CONTRACT, REASONS, layout_of, set_points, sums_of, upload
from hil_drivers.twincat.variables import Result as DriversResult
from hil_mock_robot.twincat import program
from hil_mock_robot.twincat.faults import PlcFault, Target
from hil_mock_robot.twincat.memory import Memory, contract, declared_in
from hil_mock_robot.twincat.program import Ramp, Trajectory

LAYOUT = layout_of(6)
ROWS = 1000


class FakeRing:
    """A ring in the PLC that is written between, or during, reads."""

    def __init__(self, rows=ROWS, chunk_bytes=100 * 424):
        self.rows = np.zeros(rows, LAYOUT.row)
        self.head = 0
        self.reads = []
        self.before = self.after = lambda: None
        self.ring = Ring(self.read, LAYOUT.row, rows, chunk_bytes)

    def write(self, count):
        number = np.arange(self.head, self.head + count, dtype=np.uint64)
        at = number % np.uint64(len(self.rows))
        self.rows["nSequence"][at] = self.rows["nSequenceEnd"][at] = number
        self.head += count

    def read(self, start, size):
        self.reads.append(size)
        self.before()
        data = self.rows.tobytes()[start : start + size]
        self.after()
        return data

    def pull(self):
        return self.ring.pull(self.head)["nSequence"].astype(int).tolist()


def test_every_row_comes_once_and_in_order_also_where_the_ring_turns():
    plc, seen = FakeRing(), []
    for count in (1, 130, 999, 1000, 3, 400, 700):
        plc.write(count)
        seen += plc.pull()
    assert seen == list(range(plc.head))
    assert (plc.ring.gaps, plc.ring.lost) == (0, 0)


def test_no_request_is_longer_than_it_may_be():
    plc = FakeRing(chunk_bytes=10 * 424)
    plc.write(95)
    plc.pull()
    assert max(plc.reads) == 10 * 424


def test_rows_that_were_overwritten_are_a_gap_that_is_counted():
    plc = FakeRing()
    plc.write(10)
    plc.pull()
    plc.write(2500)
    seen = plc.pull()
    assert seen == list(range(seen[0], plc.head))
    assert plc.ring.gaps == 1
    assert plc.ring.lost == seen[0] - 10 > 1500


def test_a_reader_that_is_overtaken_while_it_reads_counts_that_too():
    plc = FakeRing()
    plc.write(ROWS)

    def overtake():
        plc.before = lambda: None
        plc.write(700)

    plc.before = overtake
    seen = plc.pull() + plc.pull()
    assert seen == list(range(seen[0], plc.head))
    assert plc.ring.gaps == 1
    assert plc.ring.lost == seen[0]


@pytest.mark.parametrize(("behind", "lost"), [(0, 0), (1, 1 + 256)])
def test_a_ring_that_is_just_full_has_lost_nothing_and_one_row_later_it_has(behind, lost):
    """After an overrun the rows that are gone by the time they are read are given up, too."""
    plc = FakeRing()
    plc.write(ROWS + behind)
    seen = plc.pull()
    assert seen == list(range(lost, plc.head))
    assert (plc.ring.gaps, plc.ring.lost) == (min(lost, 1), lost)
    assert sum(plc.reads) == len(seen) * LAYOUT.row.itemsize  # nothing that is gone was asked for


def test_a_row_that_is_being_written_is_read_again():
    plc = FakeRing()
    plc.write(50)
    plc.rows["nSequenceEnd"][20] = 7

    def whole():
        plc.rows["nSequenceEnd"][20] = 20

    plc.after = whole
    assert plc.pull() == list(range(50))
    assert plc.ring.torn == 1


def test_a_row_that_stays_torn_is_an_error_and_not_data():
    plc = FakeRing()
    plc.write(50)
    plc.rows["nSequence"][0] = 7
    with pytest.raises(RobotConnectionError, match="row 0 of the PLC's ring buffer is invalid"):
        plc.pull()


def test_a_program_that_was_started_anew_is_told():
    plc = FakeRing()
    plc.write(50)
    plc.pull()
    with pytest.raises(RobotConnectionError, match="was restarted: it has written 3 rows, 50 were"):
        plc.ring.pull(3)


def test_driver_and_structured_text_lay_out_the_same_memory():
    declared = contract()
    assert set(LAYOUT.types) == set(declared.variables)
    for name, kind in LAYOUT.types.items():
        told = declared.variables[name][1]
        assert (told.subdtype[0] if told.subdtype else told) == kind, name
    assert declared.initial == {"nContract": CONTRACT}


def test_driver_and_mock_mean_the_same_by_every_result():
    mock = {each.name: each.value for each in program.Result}
    assert {each.name: each.value for each in DriversResult} == mock
    assert set(REASONS) == set(mock.values()) - {0}


def test_a_structure_that_packings_would_lay_out_differently_is_no_contract():
    text = "TYPE ST_X : STRUCT a : UDINT; b : LREAL; END_STRUCT END_TYPE"
    with pytest.raises(Exception, match=r"structure ST_X .* needs padding"):
        declared_in(text)


def test_variables_do_not_overlap():
    symbols = sorted(Memory().symbols.values(), key=lambda symbol: symbol.offset)
    for before, after in itertools.pairwise(symbols):
        assert before.offset + before.size <= after.offset


def some_segment(n=500):
    t = np.linspace(0, 1, n)[:, None] * np.ones(6)
    return Segment(1, "trajectory", np.sin(t), np.cos(t), -np.sin(t), 1.0, 1.0)


def test_the_sums_are_those_that_the_plc_adds_up_word_by_word():
    rows = set_points(some_segment(), LAYOUT.set_point)
    assert sums_of(rows) == program.sums_of(rows)
    a = b = 0
    for word in np.frombuffer(rows[:20].tobytes(), "<u4").tolist():
        a = (a + word) % 2**32
        b = (b + a) % 2**32
    assert sums_of(rows[:20]) == (a, b)


@pytest.mark.parametrize(("i", "k"), [(3, 4), (10, 18), (0, 499)])
def test_rows_that_are_exchanged_have_other_sums(i, k):
    rows = set_points(some_segment(), LAYOUT.set_point)
    before = sums_of(rows)
    rows[[i, k]] = rows[[k, i]]
    assert sums_of(rows) != before


def test_an_upload_arrives_whole_in_chunks():
    rows = set_points(some_segment(), LAYOUT.set_point)
    memory, sizes = bytearray(rows.nbytes), []

    def write(data, start):
        sizes.append(len(data))
        memory[start : start + len(data)] = data

    upload(rows, write, 10_000)
    assert bytes(memory) == rows.tobytes()
    assert max(sizes) <= 10_000
    assert len(sizes) > 5


def info():
    told = Memory().view("stInfo")[0]
    told["aQMin"], told["aQMax"], told["aQdMax"], told["aQddMax"] = -3, 3, 2, 10
    return told


def resting(n=200):
    """From 0 to 0.2 rad and at rest at both ends, at 1 kHz."""
    rows = np.zeros(n, LAYOUT.set_point)
    t = np.arange(n)[:, None] / (n - 1)
    rows["aQ"] = 0.1 * (1 - np.cos(np.pi * t)) * np.ones(6)
    rows["aQd"] = 0.1 * np.pi * np.sin(np.pi * t) / (n / 1000)
    return rows


SPOILT = {
    "NO_NUMBER": ("aQdd", 50, np.nan),
    "ELSEWHERE": ("aQ", 0, 0.01),
    "NOT_AT_REST": ("aQd", -1, 0.5),
    "POSITION": ("aQ", 50, 3.1),
    "VELOCITY": ("aQd", 50, 2.1),
    "ACCELERATION": ("aQdd", 50, 11.0),
    "JUMP": ("aQ", 50, 0.2),
}


@pytest.mark.parametrize("result", SPOILT)
def test_the_plc_refuses_what_an_arm_must_not_do_and_names_the_axis(result):
    rows = resting()
    assert program.refusal_of(rows, info(), np.zeros(6), 1e-3) == (program.Result.DONE, -1)
    name, at, value = SPOILT[result]
    rows[name][at, 4] = value
    told = program.refusal_of(rows, info(), np.zeros(6), 1e-3)
    assert told == (program.Result[result], 4)


def test_a_ramp_brings_all_joints_to_rest_together_with_no_step_in_position():
    setpoint = np.array([[0.1] * 6, [1.0, -0.5, 0, 0, 0.2, 0.1], [0.0] * 6])
    ramp, path = Ramp(setpoint, 8.0, 1e-3), [setpoint[None]]
    while len(block := ramp.next(7)):
        path.append(block)
    path = np.concatenate(path)
    assert len(path) - 1 == 125  # 1 rad/s over 8 rad/s²
    assert not path[-1, 1].any()
    assert np.abs(np.diff(path[:, 1], axis=0)).max() == pytest.approx(8e-3)
    assert np.diff(path[:, 0], axis=0) == pytest.approx(
        (path[1:, 1] + path[:-1, 1]) / 2 * 1e-3, abs=1e-12
    )
    assert path[-1, 0, 0] == pytest.approx(0.1 + 1.0 / 16)


def test_a_trajectory_is_played_as_it_is_however_the_cycles_are_cut():
    rows = np.random.default_rng(1).normal(size=(50, 3, 6))
    played, course = [], Trajectory(rows)
    while len(block := course.next(7)):
        played.append(block)
    assert np.array_equal(np.concatenate(played), rows)


def test_what_the_plc_does_not_measure_is_not_a_number():
    raw = np.zeros(3, LAYOUT.row)
    raw["nTimeNs"] = [0, 1_000_000, 2_000_000]
    rows = state_rows(raw, offers=0)
    assert np.isnan(rows["temperature"]).all()
    assert np.isnan(rows["effort_target"]).all()
    assert rows["device_time"] == pytest.approx([0, 0.001, 0.002])
    assert not np.isnan(state_rows(raw, offers=3)["temperature"]).any()


def test_host_times_rise_row_by_row_however_blocks_come():
    clock, told = HostClock(), []
    for first, count, now in ((0, 100, 10.0), (100, 1, 10.0011), (101, 250, 10.26)):
        rows = state_rows(np.zeros(count, LAYOUT.row), 0)
        rows["device_time"] = (first + np.arange(count)) * 1e-3
        clock.stamp(rows, now, 1e-3)
        told += rows["host_time"].tolist()
    assert (np.diff(told) > 0).all()
    assert told[0] == pytest.approx(9.901)
    assert told[-1] == pytest.approx(10.26)


LOOPBACK = {"address": "127.0.0.1"}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "needs the option address"),
        ({"address": "192.168.0.7"}, "needs the option ams_net_id"),
        ({"address": "5.1.2"}, "address is '5.1.2'"),
        (LOOPBACK | {"ams_net_id": "1.2.3"}, "ams_net_id is '1.2.3'"),
        (LOOPBACK | {"ams_net_id": "1.2.3.4.1.256"}, "ams_net_id is"),
        (LOOPBACK | {"local_net_id": "1.2.3"}, "local_net_id is '1.2.3'"),
        (LOOPBACK | {"chunk_bytes": 262_145}, "chunk_bytes is 262145"),
        (LOOPBACK | {"rate": 500}, "no option rate"),
        (LOOPBACK | {"rate_hz": 1e6}, "rate_hz is 1000000.0"),
        (LOOPBACK | {"block_rows": 1.5}, "block_rows is 1.5"),
        (LOOPBACK | {"effort": "force"}, "effort is 'force'"),
        (LOOPBACK | {"prefix": "GVL Hil"}, "prefix is 'GVL Hil'"),
        (LOOPBACK | {"drive_gains_nm_a": [1, 2]}, "drive_gains_nm_a is"),
    ],
)
def test_an_option_that_cannot_be_is_named(given, said):
    with pytest.raises(SpecError, match=said):
        options_of(given, "lab6")


def test_one_plc_is_one_resource_however_it_is_written_and_whatever_arm_of_it():
    written = (
        {"address": "PLC-7.lab", "ams_net_id": "5.1.2.3.1.1"},
        {"address": "192.168.0.7:48898", "ams_net_id": "05.1.2.3.1.1", "prefix": "gvl_hil"},
        {"address": "192.168.0.7", "ams_net_id": "5.1.2.3.1.1", "port": 852, "prefix": "GVL_B"},
    )
    assert len({options_of(each, "lab6").resource for each in written}) == 1


def test_of_two_faults_of_a_kind_the_last_to_end_puts_things_right():
    links = SimpleNamespace(silent=False)
    mock = Target(None, None, links)
    long, short = PlcFault.make("silence"), PlcFault.make("silence", for_s=1.0)
    long.begin(mock)
    short.begin(mock)
    short.end(mock)
    assert links.silent
    long.end(mock)
    assert not links.silent
