"""An experiment: a spec, the station it runs at, and where both came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hil.core import Source, SpecError, card, read_source
from hil.planning.station_lookup import BUILT_IN, NOT_MOCKED, find_station, mock_bench, stations_in
from hil.spec import (
    ExperimentSpec,
    Station,
    StationRobot,
    lay_over,
    load_spec,
    resolve_robot,
    resolved_text,
)

if TYPE_CHECKING:
    from hil.planning.commissioning import Commissioning

__all__ = [
    "BUILT_IN", "NOT_MOCKED", "Experiment", "find_station", "load_experiment", "mock_bench",
]  # fmt: skip

_NO_OVERRIDES: Mapping[str, str] = {}


@dataclass(frozen=True, slots=True)
class Experiment:
    """A spec bound to a station.

    Attributes:
        spec: The validated spec.
        station: The validated station.
        robot: The station's entry for the spec's robot.
        spec_text, station_text: The files as written; copied into the run directory.
        folder: Folder of the spec.
        station_source: Path of the station file, or that it is the built-in mock bench.
        commissioning: What of the plan is executed, and how fast; None for all of it.
        spec_source: Path of the spec file; empty when there is none.
        occasion: What of a schedule it is run for, such as `weekly/20261128T030000Z-probe/probe`;
            empty when it is not.
        overrides: What was laid over the spec's file, YAML by dotted path; `spec_text` has it.
    """

    spec: ExperimentSpec
    station: Station
    robot: StationRobot
    spec_text: str
    station_text: str
    station_source: str
    folder: Path
    commissioning: Commissioning | None = None
    spec_source: str = ""
    occasion: str = ""
    overrides: Mapping[str, str] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """One line for people."""
        told = f", {self.commissioning}" if self.commissioning else ""
        return f"{self.spec.name} on {self.spec.robot}{self._which} ({self.station_source}){told}"

    def __repr__(self) -> str:
        return f"<Experiment {self.title}>"

    def _repr_html_(self) -> str:
        """Itself in a notebook."""
        facts = {
            "robot": self.spec.robot,
            "model": self.robot.model,
            "driver": self.robot.driver + self._which,
            "station": self.station_source,
            "what": self.spec.description,
            "part of it": self.commissioning or "",
        }
        return card("Experiment", self.spec.name, facts)

    @property
    def _which(self) -> str:
        """Which individual a mock is: models of one know nothing of the others."""
        if self.robot.driver != "mock":
            return ""
        return f", individual {self.robot.options.get('seed', 0)}"


def load_experiment(
    file: Path | Source,
    station_path: Path | None = None,
    overrides: Mapping[str, str] = _NO_OVERRIDES,
) -> Experiment:
    """Load a spec and the station it runs at.

    Args:
        file: The spec's file, or what `read_source` read from it, which is changed.
        station_path: The station's file, when somebody has named one.
        overrides: Values laid over the spec, YAML text by dotted path (`excitation.waypoints`).

    The station is, in this order: `station_path`, $HIL_STATION, `station.yaml` beside the spec,
    or a bench with every built-in arm that can be mocked, and one on mock CAN drives. A real
    robot is never chosen by default.

    Raises:
        SpecError: Either file has problems (all are listed), or the station lacks the robot.
    """
    spec = load_spec(file, overrides)
    spec_path = Path(file.name) if isinstance(file, Source) else file
    station, text, source = find_station(spec_path.resolve().parent, station_path)
    return Experiment(
        spec=spec,
        station=station,
        robot=_robot_of(spec, station, spec_path, overrides, named=station_path is not None),
        spec_text=resolved_text(spec_path, overrides)
        if overrides
        else spec_path.read_text("utf-8"),
        station_text=text or station.as_text(BUILT_IN),
        station_source=source,
        folder=spec_path.resolve().parent,
        spec_source=str(spec_path),
        overrides=dict(overrides),
    )


def _robot_of(
    spec: ExperimentSpec,
    station: Station,
    file: Path,
    overrides: Mapping[str, str],
    *,
    named: bool,
) -> StationRobot:
    """The robot of a spec; where nobody named a station, an error names those beside the spec."""
    try:
        return resolve_robot(spec, station)
    except SpecError as error:
        source = read_source(file)
        lay_over(source, overrides)
        found = [] if named else [str(one) for one in stations_in(file.parent, spec.robot)]
        beside = f"it is at a station beside the spec: --station {' or '.join(found)}"
        message = f"{source.mark(('robot',))}: {error.message}"
        raise SpecError(message, hint=beside if found else error.hint) from None
