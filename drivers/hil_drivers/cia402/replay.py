"""The recording of a run made anew from a log of its bus, as `candump -L` writes it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.arms import load_arm
from hil.can import read_candump
from hil.core import DataError, StructArray
from hil.robot import Topic
from hil_drivers.cia402.bus_cycles import BusCycles
from hil_drivers.cia402.inspection import profile_of, said_by
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.options import Options, options_of
from hil_drivers.cia402.profile import AxisProfile
from hil_drivers.cia402.rows import TOPIC, StateRows, raw_rows, raw_topic
from hil_drivers.cia402.scaling import Scaling


class Replay:
    """A log of the bus of one run; see `hil.robot.protocol.RecordedLog`.

    Args:
        log: The file.
        model: Built-in arm.
        options: The station's.
        robot: `start.json: robot` of the run: what the drives had told about themselves.

    Raises:
        SpecError: An option cannot be.
        DataError: The run does not say what the drives' integers mean.
    """

    def __init__(
        self, log: Path, model: str, options: Mapping[str, Any], robot: Mapping[str, Any]
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

    def blocks(self) -> Iterator[tuple[StructArray, Mapping[str, StructArray]]]:
        """See `RecordedLog`."""
        options, period_s = self._options, self._options.period_s
        rows = StateRows(self._mapping, self._scaling, period_s, options.effort)
        found = False
        for cycles in BusCycles(options, self._mapping).blocks(read_candump(self._log)):
            found = True
            further = {TOPIC: raw_rows(cycles, self._mapping, self._topic, period_s)}
            yield rows.rows(cycles), further
        if not found:
            raise DataError(
                f"{self._log} holds no SYNC (COB-ID 080): it is no log of this run's bus",
                hint="log with the station's option candump, or with candump -L on the same bus",
            )


def profiles_of(options: Options, model: str, robot: Mapping[str, Any]) -> list[AxisProfile]:
    """What the integers of all axes meant in a run.

    Args:
        options: Of its station.
        model: Built-in arm.
        robot: `start.json: robot`; its identity holds the scaling objects as they were read.

    Raises:
        DataError: It does not hold them.
    """
    arm, details = load_arm(model), robot.get("identity", {}).get("details", {})
    profiles = []
    for axis, given in enumerate(options.axes):
        said = said_by(_objects(details, axis))
        profile = profile_of(options.profile, given, said, float(arm.gear_ratio[axis]))
        if isinstance(profile, str):
            raise DataError(
                f"start.json: robot: axis {axis + 1} {profile}",
                hint="replay a log of a run on these drives; the scaling is in identity.details",
            )
        profiles.append(profile)
    return profiles


def _objects(details: Mapping[str, Any], axis: int) -> dict[str, int]:
    """Objects of one axis, as `Commissioned.details` keeps them."""
    read: dict[str, int] = {}
    for name, told in details.items():
        values = str(told).split()
        if axis < len(values) and values[axis].lstrip("-").isdigit():
            read[name] = int(values[axis])
    return read
