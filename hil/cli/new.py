"""`hil new`: first versions of specs, stations, schedules and drivers, with comments."""

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
DRIVER = {"driver": "a robot driver of your own with its test: three files in a folder"}

app = typer.Typer()


@app.command()
def new(
    kind: Annotated[str, typer.Argument(help="What to begin; by default all are listed.")] = "",
    file: Annotated[
        Path | None,
        typer.Argument(help="The file to write; by default NAME.yaml.", show_default=False),
    ] = None,
    robot: Annotated[
        str, typer.Option("--robot", metavar="NAME", help="A robot of the station, or an arm.")
    ] = USUAL_ROBOT,
    name: Annotated[
        str, typer.Option("--name", help="What it is called; by default after robot and kind.")
    ] = "",
    urdf: Annotated[
        Path | None, typer.Option("--urdf", help="For own-urdf: the URDF of your arm.")
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder to write in, made when missing.")
    ] = Path(),
    list_: Annotated[bool, typer.Option("--list", help="Say what can be begun.")] = False,
    json: JsonFlag = False,
) -> None:
    """Begin a spec, a schedule, a station or a driver, with comments; overwrites nothing."""
    from hil.core import did_you_mean
    from hil.spec import DRAFT_KINDS, drafts

    kinds = DRAFT_KINDS | DRIVER
    if list_ or not kind:
        if json:
            print_json({"kinds": [{"kind": one, "what": what} for one, what in kinds.items()]})
        else:
            print_table(("kind", "what it is"), kinds.items())
            say("hil new KIND [FILE] writes one")
        return
    if kind not in kinds:
        raise SpecError(f"hil new makes no {kind!r}", hint=did_you_mean(kind, kinds))
    if (kind == URDF) != (urdf is not None):
        raise SpecError(
            f"hil new {URDF} needs --urdf ARM.urdf, and nothing else takes it",
            hint=f"hil new {URDF} --urdf ARM.urdf",
        )
    if kind in DRIVER:
        file = file or Path(name or "my-arm")
        files, commands = _write_driver(out / file.parent, name or file.name)
        _print(kind, files, commands, [], json)
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
        commands = commands if can_be_mocked(made) else ["hil plugins"]  # has the drivers
    elif kind == "station":
        model, notes = _model_of(robot)
        made = drafts(kind, path, robot=robot, name=name, model=model)
    else:
        made = drafts(kind, path, robot=robot, name=name)
        notes = _unknown_robot(path, robot)
    _print(kind, _write(made), commands, notes, json)


def _write_driver(folder: Path, name: str) -> tuple[list[Path], list[str]]:
    """Write the files of a driver into a new folder; return them, and the next commands."""
    from hil.core import write_replacing
    from hil.testing import driver_files

    new = folder / name
    files = {new / file: text for file, text in driver_files(name).items()}
    if new.exists():
        raise SpecError(
            f"{new} is there already; nothing was written", hint="give another --name or --out"
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
            f"{option} {name!r}: a name has letters, digits and `_.-`, and begins with a letter or "
            "a digit",
            hint=f"give another {option}",
        )


def _require_own_name(robot: str) -> None:
    """Refuse the name of a built-in robot, which would be taken if --station is left out."""
    from hil.arms import arm_names
    from hil.planning import mock_bench

    if robot in {*mock_bench().robots, *arm_names()}:
        raise SpecError(
            f"{robot!r} is a built-in robot, which would be taken wherever --station is left out",
            hint=f"give yours another name: --robot my-{robot}",
        )


def _model_of(robot: str) -> tuple[str, list[str]]:
    """Return the arm of a station's robot, and a note if it is not that of the robot's name."""
    from hil.arms import arm_names

    if robot in arm_names():
        return robot, []
    return USUAL_ROBOT, [
        f"there is no built-in arm {robot!r}: the station has `model: {USUAL_ROBOT}`; built in are "
        f"{', '.join(arm_names())}"
    ]


def _unknown_robot(path: Path, robot: str) -> list[str]:
    """Return a note if the station at which a spec would run has no such robot."""
    from hil.core import did_you_mean
    from hil.planning import find_station

    station, _, source = find_station(path.resolve().parent)
    if robot in station.robots:
        return []
    guess = did_you_mean(robot, station.robots)
    return [f"{source} has no robot {robot!r}; {guess} (or name another --station when you run it)"]


def _write(drafts: "list[Draft]") -> list[Path]:
    """Write all files or none, and the schemas that they name if these are not there yet."""
    from hil.core import write_replacing
    from hil.spec import require_valid, schemas_beside

    require_valid(drafts)
    existing = [str(draft.path) for draft in drafts if draft.path.exists()]
    if existing:
        raise SpecError(
            f"{', '.join(existing)}: there is such a file already; nothing was written",
            hint="give another FILE, --name or --out",
        )
    schemas = [draft for draft in schemas_beside(drafts) if not draft.path.exists()]
    for draft in (*drafts, *schemas):
        draft.path.parent.mkdir(parents=True, exist_ok=True)
        write_replacing(draft.path, draft.text.encode())
    return [draft.path for draft in (*drafts, *schemas)]


def _next(kind: str, file: Path) -> list[str]:
    """Return the commands that follow."""
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
