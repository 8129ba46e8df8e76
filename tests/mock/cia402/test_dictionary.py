"""The mock drive's object dictionary: what is in it, who may do what, and the same as EDS."""

from __future__ import annotations

import io
import struct

import canopen
import numpy as np
import pytest

from hil.arms import load_arm
from hil_mock_robot.cia402.dictionary import Object, eds_of, raw_real, real, registers_of, variables
from hil_mock_robot.cia402.keys import key
from tests.support.can_node_parts import NODE, Bench, imported

TYPES = {"i8": 2, "i16": 3, "i32": 4, "u8": 5, "u16": 6, "u32": 7, "f32": 8, "text": 9}

STANDARD = [
    # index, sub, type of CiA 301, access, mappable: as CiA 301 and CiA 402-2 have them
    (0x1000, 0, "u32", "const", False), (0x1001, 0, "u8", "ro", True),
    (0x1003, 0, "u8", "rw", False), (0x1003, 1, "u32", "ro", False),
    (0x1005, 0, "u32", "rw", False), (0x1006, 0, "u32", "rw", False),
    (0x1008, 0, "text", "const", False), (0x1014, 0, "u32", "rw", False),
    (0x1016, 1, "u32", "rw", False), (0x1017, 0, "u16", "rw", False),
    (0x1018, 1, "u32", "ro", False), (0x1018, 4, "u32", "ro", False),
    (0x1029, 1, "u8", "rw", False), (0x1400, 1, "u32", "rw", False),
    (0x1400, 2, "u8", "rw", False), (0x1600, 0, "u8", "rw", False),
    (0x1600, 8, "u32", "rw", False), (0x1803, 3, "u16", "rw", False),
    (0x1803, 5, "u16", "rw", False), (0x1A03, 8, "u32", "rw", False),
    (0x6007, 0, "i16", "rw", False), (0x603F, 0, "u16", "ro", True),
    (0x6040, 0, "u16", "rw", True), (0x6041, 0, "u16", "ro", True),
    (0x605A, 0, "i16", "rw", False), (0x605E, 0, "i16", "rw", False),
    (0x6060, 0, "i8", "rw", True), (0x6061, 0, "i8", "ro", True),
    (0x6064, 0, "i32", "ro", True), (0x6065, 0, "u32", "rw", False),
    (0x6066, 0, "u16", "rw", False), (0x606C, 0, "i32", "ro", True),
    (0x6071, 0, "i16", "rw", True), (0x6072, 0, "u16", "rw", True),
    (0x6075, 0, "u32", "rw", False), (0x6076, 0, "u32", "rw", False),
    (0x6077, 0, "i16", "ro", True), (0x6078, 0, "i16", "ro", True),
    (0x6079, 0, "u32", "ro", True), (0x607A, 0, "i32", "rw", True),
    (0x607D, 1, "i32", "rw", False), (0x607D, 2, "i32", "rw", False),
    (0x607E, 0, "u8", "rw", False), (0x6085, 0, "u32", "rw", False),
    (0x608F, 1, "u32", "rw", False), (0x6091, 2, "u32", "rw", False),
    (0x6092, 1, "u32", "ro", False), (0x60B0, 0, "i32", "rw", True), (0x60B1, 0, "i32", "rw", True),
    (0x60B2, 0, "i16", "rw", True), (0x60C2, 1, "u8", "rw", False),
    (0x60C2, 2, "i8", "rw", False), (0x60F4, 0, "i32", "ro", True),
    (0x60FD, 0, "u32", "ro", True), (0x60FE, 1, "u32", "rw", True),
    (0x60FF, 0, "i32", "rw", True), (0x6502, 0, "u32", "const", False),
]  # fmt: skip


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize(
    ("index", "sub", "type_", "access", "mappable"),
    STANDARD,
    ids=[f"{index:04X}_{sub}" for index, sub, *_ in STANDARD],
)
def test_objects_of_the_standards_are_there_as_those_have_them(
    bench, index, sub, type_, access, mappable
):
    entry = bench.remote.object_dictionary.get_variable(index, sub)
    found = entry.data_type, entry.access_type, entry.pdo_mappable
    assert found == (TYPES[type_], access, mappable)


def empty(entry: Object) -> bool:
    """Errors that have never been: test_can_node_errors."""
    return entry.index == 0x1003 and entry.sub > 0


@pytest.mark.parametrize("entry", list(variables()), ids=lambda e: f"{e.index:04X}_{e.sub}")
def test_a_client_reads_and_writes_every_object_as_its_access_says(bench: Bench, entry: Object):
    if entry.type == "domain" or empty(entry):
        return
    if entry.access == "wo":
        with pytest.raises(canopen.SdoAbortedError, match="write only"):
            bench.remote.sdo.upload(entry.index, entry.sub)
        return
    data = bench.remote.sdo.upload(entry.index, entry.sub)
    if entry.access != "rw":
        with pytest.raises(canopen.SdoAbortedError, match="read only"):
            bench.remote.sdo.download(entry.index, entry.sub, data)
    elif not 0x1400 <= entry.index <= 0x1BFF:  # those have an order: test_can_node_mapping
        bench.remote.sdo.download(entry.index, entry.sub, data)
        assert bench.remote.sdo.upload(entry.index, entry.sub) == data


def test_what_the_eds_says_is_the_dictionary_itself(bench):
    def told(dictionary):
        return {
            (v.index, v.subindex): (
                v.name, v.data_type, v.access_type, v.pdo_mappable, v.min, v.max, v.default,
                v.unit, v.description, v.relative,
            )
            for part in dictionary.values()
            for v in ([part] if isinstance(part, canopen.objectdictionary.ODVariable)
                      else part.values())
        }  # fmt: skip

    assert told(imported(bench.node)) == told(bench.node.object_dictionary)


def test_one_eds_serves_every_node_with_identifiers_of_its_own(bench):
    file = io.StringIO(eds_of(bench.node.object_dictionary).decode("ascii"))
    other = canopen.objectdictionary.eds.import_eds(file, 17)
    cob_ids = [other.get_variable(index, 1).default & 0x7FF for index in (0x1400, 0x1803)]
    assert cob_ids == [0x200 + 17, 0x480 + 17]
    assert other[0x1014].default == 0x80 + 17


def test_a_client_can_upload_the_eds_from_the_drive(bench):
    node = bench.network.add_node(canopen.RemoteNode(NODE, canopen.ObjectDictionary()))
    node.sdo.RESPONSE_TIMEOUT = 0.001
    loaded = canopen.objectdictionary.eds.import_eds(
        node.sdo.open(0x1021, 0, "rt", encoding="ascii"), NODE
    )
    assert set(loaded) == set(bench.node.object_dictionary)


def test_defaults_in_the_eds_are_what_the_drive_answers_at_power_on():
    bench = Bench()
    for entry in variables():
        if entry.type in ("text", "domain") or entry.access == "wo" or empty(entry):
            continue
        default = bench.remote.object_dictionary.get_variable(entry.index, entry.sub).default
        answered = bench.remote.sdo.upload(entry.index, entry.sub)
        code = "f" if entry.type == "f32" else entry.packing.format[-1]
        assert struct.unpack(f"<{code}", answered)[0] == default, entry.name


@pytest.mark.parametrize("joint", range(6))
def test_the_motor_is_scaled_as_the_arm_description_says(joint):
    arm = load_arm("lab6")
    registers = registers_of(arm, joint)
    increments, gear = registers[key(0x608F, 1)], registers[key(0x6091, 1)]
    assert (increments, registers[key(0x608F, 2)]) == (1 << 20, 1)
    assert gear == arm.gear_ratio[joint]
    assert registers[key(0x6091, 2)] == 1
    rated_nm = registers[key(0x6076)] / 1000
    assert 2.1 * rated_nm * gear == pytest.approx(arm.effort_max[joint], rel=2e-3)
    rated_a = registers[key(0x6075)] / 1000
    assert rated_nm * gear / rated_a == pytest.approx(arm.drive_gains[joint], rel=4e-3)
    turn = increments * gear
    limits = np.array([registers[key(0x607D, sub)] for sub in (1, 2)]) / turn * 360
    np.testing.assert_allclose(limits, np.degrees([arm.q_min[joint], arm.q_max[joint]]), atol=1e-4)
    assert np.all(limits >= np.degrees(arm.q_min[joint]) - 1e-9)
    speed = registers[key(0x6080)] / 60 / gear * 360
    assert speed == pytest.approx(np.degrees(arm.qd_max[joint]), rel=1e-3)


def test_serial_numbers_differ_between_axes():
    arm = load_arm("lab6")
    assert len({registers_of(arm, joint)[key(0x1018, 4)] for joint in range(6)}) == 6


def test_real_numbers_keep_their_bits():
    assert real(raw_real(1.5)) == 1.5
    assert raw_real(1.5) == 0x3FC0_0000
