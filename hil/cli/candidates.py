"""What may stand at a place of a command line, found without loading anything heavy.

Every function gets what stands before the cursor and gives words that begin with it. An empty list
leaves the place to the shell, which then offers files. Nothing here raises: a folder that nobody
can read offers nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

MOST = 200
"""Words are offered of the newest runs, and no more files than that are looked into."""

HEAD_BYTES = 4000
"""The key that says what a YAML file is comes within so much of it."""

SPEC_FOLDERS = (Path(), Path("experiments"), Path("experiments/stations"), Path("stations"),
                Path("experiments/maps"), Path("maps"))  # fmt: skip
ARMS = Path(__file__).parent.parent / "arms"
DRIVES = "lab6_can"
"""The arm of the built-in bench that is not called as the file about it."""

Given = Mapping[str, Any]
"""What stands on the command line before, by parameter."""


def runs(given: Given, begun: str) -> list[str]:
    """Names of runs; their numbers once a digit other than 0 is typed; their paths after a `/`."""
    return _named(given, begun, ("recording", "start.json"))


def reported(given: Given, begun: str) -> list[str]:
    """The same, and series."""
    return _named(given, begun, ("recording", "start.json", "series.json"))


def models(given: Given, begun: str) -> list[str]:
    """Folders of models in `models`, then runs, which stand for their only model."""
    if begun.startswith(("./", "../", "/")):
        return []
    folders = [path for path in _folders_in(Path("models")) if (path / "model.json").is_file()]
    return [*_beginning(map(str, folders), begun), *runs(given, begun)]


def registered(given: Given, begun: str) -> list[str]:
    """Names in the registry."""
    root = _folder(given, "registry", "HIL_REGISTRY", "registry")
    return _beginning((path.name for path in _folders_in(root)), begun)


def versions(given: Given, begun: str) -> list[str]:
    """Versions of the registered name that stands before, and what they are called by role."""
    root = _folder(given, "registry", "HIL_REGISTRY", "registry") / str(given.get("name") or "")
    numbers = [path.name for path in _folders_in(root) if path.name[1:].isdecimal()]
    return _beginning(["champion", "challenger", *numbers], begun)


def specs(given: Given, begun: str) -> list[str]:
    """Experiments, series and schedules here and in `experiments`."""
    return _yaml(begun, ("hil:", "hil_series:", "hil_schedule:"))


def motions(given: Given, begun: str) -> list[str]:
    """Experiments and series here and in `experiments`."""
    return _yaml(begun, ("hil:", "hil_series:"))


def schedules(given: Given, begun: str) -> list[str]:
    """Schedules here and in `experiments`."""
    return _yaml(begun, ("hil_schedule:",))


def stations(given: Given, begun: str) -> list[str]:
    """Station files here and in the folders where they are kept."""
    return _yaml(begun, ("hil_station:",))


def maps(given: Given, begun: str) -> list[str]:
    """Import maps here and in the folders where they are kept."""
    return _yaml(begun, ("hil_map:",))


def robots(given: Given, begun: str) -> list[str]:
    """Robots of the station that was named before, of $HIL_STATION, or of `station.yaml` here."""
    named = given.get("station") or os.environ.get("HIL_STATION") or "station.yaml"
    if not Path(str(named)).is_file():
        return arms(given, begun) + _beginning([DRIVES], begun)
    return _beginning(_robots_of(Path(str(named))), begun)


def arms(given: Given, begun: str) -> list[str]:
    """Built-in arms."""
    return _beginning(sorted(path.stem for path in ARMS.glob("*.yaml")), begun)


def plugins(group: str, begun: str) -> list[str]:
    """Names in a group of plug-ins; none is imported."""
    from hil.core import names

    return _beginning(names(group), begun)


def benchmarks(given: Given, begun: str) -> list[str]:
    """Benchmarks of a checkout."""
    from hil.cli.benchmarking import FOLDER

    files = (path.stem for path in FOLDER.glob("*.py") if not path.stem.startswith("_"))
    return _beginning(["list", "all", *files], begun)


def _robots_of(station: Path) -> list[str]:
    from hil.core import look_into  # no other candidate needs YAML

    try:
        document = look_into(station.read_bytes())
    except (OSError, ValueError):
        return []
    found = document.get("robots") if isinstance(document, dict) else None
    return [str(name) for name in found] if isinstance(found, dict) else []


def _run_folders(root: Path) -> list[Path]:
    # As in `hil.recording`: that package takes 0.2 s to import, too long for a Tab.
    days = _folders_in(root)
    return [run for day in days for robot in _folders_in(day) for run in _folders_in(robot)]


def _named(given: Given, begun: str, held: tuple[str, ...]) -> list[str]:
    """Folders that hold one of these: series, simulations and others lie between the runs."""
    newest = reversed(_run_folders(_folder(given, "runs", "HIL_RUNS", "runs")))
    wanted = (path for path in newest if any((path / name).exists() for name in held))
    found = list(islice(wanted, MOST))[::-1]
    if "/" in begun:
        return _beginning(map(str, found), begun)
    if begun.isdecimal() and not begun.startswith("0"):
        numbers = (path.name.partition("-")[0].lstrip("0") for path in found)
        return _beginning((number for number in numbers if number.isdecimal()), begun)
    return _beginning((path.name for path in found), begun)


def _yaml(begun: str, keys: tuple[str, ...]) -> list[str]:
    """YAML files of a kind: in the folder that is typed, or where such files are kept."""
    typed = os.path.dirname(begun)
    folders = [Path(typed)] if typed else SPEC_FOLDERS
    found = [path for folder in folders for path in _files_in(folder)]
    shown = (path for path in found[:MOST] if _is_kind(path, keys))
    prefix = "./" if begun.startswith("./") else ""
    return _beginning((prefix + str(path) for path in shown), begun)


def _is_kind(path: Path, keys: tuple[str, ...]) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES).decode("utf-8", "replace")
    except OSError:
        return False
    return any(line.startswith(keys) for line in head.splitlines())


def _files_in(folder: Path) -> list[Path]:
    try:
        return sorted(p for p in folder.iterdir() if p.suffix in (".yaml", ".yml"))
    except OSError:
        return []


def _folders_in(parent: Path) -> list[Path]:
    try:
        with os.scandir(parent) as entries:
            found = [entry.name for entry in entries if entry.is_dir()]
    except OSError:
        return []
    return [parent / name for name in sorted(found) if not name.startswith(".")]


def _folder(given: Given, option: str, variable: str, usual: str) -> Path:
    return Path(str(given.get(option) or os.environ.get(variable) or usual))


def _beginning(words: Iterable[str], begun: str) -> list[str]:
    return [word for word in dict.fromkeys(words) if word.startswith(begun)]
