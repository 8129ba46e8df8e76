"""Experiment: a spec, the station at which it runs, and the sources of both.

The station is the named station, otherwise `station.yaml` beside the spec, otherwise a bench of
mocks.
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
    """Spec of an experiment with its station.

    Attributes:
        spec: Validated spec.
        station: Validated station.
        robot: Entry of the station for the spec's robot.
        spec_text, station_text: Original text of the files, which is copied into the run directory.
        folder: Folder of the spec file.
        station_source: Path of the station file, or the name of the built-in mock bench.
        commissioning: Part of the plan to execute and its speed; None for the whole plan.
        spec_source: Path of the spec file; empty if there is no file.
        occasion: Name of the schedule occasion of the experiment, such as
            `weekly/20261128T030000Z-probe/probe`; empty without a schedule.
        overrides: Overrides of the spec file as YAML text by dotted path; already applied to
            `spec_text`.
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
        """Description of the experiment in one line."""
        part = f", {self.commissioning}" if self.commissioning else ""
        return f"{self.spec.name} on {self.spec.robot}{self._which} ({self.station_source}){part}"

    def __repr__(self) -> str:
        return f"<Experiment {self.title}>"

    def _repr_html_(self) -> str:
        """Return the HTML card for a notebook."""
        facts = {
            "robot": self.spec.robot,
            "model": self.robot.model,
            "driver": self.robot.driver + self._which,
            "station": self.station_source,
            "description": self.spec.description,
            "part": self.commissioning or "",
        }
        return card("Experiment", self.spec.name, facts)

    @property
    def _which(self) -> str:
        """Number of the mock individual as text; empty for robots other than mocks.

        A model that was fitted to one mock individual is not valid for other individuals.
        """
        if self.robot.driver != "mock":
            return ""
        return f", individual {self.robot.options.get('seed', 0)}"


def load(
    spec: AnyPath | Source,
    station: AnyPath | None = None,
    *,
    overrides: Mapping[str, object] | None = None,
) -> Experiment:
    """Load and validate an experiment spec and its station.

    Args:
        spec: Spec file, or the source that `read_source` read from the file; the source is
            modified.
        station: Station file; by default $HIL_STATION, `station.yaml` beside the spec, or a bench
            with every built-in arm that can be mocked and one arm on mock CAN drives, in this
            order. A real robot is never chosen by default.
        overrides: Overrides of the spec by dotted path (`excitation.waypoints`); values of type
            text are read as YAML, as for `--set`.

    Raises:
        SpecError: A file has problems, which are all listed, or the station does not contain the
            robot.
    """
    texts = {
        key: value if isinstance(value, str) else json.dumps(value, default=_plain)
        for key, value in values_by_name(overrides, "overrides", "{'excitation.seed': 3}").items()
    }
    file = spec if isinstance(spec, Source) else path_of(spec)
    path = Path(file.name) if isinstance(file, Source) else file
    return _loaded(file, path, path_of(station) if station else None, texts)


def _plain(value: object) -> object:
    """Return a number or array of numpy as a Python number or list."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise SpecError(
        f"overrides: {value!r} is not a YAML value",
        hint="pass numbers, texts, lists and mappings",
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
    """Return the station entry of a spec's robot.

    If no station was named, the error message lists the stations beside the spec.
    """
    try:
        return resolve_robot(spec, station)
    except SpecError as error:
        source = read_source(file)
        lay_over(source, overrides)
        found = [] if named else [str(one) for one in stations_in(file.parent, spec.robot)]
        beside = f"use the station beside the spec: --station {' or '.join(found)}"
        message = f"{source.mark(('robot',))}: {error.message}"
        raise SpecError(message, hint=beside if found else error.hint) from None


def require_experiment(experiment: Experiment) -> None:
    """Raise if an object is not an experiment returned by `load`.

    Raises:
        SpecError: The object is not an experiment.
    """
    if not isinstance(experiment, Experiment):
        raise SpecError(
            f"{experiment!r:.80} is not an experiment",
            hint="load it first: hil.load('spec.yaml')",
        )


MOST_LOOKED_AT = 20
"""Maximum number of files beside a spec that are searched for its station."""

MOCK_DRIVES = {
    "bus": {"interface": "hil_unix", "channel": "can0", "bitrate": 1_000_000},
    "nodes": [1, 2, 3, 4, 5, 6],
    "payload_object": 0x2100,
    "temperature_object": 0x2110,
    "pace": "free",
}
"""Options of the driver `cia402` for the drives of `hil mock can`, as in lab6_can_mock.yaml."""

NOT_MOCKED = ("panda",)
"""Built-in arms that the embedded mock does not support, because the mock has drives for six
joints."""

MOCK_STARTS = {"kr300": [0, -90, 90, 0, 0, 0]}
"""Start poses of the mocks of arms that cannot stand at zero joint angles [deg]."""


def find_station(folder: Path, named: Path | None = None) -> tuple[Station, str, str]:
    """Return the station that `load` would choose: the station, its text and its source.

    Args:
        folder: Folder in which `station.yaml` is searched for.
        named: Path of the station file that the user named; None if the user named no station file.

    Raises:
        SpecError: The station file has problems.
    """
    chosen = named or _station_nearby(folder)
    if chosen is None:
        return mock_bench(), "", BUILT_IN
    station = load_station(chosen)
    text = chosen.read_text("utf-8")
    if any(is_path(robot.model) for robot in station.robots.values()):
        # Absolute paths, because the copy of the station is in a run directory.
        text = station.as_text(f"{chosen.name}, with absolute paths")
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
    """Return the station files in the folder of a spec that contain a robot.

    Station files of this kind are written by `hil new own-urdf`.
    """
    found = []
    for file in sorted(folder.glob("*-station.yaml"))[:MOST_LOOKED_AT]:
        with suppress(SpecError):
            data = read_source(file).data
            robots = data.get("robots") if isinstance(data, dict) else None
            found += [file] if isinstance(robots, dict) and robot in robots else []
    return found


def passed_over(source: str, spec: Path, robot: str) -> str:
    """Return a notice if the mock bench was chosen although a nearby station has the robot.

    A nearby station is a station file beside the spec. The returned text is empty if no station
    file beside the spec contains the robot.

    Args:
        source: Source of the station that `find_station` chose.
        spec: Spec file.
        robot: Name of the spec's robot.
    """
    found = stations_in(spec.parent, robot) if source == BUILT_IN else []
    if not found:
        return ""
    return (
        f"using {robot} of the {BUILT_IN}, not the one in {found[0].name} beside the spec; to use "
        f"the latter: --station {' or '.join(map(str, found))}"
    )


def mock_bench() -> Station:
    """Return a station with all built-in arms that the embedded mock supports, with seed 0.

    The additional robot `lab6_can` connects to the drives of `hil mock can` on a bus that no other
    computer can reach.
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
