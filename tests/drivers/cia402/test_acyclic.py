"""SDO, NMT and the PDO mapping procedure against mock drives, one by one and many at once."""

from __future__ import annotations

import threading
import time

import pytest

from hil.core.errors import CommandRefused, RobotTimeout, SpecError
from hil_drivers.cia402 import can_bus, objects
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.commissioning import errors_of, faults_left, part, unwatch
from hil_drivers.cia402.mapping import ALL_MODES, MINIMAL, POSITION
from hil_drivers.cia402.objects import Aborted, Entry
from hil_drivers.cia402.session import Thermometer
from hil_mock_robot.cia402.dictionary import eds_of
from hil_mock_robot.cia402.keys import key
from tests.support.cia402_drives import drives
from tests.support.in_time import InTime, measured_again

NOT_VALID = 1 << 31


def cob_ids(node, base: int) -> list[int]:
    """COB-IDs of the four PDOs from 1400h or 1800h, without the bit against remote frames."""
    return [node.registers[key(base + k, 1)] & ~(1 << 30) for k in range(4)]


def mapped(node, index: int) -> list[int]:
    count = node.registers[key(index, 0)]
    return [node.registers[key(index, sub)] for sub in range(1, count + 1)]


def test_objects_are_read_and_written_with_their_sign():
    with drives() as line:
        line.nodes[1].registers[key(0x6064)] = -123_456
        assert line.master.upload(1, objects.POSITION) == -123_456
        assert line.master.upload(0, objects.DEVICE_TYPE) == 0x0002_0192
        line.master.download(1, objects.QUICK_STOP_OPTION, 6)
        assert line.nodes[1].registers[key(0x605A)] == 6
        assert line.nodes[0].registers[key(0x605A)] == 2


def test_a_refusal_names_axis_node_object_and_abort():
    with drives() as line:
        with pytest.raises(Aborted) as caught:
            line.master.download(1, objects.STATUSWORD, 5)
        assert str(caught.value) == (
            "joint_2 (node 2): 6041h (statusword) does not accept 5: read-only (abort 0601 0002h)"
        )
        with pytest.raises(
            CommandRefused, match=r"5FFFh:03 \(no such\) cannot be read: no such ob"
        ):
            line.master.upload(0, Entry("no_such", 0x5FFF, 3, "B"))


def test_a_value_that_does_not_fit_is_refused_before_it_is_sent():
    with drives() as line:
        line.sent.clear()
        with pytest.raises(
            CommandRefused, match=r"joint_1 \(node 1\): 70000 does not fit into 6066h"
        ):
            line.master.download(0, objects.FOLLOWING_ERROR_TIMEOUT, 70_000)
        assert line.sent == []


def test_a_drive_that_says_nothing_is_named_with_what_to_look_at(monkeypatch):
    monkeypatch.setattr(can_bus, "ANSWER_S", 0.02)
    with drives() as line:
        line.lost = lambda can_id, _: can_id == 0x582
        with pytest.raises(RobotTimeout, match=r"joint_2 \(node 2\): 6041h .* no answer") as caught:
            line.master.upload(1, objects.STATUSWORD)
        assert "power of the drive" in caught.value.hint
        assert line.master.upload(0, objects.STATUSWORD) is not None


def test_one_lost_answer_is_asked_for_again(monkeypatch):
    monkeypatch.setattr(can_bus, "ANSWER_S", 0.02)
    with drives() as line:
        dropped = []

        def first_only(can_id: int, data: bytes) -> bool:
            dropped.append(can_id)
            return dropped == [0x581]

        line.lost = first_only
        assert line.master.upload(0, objects.DEVICE_TYPE) == 0x0002_0192


def test_threads_that_ask_one_node_at_once_each_get_their_own_answer():
    asked = (objects.DEVICE_TYPE, objects.SERIAL, objects.SUPPORTED_MODES, objects.RATED_CURRENT)
    with drives(1) as line:
        right = {entry: line.master.upload(0, entry) for entry in asked}
        wrong: list[object] = []

        def ask(entry: Entry) -> None:
            for _ in range(40):
                if (told := line.master.upload(0, entry)) != right[entry]:
                    wrong.append((entry, told))

        threads = [threading.Thread(target=ask, args=(entry,)) for entry in asked]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert wrong == []


def test_nmt_states_are_confirmed_by_heartbeats_that_are_switched_on_for_it():
    with drives() as line:
        assert line.nodes[0].registers[key(0x1017)] == 0
        line.master.preoperational()
        assert line.nodes[0].registers[key(0x1017)] == 100
        line.master.operational()
        assert [node.nmt.code for node in line.nodes] == [5, 5]
        line.master.preoperational()
        assert [node.nmt.code for node in line.nodes] == [127, 127]


def test_a_drive_that_does_not_follow_nmt_is_named_with_its_state(monkeypatch):
    monkeypatch.setattr(can_bus, "CONFIRM_S", 0.3)
    with drives() as line:
        line.master.preoperational()
        line.lost = lambda can_id, data: can_id == 0x702 and data == b"\x05"
        with pytest.raises(RobotTimeout, match=r"not operational .*: joint_2 \(node 2\) sends no"):
            line.master.operational()


@pytest.mark.parametrize("mapping", [POSITION, ALL_MODES, MINIMAL])
def test_process_data_lie_as_mapped_and_nothing_else_is_sent(mapping):
    with drives(1) as line:
        line.master.preoperational()
        line.master.map(mapping)
        node = line.nodes[0]
        for base, cob_id, pdos in ((0x1400, 0x201, mapping.rpdos), (0x1800, 0x181, mapping.tpdos)):
            told = cob_ids(node, base)
            assert told[: len(pdos)] == [cob_id + 0x100 * k for k in range(len(pdos))]
            assert all(each & NOT_VALID for each in told[len(pdos) :])
            for k, pdo in enumerate(pdos):
                assert mapped(node, base + 0x200 + k) == [entry.mapped for entry in pdo.entries]
                assert node.registers[key(base + k, 2)] == 1


def test_each_pdo_is_off_while_it_is_laid_out():
    with drives(1) as line:
        line.master.preoperational()
        line.sent.clear()
        line.master.map(POSITION)
        writes = [
            (int.from_bytes(d[1:3], "little"), d[3], int.from_bytes(d[4:8], "little"))
            for can_id, d in line.sent
            if can_id == 0x601 and d[0] >> 5 == 1
        ]
        first = [(index, sub) for index, sub, _ in writes if index in (0x1A00, 0x1800)]
        assert first == [
            (0x1800, 1), (0x1A00, 0), (0x1A00, 1), (0x1A00, 2), (0x1A00, 3), (0x1A00, 0),
            (0x1800, 2), (0x1800, 1),
        ]  # fmt: skip
        on_off = [value >> 31 for index, sub, value in writes if (index, sub) == (0x1800, 1)]
        assert on_off == [1, 0]


def test_an_object_that_no_pdo_takes_is_named_with_pdo_and_way_out(monkeypatch):
    from hil_mock_robot.cia402.access_rules import NOT_MAPPABLE, Abort, is_pdo_object

    with drives() as line:
        line.master.preoperational()
        node, set_data = line.nodes[1], line.nodes[1].set_data

        def refusing(index, sub, data, check_writable=False):
            if is_pdo_object(index) and data[2:] == b"\xb2\x60":
                raise Abort(NOT_MAPPABLE)
            set_data(index, sub, data, check_writable)

        monkeypatch.setattr(node, "set_data", refusing)
        with pytest.raises(
            Aborted,
            match=r"joint_2 \(node 2\): RPDO2 cannot carry 60B2h \(torque offset\): cannot be",
        ) as caught:
            line.master.map(ALL_MODES)
        assert "mapping" in caught.value.hint


def kept_otherwise(monkeypatch, node, where: tuple[int, int], data: bytes) -> None:
    """A drive that acknowledges what it is given, and keeps something else."""
    set_data = node.set_data
    monkeypatch.setattr(
        node,
        "set_data",
        lambda index, sub, given, **more: set_data(
            index, sub, data if (index, sub) == where else given, **more
        ),
    )


def test_a_mapping_that_reads_back_otherwise_is_refused(monkeypatch):
    with drives(1) as line:
        line.master.preoperational()
        kept_otherwise(monkeypatch, line.nodes[0], (0x1A01, 3), b"\x10\x00\x77\x60")
        with pytest.raises(
            CommandRefused,
            match=r"TPDO2 maps 606C0020h, 60770010h, 60770010h after .*6078h.* was written",
        ):
            line.master.map(POSITION)


def test_a_pdo_that_does_not_go_by_sync_is_refused(monkeypatch):
    with drives(1) as line:
        line.master.preoperational()
        kept_otherwise(monkeypatch, line.nodes[0], (0x1400, 2), b"\xff")
        with pytest.raises(CommandRefused, match=r"RPDO1: 1400h:02 .* reads FFh after 1h"):
            line.master.map(POSITION)


def test_pdos_of_a_former_mapping_are_silent():
    with drives(1) as line:
        line.master.preoperational()
        line.master.map(ALL_MODES)
        assert not cob_ids(line.nodes[0], 0x1400)[1] & NOT_VALID
        line.master.map(POSITION)
        assert cob_ids(line.nodes[0], 0x1400)[1] & NOT_VALID


def test_a_drive_with_fewer_pdos_than_four_will_do(monkeypatch):
    from hil_mock_robot.cia402.access_rules import NO_OBJECT, Abort

    with drives(1) as line:
        line.master.preoperational()
        node = line.nodes[0]
        for name in ("get_data", "set_data"):
            whole = getattr(node, name)

            def lacking(index, sub, *args, whole=whole, **more):
                if index in (0x1402, 0x1403, 0x1802, 0x1803):
                    raise Abort(NO_OBJECT)
                return whole(index, sub, *args, **more)

            monkeypatch.setattr(node, name, lacking)
        line.master.map(ALL_MODES)


def test_a_drive_whose_mapping_is_fixed_will_do_if_it_is_the_wanted_one(monkeypatch):
    from hil_mock_robot.cia402.access_rules import READ_ONLY, Abort

    with drives(1) as line:
        line.master.preoperational()
        line.master.map(POSITION)
        node, set_data = line.nodes[0], line.nodes[0].set_data

        def fixed(index, sub, data, check_writable=False):
            if 0x1600 <= index < 0x1700 or 0x1A00 <= index < 0x1B00:
                raise Abort(READ_ONLY)
            set_data(index, sub, data, check_writable)

        monkeypatch.setattr(node, "set_data", fixed)
        line.master.map(POSITION)
        with pytest.raises(Aborted, match="read-only"):
            line.master.map(MINIMAL)


def test_an_eds_file_refuses_what_it_does_not_have_before_the_drive_is_asked(tmp_path):
    with drives(1) as line:
        text = eds_of(line.nodes[0].object_dictionary).decode()
    path = tmp_path / "drive.eds"
    path.write_text(_without_mapping(text, "60B2"))
    with drives(1, eds=(str(path),)) as line:
        line.master.preoperational()
        line.master.map(POSITION)
        with pytest.raises(SpecError, match=r"drive.eds, joint_1 \(node 1\): 60B2h .* PDO"):
            line.master.map(ALL_MODES)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("[60B2]", "[2FFF]", "does not exist"),
        ("DataType=0x0003", "DataType=0x0004", "has 32 bits in this file, 16 bits by CiA 402"),
        ("AccessType=rw", "AccessType=ro", "cannot be written"),
    ],
)
def test_an_eds_file_says_what_is_wrong_with_an_object(before, after, said, tmp_path):
    with drives(1) as line:
        head, section = eds_of(line.nodes[0].object_dictionary).decode().split("[60B2]")
    path = tmp_path / "drive.eds"
    path.write_text(head + ("[60B2]" + section).replace(before, after, 1))
    if before == "[60B2]":
        path.write_text(path.read_text().replace("=0x60B2", "=0x2FFF"))
    with drives(1, eds=(str(path),)) as line, pytest.raises(SpecError) as caught:
        line.master.map(ALL_MODES)
    assert caught.value.message.endswith(f"60B2h (torque offset) {said}")


def test_an_eds_file_that_is_none_is_refused(tmp_path):
    path = tmp_path / "drive.eds"
    path.write_text("[6040\nno eds")
    with pytest.raises(SpecError, match="is not a readable EDS file"), drives(1, eds=(str(path),)):
        pass


def test_frames_that_are_no_answers_of_ours_do_no_harm():
    with drives(1) as line:
        for can_id, data in (
            (0x581, b""),
            (0x581, b"\x43"),
            (0x701, b""),
            (0x7FF, b"x"),
            (0x81, b""),
        ):
            line.master.heard(can_id, data)
        assert line.master.upload(0, objects.DEVICE_TYPE) == 0x0002_0192


def test_a_mutilated_answer_is_not_taken_for_one():
    with drives(1) as line:

        def mutilated_first(can_id: int, _: bytes) -> bool:
            if can_id == 0x581:
                line.master.heard(0x581, b"\x43")
            return False

        line.lost = mutilated_first
        assert line.master.upload(0, objects.DEVICE_TYPE) == 0x0002_0192


def test_two_requests_to_one_node_never_overlap(monkeypatch):
    with drives(1) as line:
        active, most = [], []

        def slow(index: int, sub: int) -> bytes:
            active.append(index)
            most.append(len(active))
            threading.Event().wait(0.01)
            active.pop()
            return bytes(4)

        monkeypatch.setattr(line.master._remote[0].sdo, "upload", slow)
        threads = [
            threading.Thread(target=line.master.upload, args=(0, objects.SERIAL)) for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert most == [1, 1, 1, 1]


def test_errors_of_a_drive_are_the_present_one_and_its_list():
    with drives(1) as line:
        assert errors_of(line.master, 0) == []
        line.nodes[0].emergency(0x8611)
        line.nodes[0].emergency(0x3220)
        assert errors_of(line.master, 0) == [0x3220, 0x8611]


def _without_mapping(eds: str, index: str) -> str:
    """The file, with an object that no PDO may carry."""
    head, section = eds.split(f"[{index}]", 1)
    return f"{head}[{index}]{section.replace('PDOMapping=0x1', 'PDOMapping=0x0', 1)}"


# Objects of many drives asked for at once, and what is done when some do not answer.


WATCHED = 127 << 16 | 250
LONG_S = 120.0


def silence(line, *axes: int) -> None:
    """These drives take what they are told; nobody hears their SDO answers."""
    gone = {0x581 + axis for axis in axes}
    line.lost = lambda can_id, _: can_id in gone


def requests(line, index: int) -> list[tuple[int, bytes]]:
    head = index.to_bytes(2, "little")
    return [(i, d) for i, d in line.sent if i >> 7 == 0x600 >> 7 and d[1:3] == head]


def test_all_drives_are_asked_at_once_and_those_who_answer_are_told() -> None:
    with drives(3) as line:
        line.nodes[0].registers[key(0x6064)] = -5
        silence(line, 1)
        began = time.monotonic()
        assert line.master.upload_each(od.POSITION, range(3), 0.1).keys() == {0, 2}
        assert line.master.upload_each(od.POSITION, [0], LONG_S) == {0: -5}
        assert time.monotonic() - began < LONG_S / 2


def test_what_a_drive_refuses_is_neither_read_nor_written() -> None:
    with drives(2) as line:
        master = line.master
        began = time.monotonic()
        assert master.upload_each(Entry("no_such", 0x5FFF, 3, "B"), [0], LONG_S) == {}
        assert master.download_each(od.STATUSWORD, 5, [0, 1], LONG_S) == []
        assert master.download_each(od.QUICK_STOP_OPTION, 6, [0, 1], LONG_S) == [0, 1]
        assert time.monotonic() - began < LONG_S / 2
        assert line.nodes[1].registers[key(0x605A)] == 6


def test_an_answer_that_nobody_waited_for_does_not_disturb_who_asks_next() -> None:
    with drives(1) as line:
        late: list[tuple[int, bytes]] = []
        line.lost = lambda *frame: not late.append(frame)
        line.master.upload_each(od.POSITION, [0])
        line.lost = lambda *_: False

        def first_the_late_one(can_id: int, data: bytes) -> bool:
            if late and can_id == 0x581:
                line.master.heard(*late.pop())
            return False

        line.lost = first_the_late_one
        line.sent.clear()
        assert line.master.upload(0, od.DEVICE_TYPE) == 0x0002_0192
        assert len(line.sent) == 1


@measured_again
def test_a_silent_drive_is_asked_for_its_temperature_without_waiting() -> None:
    with drives(2) as line:
        silence(line, 0, 1)
        thermometer = Thermometer(line.master, 0x2110)
        own = InTime()
        thermometer.look()
        own.require(0.05)
        assert [i for i, _ in requests(line, 0x2110)] == [0x601]


def test_drives_that_are_left_at_rest_watch_us_no_more() -> None:
    with drives(2) as line:
        for node in line.nodes:
            node.registers[key(0x1016, 1)] = WATCHED
        part(line.master)
        assert [node.registers[key(0x1016, 1)] for node in line.nodes] == [0, 0]
        assert requests(line, 0x6040) == []


def test_a_drive_that_may_still_move_is_told_to_stop_and_goes_on_watching_us() -> None:
    with drives(3) as line:
        for node in line.nodes:
            node.registers[key(0x1016, 1)] = WATCHED
        line.nodes[1].registers[key(0x6041)] = 0x1237
        silence(line, 2)
        part(line.master)
        assert requests(line, 0x6040) == [
            (0x602, b"\x2b\x40\x60\0\x02\0\0\0"),
            (0x603, b"\x2b\x40\x60\0\x02\0\0\0"),
        ]
        assert [n.registers[key(0x1016, 1)] for n in line.nodes] == [0, WATCHED, WATCHED]


def test_a_fault_is_judged_by_all_errors_that_were_not_seen_yet() -> None:
    with drives(1) as line:
        node = line.nodes[0]
        node.emergency(0x2310)
        node.emergency(0x8130)
        node.registers[key(0x6041)] = 0x0218
        (fault,) = faults_left(line.master)
        assert fault.codes == (0x8130, 0x2310)
        assert not fault.is_monitoring
        unwatch(line.master)
