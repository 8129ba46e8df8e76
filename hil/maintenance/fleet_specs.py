"""The robots of a fleet, and the spec and the experiment of each of them.

Robots are named by patterns, or by a file with their addresses. All run one spec in which only
the robot is replaced; the rest of its text stays as it was written.
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
"""Number of robot names that a hint lists at most."""


def robots_like(station: Station, patterns: Sequence[str], where: str) -> tuple[str, ...]:
    """Return the robots of a station that match any of the patterns, in the station's order.

    Args:
        station: With the robots.
        patterns: As of files: `ur5-*`, `ur5-00[1-9]`, or whole names.
        where: The station's file, for errors.

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
    """Return patterns of robots, the file that names robots with their addresses, and its content.

    Args:
        words: Patterns, and files (`*.yaml`). Without a file there are no addresses, and the
            returned file is one that could be written.

    Raises:
        SpecError: The file has problems.
    """
    files = [one for one in words if one.endswith((".yaml", ".yml"))]
    addresses = {name: at for file in files for name, at in load_fleet_spec(file).robots.items()}
    patterns = [one for one in words if one not in files]
    return [*patterns, *addresses], Path(files[0] if files else "fleet.yaml"), addresses


def spec_for(text: str, name: str, robot: str) -> str:
    """Return the text of a spec with another robot; the rest stays as it was written.

    Args:
        text: YAML.
        name: Of its file, for errors.
        robot: Name of the other robot.

    Raises:
        SpecError: It names no robot whose place could be taken.
    """
    try:
        changed = with_value(text, "robot", json.dumps(robot))
    except ValueError as error:
        raise SpecError(f"{name}: {error}", hint="`hil validate` says more") from None
    if changed is None:
        raise SpecError(f"{name} names no robot", hint="it needs a line such as `robot: ur5`")
    return changed


def experiment_for(text: str, folder: Path, station: Path | None, source: Path) -> Experiment:
    """Return the experiment of one robot.

    Args:
        text: Its spec, from `spec_for`.
        folder: Folder that relative paths in the spec start at.
        station: The station file; by default the one an experiment in `folder` would use.
        source: File that the run names as its spec.

    Raises:
        SpecError: Spec or station have problems, or the station lacks the robot.
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
