"""The station to work at: the one that is named, the one beside a spec, or a bench of mocks."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from hil import arms
from hil.core import SpecError, read_source
from hil.spec import Station, StationRobot, is_path, load_station

BUILT_IN = "built-in mock bench"

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
        f"{robot} of the {BUILT_IN} is taken; a station beside the spec has one, too: "
        f"--station {' or '.join(map(str, found))}"
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
