"""`hil new`: commented specs, stations, schedules, maps and plug-ins from templates."""

import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.options import JsonFlag
from hil.cli.output import print_json, print_table, say
from hil.core import SpecError

if TYPE_CHECKING:
    from hil.spec import Draft

USUAL_ROBOT = "ur5"
URDF = "own-urdf"
MAP = {"map": "map of the columns of a foreign recording, with a small sample recording"}

app = typer.Typer()


@app.command()
def new(
    kind: Annotated[
        str, typer.Argument(help="Kind of file to create; default: list all kinds.")
    ] = "",
    file: Annotated[
        Path | None,
        typer.Argument(help="File to write; default: NAME.yaml.", show_default=False),
    ] = None,
    robot: Annotated[
        str,
        typer.Option("--robot", metavar="NAME", help="Robot of the station, or a built-in arm."),
    ] = USUAL_ROBOT,
    name: Annotated[
        str,
        typer.Option(
            "--name", help="Name inside the new file; default: derived from robot and kind."
        ),
    ] = "",
    urdf: Annotated[
        Path | None, typer.Option("--urdf", help="URDF file of your arm, for own-urdf.")
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the new files; created if missing.")
    ] = Path(),
    list_: Annotated[bool, typer.Option("--list", help="List all kinds of files.")] = False,
    json: JsonFlag = False,
) -> None:
    """Create a commented spec, schedule, station or plug-in from a template; overwrite nothing."""
    from hil.core import did_you_mean
    from hil.spec import DRAFT_KINDS, drafts
    from hil.testing import PLUGIN_KINDS

    kinds = DRAFT_KINDS | MAP | PLUGIN_KINDS
    if list_ or not kind:
        if json:
            print_json({"kinds": [{"kind": one, "what": what} for one, what in kinds.items()]})
        else:
            print_table(("kind", "description"), kinds.items())
            say("hil new KIND [FILE] creates one")
        return
    if kind not in kinds:
        raise SpecError(f"hil new: unknown kind {kind!r}", hint=did_you_mean(kind, kinds))
    if (kind == URDF) != (urdf is not None):
        raise SpecError(
            f"hil new {URDF} requires --urdf ARM.urdf; other kinds do not accept --urdf",
            hint=f"hil new {URDF} --urdf ARM.urdf",
        )
    if kind in PLUGIN_KINDS:
        file = file or Path(name or f"my-{kind}")
        files, commands = _write_plugin(kind, out / file.parent, name or file.name)
        _print(kind, files, commands, [], json)
        return
    if kind in MAP:
        path = out / (file or f"{name or 'my-recording'}.yaml")
        _print(kind, *_write_map(path, robot), [], json)
        return
    robot = urdf.stem if urdf is not None and robot == USUAL_ROBOT else robot
    usual = {"station": "", URDF: robot}.get(kind, f"{robot}-{kind}")
    name = name or (file.stem if file else usual)
    path = out / (file or f"{name or 'station'}.yaml")
    _require_name("--robot", robot)
    _require_name("--name", name := name or "bench")
    notes: list[str] = []
    commands = _next(kind, path)
    if urdf is not None:
        from hil.planning import can_be_mocked, own_arm_drafts

        _require_own_name(robot)
        made, notes = own_arm_drafts(urdf, path, robot=robot, name=name)
        commands = commands if can_be_mocked(made) else ["hil plugins"]  # lists the drivers
    elif kind == "station":
        model, notes = _model_of(robot)
        made = drafts(kind, path, robot=robot, name=name, model=model)
    else:
        made = drafts(kind, path, robot=robot, name=name)
        notes = _unknown_robot(path, robot)
    _print(kind, _write(made), commands, notes, json)


def _write_map(path: Path, robot: str) -> tuple[list[Path], list[str]]:
    """Write an import map and a sample recording; return the files and the next commands.

    Raises:
        SpecError: One of the files exists already.
    """
    from hil.core import write_replacing
    from hil.importers import sample_map

    recording = path.with_suffix(".csv")
    for file in (path, recording):
        if file.exists():
            raise SpecError(
                f"{file} exists already; nothing was written",
                hint="choose a different FILE, --name or --out",
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    for file, text in zip((path, recording), sample_map(robot), strict=True):
        write_replacing(file, text.encode())
    source, made = shlex.quote(str(recording)), shlex.quote(str(path.with_suffix(".mcap")))
    return [path, recording], [
        f"hil import {source} --map {shlex.quote(str(path))} -o {made}",
        f"hil fit {made} --estimator rigid-wls",
    ]


def _write_plugin(kind: str, folder: Path, name: str) -> tuple[list[Path], list[str]]:
    """Write the files of a plug-in into a new folder; return the files and the next commands.

    Raises:
        SpecError: The folder exists already, or the name cannot be used.
    """
    from hil.core import write_replacing
    from hil.testing import plugin_files

    new = folder / name
    files = {new / file: text for file, text in plugin_files(kind, name).items()}
    if new.exists():
        raise SpecError(
            f"{new} exists already; nothing was written", hint="choose a different --name or --out"
        )
    new.mkdir(parents=True)
    for path, text in files.items():
        write_replacing(path, text.encode())
    at = shlex.quote(str(new))
    return list(files), [
        'pip install "hil[testing]"',
        f"pip install -e {at}",
        f"python -m pytest {at}",
        "hil plugins",
    ]


NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


def _require_name(option: str, name: str) -> None:
    if not NAME.fullmatch(name):
        raise SpecError(
            f"{option} {name!r}: a name consists of letters, digits and `_.-`, and begins with a "
            "letter or a digit",
            hint=f"choose a different {option}",
        )


def _require_own_name(robot: str) -> None:
    """Raise if a robot has the name of a built-in robot, which commands without --station use."""
    from hil.arms import arm_names
    from hil.planning import mock_bench

    if robot in {*mock_bench().robots, *arm_names()}:
        raise SpecError(
            f"{robot!r} is the name of a built-in robot, which commands without --station use",
            hint=f"choose a different name: --robot my-{robot}",
        )


def _model_of(robot: str) -> tuple[str, list[str]]:
    """Return the arm of a station's robot, and a note if the arm has a different name."""
    from hil.arms import arm_names

    if robot in arm_names():
        return robot, []
    return USUAL_ROBOT, [
        f"{robot!r} is not a built-in arm: the station has `model: {USUAL_ROBOT}`; built-in arms "
        f"are {', '.join(arm_names())}"
    ]


def _unknown_robot(path: Path, robot: str) -> list[str]:
    """Return a note if the station that a spec would use does not contain this robot."""
    from hil.core import did_you_mean
    from hil.planning import find_station

    station, _, source = find_station(path.resolve().parent)
    if robot in station.robots:
        return []
    guess = did_you_mean(robot, station.robots)
    return [f"{source} has no robot {robot!r}; {guess} (or pass a different --station to hil run)"]


def _write(drafts: "list[Draft]") -> list[Path]:
    """Write all files or no file; also write the schemas that the files name, if missing."""
    from hil.core import write_replacing
    from hil.spec import require_valid, schemas_beside

    require_valid(drafts)
    existing = [str(draft.path) for draft in drafts if draft.path.exists()]
    if existing:
        raise SpecError(
            f"{', '.join(existing)}: exists already; nothing was written",
            hint="choose a different FILE, --name or --out",
        )
    schemas = [draft for draft in schemas_beside(drafts) if not draft.path.exists()]
    for draft in (*drafts, *schemas):
        draft.path.parent.mkdir(parents=True, exist_ok=True)
        write_replacing(draft.path, draft.text.encode())
    return [draft.path for draft in (*drafts, *schemas)]


def _next(kind: str, file: Path) -> list[str]:
    """Return the commands that are useful next for a new file."""
    path, folder = (shlex.quote(str(place)) for place in (file, file.parent))
    if kind == "station":
        return [f"hil new fourier --out {folder}", f"hil run SPEC --station {path}"]
    if kind == "re-identify":
        return [
            f"hil validate {path}",
            f"hil schedule plan {path}",
            f"hil schedule simulate {path} 30min",
            f"hil schedule run {path}",
        ]
    station = ""
    if kind == URDF:
        station = f" --station {shlex.quote(str(file.with_name(f'{file.stem}-station.yaml')))}"
    return [f"hil {verb} {path}{station}" for verb in ("validate", "plan", "run")]


def _print(kind: str, files: list[Path], commands: list[str], notes: list[str], json: bool) -> None:
    if json:
        names = [str(file) for file in files]
        print_json({"kind": kind, "files": names, "next": commands, "notes": notes})
        return
    for file in files:
        typer.echo(file)
    for note in notes:
        say(f"note: {note}")
    typer.echo("next:")
    for command in commands:
        typer.echo(f"  {command}")
