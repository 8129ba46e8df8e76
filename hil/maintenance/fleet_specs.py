"""Robots of a fleet, with the spec and the experiment of each robot.

The robots of a fleet are selected by patterns, or by a file with their addresses. All robots of a
fleet run the same spec. Only the name of the robot is replaced in the text of the spec.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from hil.core import SpecError, closest, with_value
from hil.planning import Experiment, find_station
from hil.spec import Station, load_fleet_spec, resolve_robot, spec_from_text

FEW = 12
"""Maximum number of robot names in the hint of an error."""


def robots_like(station: Station, patterns: Sequence[str], where: str) -> tuple[str, ...]:
    """Return the robots of a station that match a pattern, in the order of the station.

    Args:
        station: Station with the robots.
        patterns: File name patterns: `ur5-*`, `ur5-00[1-9]`, or whole names.
        where: Name of the station file, used in error messages.

    Raises:
        SpecError: One of the patterns matches no robot.
    """
    names = list(station.robots)
    known = ", ".join(names) if len(names) <= FEW else f"{len(names)}, the first is {names[0]!r}"
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            guess = closest(pattern, names)
            like = f"did you mean {guess!r}? " if guess else ""
            raise SpecError(
                f"{where} has no robot {pattern!r}",
                hint=f"{like}it has {known}",
            )
    return tuple(name for name in names if any(fnmatchcase(name, one) for one in patterns))


def robots_named(words: Sequence[str]) -> tuple[list[str], Path, dict[str, str]]:
    """Return patterns of robots, the file with robots and addresses, and these addresses.

    Args:
        words: Patterns of robot names, and names of fleet files (`*.yaml`). If `words` names no
            fleet file, no addresses are returned, and the returned path is a default for a file
            that does not exist.

    Raises:
        SpecError: A fleet file has problems.
    """
    files = [one for one in words if one.endswith((".yaml", ".yml"))]
    addresses = {name: at for file in files for name, at in load_fleet_spec(file).robots.items()}
    patterns = [one for one in words if one not in files]
    return [*patterns, *addresses], Path(files[0] if files else "fleet.yaml"), addresses


def spec_for(text: str, name: str, robot: str) -> str:
    """Return the text of a spec in which only the robot is replaced.

    Args:
        text: YAML text of the spec.
        name: Name of the spec file, used in error messages.
        robot: Name of the robot to insert.

    Raises:
        SpecError: The spec names no robot that could be replaced, or the text is invalid.
    """
    try:
        changed = with_value(text, "robot", json.dumps(robot))
    except ValueError as error:
        raise SpecError(
            f"{name}: {error}", hint=f"check the spec with: hil validate {name}"
        ) from None
    if changed is None:
        raise SpecError(f"{name} names no robot", hint="add a line such as `robot: ur5`")
    return changed


def experiment_for(text: str, folder: Path, station: Path | None, source: Path) -> Experiment:
    """Return the loaded experiment of one robot of a fleet.

    Args:
        text: Text of the robot's spec, from `spec_for`.
        folder: Folder to which relative paths in the spec are relative.
        station: Path of the station file; None for the station that an experiment in `folder` would
            use.
        source: Spec file that the run records as its source.

    Raises:
        SpecError: The spec or the station has problems, or the station does not contain the robot.
    """
    spec = spec_from_text(text, str(source), folder=folder)
    bench, station_text, where = find_station(folder, station)
    return Experiment(
        spec=spec,
        station=bench,
        robot=resolve_robot(spec, bench),
        spec_text=text,
        station_text=station_text or bench.as_text(where),
        station_source=where,
        folder=folder,
        spec_source=str(source),
    )
