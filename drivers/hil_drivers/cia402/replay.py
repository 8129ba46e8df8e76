"""Reconstruction of a run's recording from a log of its CAN bus in the format of `candump -L`.

`BusCycles` processes the frames and builds for every SYNC the record that the driver stored in the
run. The module `rows` then converts these records to the same rows as in the run. The scaling of
the drives' integers is read from the files of the run (`start.json`), because no drive is
connected.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Mapping as MappingOf
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import load_arm
from hil.can import Frame, read_candump
from hil.core import DataError, StructArray
from hil.robot import Topic
from hil_drivers.cia402.can_channel import (
    EMCY_COB_ID,
    SDO_ANSWER_COB_ID,
    SYNC_COB_ID,
    rpdo_cob_id,
    tpdo_cob_id,
)
from hil_drivers.cia402.can_cycle import MARKER, Temperatures
from hil_drivers.cia402.commissioning import profile_fields, profile_of
from hil_drivers.cia402.mapping import MAPPINGS, MOST_BYTES, Mapping
from hil_drivers.cia402.options import Options, options_of
from hil_drivers.cia402.profile import AxisProfile, Scaling
from hil_drivers.cia402.rows import STALLED, TOPIC, StateRows, cycle_dtype, raw_rows, raw_topic
from hil_drivers.cia402.timing import Stalls


class Replay:
    """Log of the CAN bus during one run, as a `hil.robot.protocol.RecordedLog`.

    Args:
        log: Log file.
        model: Name of a built-in arm.
        options: Options of the station.
        robot: Content of the key `robot` in the run's `start.json`, with the objects of the drives.

    Raises:
        SpecError: An option is invalid.
        DataError: The scaling of the drives is missing in the files of the run.
    """

    def __init__(
        self, log: Path, model: str, options: MappingOf[str, Any], robot: MappingOf[str, Any]
    ) -> None:
        self._log, self._options = log, options_of(options, model)
        self._mapping = MAPPINGS[self._options.mapping]
        self._scaling = Scaling(profiles_of(self._options, model, robot))
        n, rate_hz = len(self._options.nodes), self._options.rate_hz
        self._topic = raw_topic(self._mapping, n, rate_hz)

    @property
    def topics(self) -> Sequence[Topic]:
        """See `RecordedLog`."""
        return (self._topic,)

    def blocks(self) -> Iterator[tuple[StructArray, MappingOf[str, StructArray]]]:
        """See `RecordedLog`."""
        options, period_s = self._options, self._options.period_s
        rows = StateRows(self._mapping, self._scaling, period_s, options.effort)
        any_cycles = False
        for cycles in BusCycles(options, self._mapping).blocks(read_candump(self._log)):
            any_cycles = True
            further = {TOPIC: raw_rows(cycles, self._mapping, self._topic, period_s)}
            yield rows.rows(cycles), further
        if not any_cycles:
            raise DataError(
                f"{self._log} contains no SYNC (COB-ID 080): it is not a log of this run's bus",
                hint="log with the station's option candump, or with candump -L on the same bus",
            )


def profiles_of(options: Options, model: str, robot: MappingOf[str, Any]) -> list[AxisProfile]:
    """Return the scaling profiles of all axes in a run.

    Args:
        options: Options of the run's station.
        model: Name of a built-in arm.
        robot: Content of the key `robot` in `start.json`; the identity in this content contains the
            scaling objects that were read from the drives.

    Raises:
        DataError: The identity of the robot does not contain the scaling objects.
    """
    arm, details = load_arm(model), robot.get("identity", {}).get("details", {})
    profiles = []
    for axis, given in enumerate(options.axes):
        own = profile_fields(_objects(details, axis))
        profile = profile_of(options.profile, given, own, float(arm.gear_ratio[axis]))
        if isinstance(profile, str):
            raise DataError(
                f"start.json: robot: axis {axis + 1} {profile}",
                hint="replay a log of a run on these drives; the scaling is in identity.details",
            )
        profiles.append(profile)
    return profiles


def _objects(details: MappingOf[str, Any], axis: int) -> dict[str, int]:
    """Return the objects of one axis from texts in the format of `Commissioned.details`."""
    read: dict[str, int] = {}
    for name, text in details.items():
        values = str(text).split()
        if axis < len(values) and values[axis].lstrip("-").isdigit():
            read[name] = int(values[axis])
    return read


BLOCK = 4096
"""Number of cycle records per block."""


class BusCycles:
    """Converter from the frames of a bus to cycle records.

    A record combines one SYNC, the commands after the SYNC and the answers to the SYNC. The record
    also contains the motor temperatures known at the SYNC and the fault code known when the last
    answer arrived.

    Args:
        options: Options of the station.
        mapping: Mapping of the process data.
    """

    def __init__(self, options: Options, mapping: Mapping) -> None:
        nodes = options.nodes
        n, self._dtype = len(nodes), cycle_dtype(mapping, len(nodes))
        self._sent = np.zeros((len(mapping.rpdos), n, MOST_BYTES), np.uint8)
        self._answered = np.zeros((len(mapping.tpdos), n, MOST_BYTES), np.uint8)
        self._commands = _slots(mapping.rpdos, nodes, rpdo_cob_id)
        self._answers = _slots(mapping.tpdos, nodes, tpdo_cob_id)
        self._emergencies = {EMCY_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._sdo = {SDO_ANSWER_COB_ID + node for node in nodes}
        self._marker_id = tpdo_cob_id(1, options.master_id)
        self._temperatures = Temperatures(nodes, options.temperature_object)
        self._faults: dict[int, int] = {}
        self._announced = (-1, 0)
        self._cycle, self._sync_time = -1, 0.0
        self._stalls = Stalls(
            options.period_s, options.late_cycles, real=options.wall_period_s == options.period_s
        )
        self._stalled = False
        self._in_cycle = self._announced
        self._missing: set[int] = set()
        self._celsius, self._fault_code = self._temperatures.celsius.copy(), 0

    def blocks(self, frames: Iterable[Frame]) -> Iterator[StructArray]:
        """Yield the records of all cycles in order, in blocks."""
        records: list[Any] = []
        for frame in frames:
            if frame.id == SYNC_COB_ID:
                records += self._closed()
                self._open(frame)
            else:
                self._take(frame)
            if len(records) >= BLOCK:
                yield self._block(records)
                records = []
        records += self._closed()
        if records:
            yield self._block(records)

    def _open(self, frame: Frame) -> None:
        self._cycle, self._sync_time = self._cycle + 1, frame.time_s
        self._stalled = self._stalls.synced(frame.time_s)
        self._in_cycle, self._missing = self._announced, set(self._answers)
        self._celsius = self._temperatures.celsius.copy()

    def _take(self, frame: Frame) -> None:
        can_id, data = frame.id, frame.data
        if can_id in self._answers:
            self._answer(can_id, data)
        elif can_id in self._commands:
            pdo, axis = self._commands[can_id]
            self._sent[pdo, axis, : len(data)] = list(data)
        elif can_id == self._marker_id and len(data) == MARKER.size:
            segment, status = MARKER.unpack(data)
            self._announced = (segment, status)
        elif can_id in self._sdo:
            self._temperatures.heard(can_id, data)
        elif can_id in self._emergencies and len(data) == MOST_BYTES:
            self._emergency(self._emergencies[can_id], struct.unpack_from("<H", data)[0])

    def _answer(self, can_id: int, data: bytes) -> None:
        pdo, axis = self._answers[can_id]
        self._answered[pdo, axis, : len(data)] = list(data)
        if can_id in self._missing:
            self._missing.remove(can_id)
            if not self._missing:
                self._fault_code = self._first_fault()

    def _emergency(self, axis: int, code: int) -> None:
        if code:
            self._faults.setdefault(axis, code)
        else:
            self._faults.pop(axis, None)

    def _first_fault(self) -> int:
        return next(iter(self._faults.values()), 0)

    def _closed(self) -> list[Any]:
        """Return the record of the cycle that has ended, if there was one."""
        if self._cycle < 0:
            return []
        flags = STALLED if self._stalled else 0
        if self._missing:
            self._fault_code = self._first_fault()
            flags |= sum({1 << self._answers[can_id][1] for can_id in self._missing})
        record = np.zeros((), self._dtype)
        record["cycle"], record["host_time"] = self._cycle, self._sync_time
        record["temperature"], record["flags"] = self._celsius, flags
        record["fault_code"] = self._fault_code
        record["segment"], record["status"] = self._in_cycle
        record["rpdo"], record["tpdo"] = self._sent, self._answered
        return [record]

    def _block(self, records: list[Any]) -> StructArray:
        return np.array(records, dtype=self._dtype)


def _slots(pdos: Any, nodes: Iterable[int], cob_id_of: Any) -> dict[int, tuple[int, int]]:
    """Return a dictionary from each COB-ID to the index of its PDO and the number of its axis."""
    return {
        cob_id_of(pdo.number, node): (at, axis)
        for at, pdo in enumerate(pdos)
        for axis, node in enumerate(nodes)
    }
