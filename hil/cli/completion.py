"""Shell completion: possible words at the cursor position of the command line.

Typer requests the words for completion when a shell calls `hil` with `_HIL_COMPLETE`. The module is
loaded and `attach` is called only for a completion request, so other commands do not become slower.
The module imports no large library, so that the Tab key is answered within a fifth of a second.

The dicts `BY_COMMAND` and `BY_NAME` contain the function that finds the words for a parameter. A
completion function receives the parameters before the cursor and the beginning of the word. The
wrapper `_completion_of` removes words with a different beginning and suppresses every error,
because a shell must never receive a traceback. If the function finds no words, the shell offers
files.
"""

import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, TypeAlias, get_args, get_origin, get_type_hints

import typer
from typer.models import ParameterInfo

from hil.cli.explain import KINDS
from hil.export import TARGETS

Parameters: TypeAlias = Mapping[str, Any]
"""Values of the parameters before the cursor, by name of the parameter."""

Words: TypeAlias = Callable[[Parameters, str], Iterable[str]]


def attach(app: typer.Typer) -> None:
    """Add the completion function to every parameter in `BY_COMMAND` and `BY_NAME`.

    Args:
        app: Typer application with all its commands.
    """
    for command, callback in commands(app):
        hints = get_type_hints(callback, include_extras=True)
        for name, hint in hints.items():
            words = BY_COMMAND.get((command, name), BY_NAME.get(name))
            if words is not None and get_origin(hint) is Annotated:
                hints[name] = _with(_completion_of(words), hint)
        # typer reads the signature; the annotation itself may be shared with other commands.
        signature = inspect.signature(callback)
        vars(callback)["__signature__"] = signature.replace(
            parameters=[
                option.replace(annotation=hints[option.name])
                for option in signature.parameters.values()
            ]
        )


def commands(app: typer.Typer, group: str = "") -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield the name of every command, such as `models show`, and the function of the command."""
    for command in app.registered_commands:
        assert command.callback is not None
        name = command.name or command.callback.__name__.replace("_", "-")
        yield f"{group}{name}", command.callback
    for below in app.registered_groups:
        file = below.typer_instance
        assert file is not None
        name = file.info.name if isinstance(file.info.name, str) else ""
        yield from commands(file, f"{group}{name} " if name else group)


def _with(completion: Callable[..., list[str]], hint: Any) -> Any:
    """Return a copy of an annotation with a completion, because commands may share the original."""
    kind, *infos = get_args(hint)
    infos = [copy(info) if isinstance(info, ParameterInfo) else info for info in infos]
    for info in infos:
        if isinstance(info, ParameterInfo):
            info.autocompletion = completion
    return Annotated.__class_getitem__((kind, *infos))  # type: ignore[attr-defined]


def _completion_of(words: Words) -> Callable[..., list[str]]:
    """Return the completion function for typer, which passes arguments by their annotations."""

    def complete(context: typer.Context, incomplete: str) -> list[str]:
        try:
            found = words(context.params, incomplete)
            return [word for word in dict.fromkeys(found) if word.startswith(incomplete)]
        except Exception:
            return []

    return complete


# Words for each kind of object

MOST = 200
"""Maximum number of offered runs (the newest runs), and of YAML files whose kind is determined."""

HEAD_BYTES = 4000
"""Number of bytes at the beginning of a YAML file that have to contain the key of its kind."""

SPEC_FOLDERS = (Path(), Path("experiments"), Path("experiments/stations"), Path("stations"),
                Path("experiments/maps"), Path("maps"))  # fmt: skip
"""Folders in which completion searches for YAML files."""

ARMS = Path(__file__).parent.parent / "arms"
DRIVES = "lab6_can"
"""Robot of the built-in station whose name differs from the name of its arm."""


def _runs(parameters: Parameters, begun: str) -> list[str]:
    return _folders_with(("recording", "start.json"), parameters, begun)


def _runs_and_series(parameters: Parameters, begun: str) -> list[str]:
    return _folders_with(("recording", "start.json", "series.json"), parameters, begun)


def _folders_with(marks: tuple[str, ...], parameters: Parameters, begun: str) -> list[str]:
    """Return names of runs; numbers if a digit other than 0 is typed, paths if a `/` is typed.

    Folders of series and simulations are in the same folder as run directories. Folders of the
    requested kind contain one of the files `marks`; other folders do not.
    """
    # Same layout as in `hil.recording`, whose import takes 0.2 s and is too slow here.
    root = _folder(parameters, "runs", "HIL_RUNS", "runs")
    newest = reversed(
        [run for day in _below(root) for robot in _below(day) for run in _below(robot)]
    )
    marked = (path for path in newest if any((path / mark).exists() for mark in marks))
    folders = list(islice(marked, MOST))[::-1]
    if "/" in begun:
        return [str(path) for path in folders]
    if begun.isdecimal() and not begun.startswith("0"):
        numbers = (path.name.partition("-")[0].lstrip("0") for path in folders)
        return [number for number in numbers if number.isdecimal()]
    return [path.name for path in folders]


def _models(parameters: Parameters, begun: str) -> list[str]:
    """Return folders in `models`, then runs, because the name of a run selects its only model."""
    if begun.startswith(("./", "../", "/")):
        return []
    folders = [str(path) for path in _below(Path("models")) if (path / "model.json").is_file()]
    return folders + _runs(parameters, begun)


def _registered(parameters: Parameters, begun: str) -> list[str]:
    return [path.name for path in _below(_folder(parameters, "registry", *REGISTRY))]


def _versions(parameters: Parameters, begun: str) -> list[str]:
    """Return the versions of the model whose name is before the cursor, and their roles."""
    root = _folder(parameters, "registry", *REGISTRY) / str(parameters.get("name") or "")
    numbers = [path.name for path in _below(root) if path.name[1:].isdecimal()]
    return ["champion", "challenger", *numbers]


REGISTRY = ("HIL_REGISTRY", "registry")


def _robots(parameters: Parameters, begun: str) -> list[str]:
    """Return the robots of the station before the cursor, $HIL_STATION, or `station.yaml` here."""
    named = parameters.get("station") or os.environ.get("HIL_STATION") or "station.yaml"
    if not Path(str(named)).is_file():
        return [*_arms(parameters, begun), DRIVES]
    from hil.core import look_into  # only this function needs YAML

    return list(look_into(Path(str(named)).read_bytes())["robots"])


def _arms(parameters: Parameters, begun: str) -> list[str]:
    return sorted(path.stem for path in ARMS.glob("*.yaml"))


def _benchmarks(parameters: Parameters, begun: str) -> list[str]:
    from hil.cli.bench import benchmarks

    return ["list", "all", *benchmarks()]


def _plugins(group: str, *others: str) -> Words:
    """Return a completion function for the names of a group of plug-ins; imports no plug-in."""
    from hil.core import plugins

    return lambda parameters, begun: [*others, *plugins.names(group)]


def _words(*words: str) -> Words:
    return lambda parameters, begun: words


def _yaml(*keys: str) -> Words:
    """Return a completion function for YAML files that begin with one of the keys.

    The completion function searches in the typed folder; if no folder is typed, in `SPEC_FOLDERS`.
    """

    def files(parameters: Parameters, begun: str) -> Iterator[str]:
        typed = os.path.dirname(begun)
        folders = (Path(typed),) if typed else SPEC_FOLDERS
        prefix = "./" if begun.startswith("./") else ""
        for path in [path for folder in folders for path in _yaml_files(folder)][:MOST]:
            if begins_with(path, keys):
                yield f"{prefix}{path}"

    return files


def begins_with(path: Path, keys: tuple[str, ...]) -> bool:
    """Return whether a line near the beginning of a YAML file starts with one of these keys."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES).decode("utf-8", "replace")
    except OSError:
        return False
    return any(line.startswith(keys) for line in head.splitlines())


def _yaml_files(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.suffix in (".yaml", ".yml"))
    except OSError:
        return []


def _below(folder: Path) -> list[Path]:
    """Return the folders in a folder, sorted by name; empty if the folder is not readable."""
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries if entry.is_dir()]
    except OSError:
        return []
    return [folder / name for name in sorted(names) if not name.startswith(".")]


def _folder(parameters: Parameters, option: str, variable: str, usual: str) -> Path:
    return Path(str(parameters.get(option) or os.environ.get(variable) or usual))


_motions = _yaml("hil:", "hil_series:")
_schedules = _yaml("hil_schedule:")

BY_NAME: dict[str, Words] = {
    "run": _runs,
    "sources": _runs,
    "source": _runs,
    "validate": _runs,
    "bare": _runs,
    "data": _runs,
    "probes": _runs,
    "model": _models,
    "spec": _yaml("hil:", "hil_series:", "hil_schedule:"),
    "schedule": _schedules,
    "station": _yaml("hil_station:"),
    "robot": _robots,
    "estimator": _plugins("hil.estimators"),
    "map_": _yaml("hil_map:"),
    "version": _versions,
    "against": _versions,
    "word": _words("yes", "no"),
}
"""Completion function by name of the parameter, for all commands."""

BY_COMMAND: dict[tuple[str, str], Words] = {
    ("export", "to"): _words(*TARGETS),
    ("figures", "formats"): _words("pdf", "svg", "png"),
    ("figures", "width"): _words("column", "page"),
    ("study", "name"): _plugins("hil.studies"),
    ("bench", "name"): _benchmarks,
    ("mock", "name"): _plugins("hil.mocks", "list"),
    ("mock", "model"): _arms,
    ("mock", "profile"): _words("full", "ideal"),
    ("fit", "robot"): _arms,
    ("drive-gains", "robot"): _arms,
    ("drive-gains", "method"): _words("auto", "known-loads", "controller"),
    ("payload", "friction"): _words("auto", "model", "offset", "scale"),
    ("report", "run"): _runs_and_series,
    ("schema", "kind"): _words(*KINDS),
    ("new", "robot"): _arms,
    ("drift", "name"): _registered,
    ("run", "spec"): _motions,
    ("plan", "spec"): _motions,
    ("optimise", "spec"): _motions,
    ("fleet run", "spec"): _motions,
    ("fleet run", "robots"): _robots,
    **{
        (f"schedule {verb}", "file"): _schedules
        for verb in ("run", "arm", "plan", "show", "simulate", "hold", "release", "systemd")
    },
    ("record", "until"): _words("program-stops"),
    ("models register", "name"): _registered,
    ("models show", "name"): _registered,
    ("models compare", "name"): _registered,
    ("models promote", "name"): _registered,
    ("models promote", "on"): _runs,
    ("models rollback", "name"): _registered,
    ("models rollback", "to"): _versions,
    ("models log", "name"): _registered,
    ("models repair", "name"): _registered,
}
"""Completion function by command and parameter; takes precedence over `BY_NAME`."""
