"""An experiment: a spec, the station it runs at, and where both came from.

The station is the one that is named, else the one beside the spec, else a bench of mocks.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil import arms
from hil.core import AnyPath, Source, SpecError, card, path_of, read_source, values_by_name
from hil.spec import (
    ExperimentSpec,
    Station,
    StationRobot,
    is_path,
    lay_over,
    load_spec,
    load_station,
    resolve_robot,
    resolved_text,
)

if TYPE_CHECKING:
    from hil.planning.commissioning import Commissioning


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


def load(
    spec: AnyPath | Source,
    station: AnyPath | None = None,
    *,
    overrides: Mapping[str, object] | None = None,
) -> Experiment:
    """Load and check an experiment spec and its station.

    Args:
        spec: The spec's file, or what `read_source` read from it, which is changed.
        station: The station's file; by default $HIL_STATION, `station.yaml` beside the spec, or a
            bench with every built-in arm that can be mocked, and one on mock CAN drives, in this
            order. A real robot is never chosen by default.
        overrides: Other values in the spec by dotted path (`excitation.waypoints`); texts are YAML,
            as those of `--set`.

    Raises:
        SpecError: With every problem of both files; or the station lacks the robot.
    """
    texts = {
        key: value if isinstance(value, str) else json.dumps(value, default=_plain)
        for key, value in values_by_name(overrides, "overrides", "{'excitation.seed': 3}").items()
    }
    file = spec if isinstance(spec, Source) else path_of(spec)
    path = Path(file.name) if isinstance(file, Source) else file
    return _loaded(file, path, path_of(station) if station else None, texts)


def _plain(value: object) -> object:
    """A number or list of numpy's as Python's own."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise SpecError(
        f"overrides: {value!r} is nothing that YAML has",
        hint="give numbers, texts, lists and mappings",
    )


BUILT_IN = "built-in mock bench"


def _loaded(
    file: Path | Source, path: Path, named: Path | None, overrides: Mapping[str, str]
) -> Experiment:
    spec = load_spec(file, overrides)
    station, text, source = find_station(path.resolve().parent, named)
    return Experiment(
        spec=spec,
        station=station,
        robot=_robot_of(spec, station, path, overrides, named=named is not None),
        spec_text=resolved_text(path, overrides) if overrides else path.read_text("utf-8"),
        station_text=text or station.as_text(BUILT_IN),
        station_source=source,
        folder=path.resolve().parent,
        spec_source=str(path),
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


def require_experiment(experiment: Experiment) -> None:
    """Refuse what `load` does not give.

    Raises:
        SpecError: It is something else.
    """
    if not isinstance(experiment, Experiment):
        raise SpecError(
            f"{experiment!r:.80} is no experiment", hint="load it first: hil.load('spec.yaml')"
        )


MOST_LOOKED_AT = 20
"""Files beside a spec that may be its station."""

MOCK_DRIVES = {
    "bus": {"interface": "hil_unix", "channel": "can0", "bitrate": 1_000_000},
    "nodes": [1, 2, 3, 4, 5, 6],
    "payload_object": 0x2100,
    "temperature_object": 0x2110,
    "pace": "free",
}
"""Options of the driver `cia402` for what `hil mock can` starts: see lab6_can_mock.yaml."""

NOT_MOCKED = ("panda",)
"""Built-in arms that the embedded mock cannot be: its drives are of six joints."""

MOCK_STARTS = {"kr300": [0, -90, 90, 0, 0, 0]}
"""Where mocks of arms begin for which all zeros is no pose [deg]."""


def find_station(folder: Path, named: Path | None = None) -> tuple[Station, str, str]:
    """The station to work at, as `load` chooses it: itself, its text, its source.

    Args:
        folder: Where `station.yaml` is looked for.
        named: The station file, when somebody has named one.

    Raises:
        SpecError: The file has problems.
    """
    chosen = named or _station_nearby(folder)
    if chosen is None:
        return mock_bench(), "", BUILT_IN
    station = load_station(chosen)
    text = chosen.read_text("utf-8")
    if any(is_path(robot.model) for robot in station.robots.values()):
        # A copy is read from the folder of a run, where a relative path means something else.
        text = station.as_text(f"{chosen.name}, with whole paths")
    return station, text, str(chosen)


def _station_nearby(folder: Path) -> Path | None:
    if named := os.environ.get("HIL_STATION"):
        path = Path(named)
        if not path.is_file():
            raise SpecError(
                f"$HIL_STATION names {named}, which is not a file",
                hint="unset HIL_STATION or point it at a station file",
            )
        return path
    beside = folder / "station.yaml"
    return beside if beside.is_file() else None


def stations_in(folder: Path, robot: str) -> list[Path]:
    """Files beside a spec, such as `hil new own-urdf` writes, of a station with this robot."""
    found = []
    for file in sorted(folder.glob("*-station.yaml"))[:MOST_LOOKED_AT]:
        with suppress(SpecError):
            data = read_source(file).data
            robots = data.get("robots") if isinstance(data, dict) else None
            found += [file] if isinstance(robots, dict) and robot in robots else []
    return found


def passed_over(source: str, spec: Path, robot: str) -> str:
    """What to say where the bench of mocks was chosen, and a station beside the spec has its robot.

    Args:
        source: What `find_station` chose.
        spec: The spec's file.
        robot: Its robot.
    """
    found = stations_in(spec.parent, robot) if source == BUILT_IN else []
    if not found:
        return ""
    return (
        f"using {robot} of the {BUILT_IN}, not the one in {found[0].name} beside the spec; "
        f"to use that: --station {' or '.join(map(str, found))}"
    )


def mock_bench() -> Station:
    """A bench with every built-in arm that the embedded mock can be, seed 0, and `lab6_can`.

    The latter meets the drives of `hil mock can` on a bus that no other computer can reach.
    """
    embedded = {
        name: StationRobot(driver="mock", model=name, options=_mock_options(name))
        for name in arms.arm_names()
        if name not in NOT_MOCKED
    }
    return Station(
        hil_station=1,
        name="mock-bench",
        robots=embedded
        | {"lab6_can": StationRobot(driver="cia402", model="lab6", options=MOCK_DRIVES)},
    )


def _mock_options(arm: str) -> dict[str, Any]:
    return {"start_q_deg": MOCK_STARTS[arm]} if arm in MOCK_STARTS else {}
