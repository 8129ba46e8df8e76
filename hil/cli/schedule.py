"""`hil schedule`: probe a robot, and identify it again, when it is due."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.attended import OperatorOption
from hil.cli.output import (
    JsonFlag,
    RunsOption,
    StationOption,
    duration,
    print_json,
    say,
)
from hil.cli.registry import HERE, RegistryOption
from hil.cli.schedule_words import SHOWN, held_words, next_words, print_ledger, print_plan, words
from hil.cli.simulating import simulate
from hil.core import DataError, HilError, SpecError

if TYPE_CHECKING:
    from zoneinfo import ZoneInfo

    from hil.maintenance import Ledger
    from hil.spec import ScheduleSpec

FileArgument = Annotated[Path, typer.Argument(help="Schedule (YAML).", show_default=False)]
StateOption = Annotated[
    Path | None,
    typer.Option("--state", help="Folder of its ledger; by default schedules/NAME."),
]
ReasonOption = Annotated[str, typer.Option("--reason", help="For the ledger.", show_default=False)]
STATES = Path("schedules")

app = typer.Typer(
    no_args_is_help=True,
    help="Probe a robot, and identify it again when it has changed: whenever it is due.",
)


def register(parent: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(simulate)
    parent.add_typer(app, name="schedule")


@app.command()
def run(
    file: FileArgument,
    once: Annotated[bool, typer.Option("--once", help="Do what is due now, and end.")] = False,
    state: StateOption = None,
    registry: RegistryOption = HERE,
    runs: RunsOption = Path("runs"),
    station: StationOption = None,
) -> None:
    """Do what is due whenever it is, until Ctrl-C or SIGTERM."""
    from hil.maintenance import (
        Command,
        Motions,
        RobotReady,
        Scheduler,
        WallClock,
        bind_file,
        interrupt_at,
        motions,
        open_ledger,
        reidentification,
        require_room,
    )
    from hil.models import Registry
    from hil.workflow import require_armed, require_extras

    bound = bind_file(file, station)
    for experiment in bound.experiments:
        require_extras(experiment.spec)
    spec, took = bound.spec, Motions()
    if spec.blackout:  # nothing else asks, and planning takes seconds
        took = motions(spec, bound.probe, bound.campaign)
        require_room(spec, took, datetime.now(UTC))
    confirm = require_armed(bound.moves(file), _state(spec, state))
    work = reidentification(
        spec, registry=Registry(registry), runs=runs, station=station, confirm=confirm,
        tell=_tell_stage,
    )  # fmt: skip
    zone, wait_s = _zone(spec), spec.wait_for_robot.total_seconds()
    with open_ledger(_state(spec, state), spec.name) as ledger, WallClock() as clock:
        scheduler = Scheduler(
            spec, ledger, work, clock,
            lasting=took.longest,
            ready=RobotReady(bound.campaign, wait_s, _tell_stage),
            guard=interrupt_at,
            tell=lambda line: say(words(line, zone)),
            notify=Command(spec.notify, spec.name),
        )  # fmt: skip
        if once:
            scheduler.run_once()
        else:
            scheduler.run_due()
        if held := ledger.standing.held:
            say(held_words(held, file, zone))
        elif not once:
            say(next_words(scheduler.next_moment(), zone))
        if not once:
            scheduler.run()
    if once and scheduler.failure is not None:
        raise scheduler.failure


@app.command()
def arm(
    file: FileArgument,
    state: StateOption = None,
    station: StationOption = None,
    operator: OperatorOption = "",
    yes: Annotated[bool, typer.Option("--yes", help="Confirm without a prompt; recorded.")] = False,
    json: JsonFlag = False,
) -> None:
    """Confirm once that a schedule may move its real robot; connects to nothing.

    Repeat it after a change of the file, an experiment, or the robot's entry in the station.
    """
    from hil.maintenance import bind_file
    from hil.workflow import arm as arm_moves

    bound = bind_file(file, station)
    folder = _state(bound.spec, state)
    moves = bound.moves(file)
    done = arm_moves(moves, folder, station=station, who=operator, yes=yes)
    if json:
        print_json({"schedule": bound.spec.name, "armed": done})
    elif done is None:
        say(f"{bound.spec.name} moves no real robot and needs no arming")
    else:
        say(f"{bound.spec.name}: {_armed_words(done)}")


@app.command()
def plan(
    file: FileArgument,
    weeks: Annotated[
        float, typer.Option("--weeks", min=0, max=520, help="How far to look ahead.")
    ] = 4.0,
    until: Annotated[
        str | None,
        typer.Option(
            "--until",
            metavar="DATE",
            help="In place of weeks: a day, itself included, or 2026-11-28T03:00.",
        ),
    ] = None,
    state: StateOption = None,
    station: StationOption = None,
    json: JsonFlag = False,
) -> None:
    """What would happen when, if nothing is found; does nothing."""
    from hil.maintenance import Ledger, bind_file, forecast, motions, require_room

    bound, now = bind_file(file, station), datetime.now(UTC)
    spec = bound.spec
    zone = _zone(spec)
    end = _end(until, zone) if until else now + timedelta(weeks=weeks)
    if end <= now:
        raise SpecError(f"--until {until} is past", hint="give a later one")
    took = motions(spec, bound.probe, bound.campaign)
    require_room(spec, took, now)
    ledger = Ledger.read(_state(spec, state))
    ledger.require_of(spec.name)
    expected = forecast(spec, ledger, took, now, end, alike=None if json else SHOWN)
    if json:
        told: dict[str, object] = {
            "schedule": spec.name, "from": _iso(now, zone), "until": _iso(end, zone),
        }  # fmt: skip
        longest = took.longest("probe" if spec.probe else "campaign").total_seconds()
        told["held"] = dict(ledger.standing.held) if ledger.standing.held else None
        seconds = {"probe_s": took.probe.total_seconds(),
                   "campaign_s": took.campaign.total_seconds(), "at_most_s": longest}  # fmt: skip
        print_json({**told, **seconds, "expected": [one.to_dict(zone) for one in expected]})
        return
    if held := ledger.standing.held:
        say(held_words(held, file, zone))
    print_plan(spec, expected, zone)
    probe = f"probe {duration(took.probe.total_seconds())}, " if spec.probe else ""
    say(f"of motion: {probe}campaign {duration(took.campaign.total_seconds())}")


@app.command()
def show(file: FileArgument, state: StateOption = None, json: JsonFlag = False) -> None:
    """What was done, and what was not and why; what is due next."""
    from hil.core import LOCK, holder_of
    from hil.maintenance import clock_problem
    from hil.workflow import read_armed

    spec, folder, ledger = _led(file, state)
    zone, now, standing = _zone(spec), datetime.now(UTC), ledger.standing
    holder, coming, armed = holder_of(folder / LOCK), _coming(spec, ledger, now), read_armed(folder)
    if json:
        print_json({
            "schedule": spec.name, "state": str(folder), "run_by": holder and holder.told(zone),
            "held": dict(standing.held) if standing.held else None,
            "armed": armed and {key: armed[key] for key in ("how", "by", "at", "robots")},
            "open": standing.open.id if standing.open else None,
            "next": coming and _iso(coming, zone), "lines": [dict(line) for line in ledger.lines],
        })  # fmt: skip
        return
    if armed is not None or spec.robots:
        say(_armed_now(armed, file))
    if not ledger.lines:
        say(f"{spec.name} has never been started: hil schedule run {file}")
        return
    print_ledger(ledger.lines, zone)
    if standing.held or (wrong := clock_problem(standing, now)):
        say(held_words(standing.held, file, zone) if standing.held else wrong)
    else:
        say(next_words(coming, zone))
    say(f"run by {holder.told(zone)}" if holder else f"nobody runs it: hil schedule run {file}")


@app.command()
def hold(file: FileArgument, reason: ReasonOption, state: StateOption = None) -> None:
    """Let nothing begin until it is released; what is under way comes to its end."""
    from hil.maintenance import hold as hold_ledger

    spec, _, ledger = _begun(file, state)
    say(words(hold_ledger(ledger, datetime.now(UTC), reason), _zone(spec)))


@app.command()
def release(file: FileArgument, reason: ReasonOption, state: StateOption = None) -> None:
    """Let a schedule go on that is held; somebody has looked at the robot."""
    from hil.maintenance import choose
    from hil.maintenance import release as release_ledger

    spec, _, ledger = _begun(file, state)
    zone, now = _zone(spec), datetime.now(UTC)
    say(words(release_ledger(ledger, now, reason), zone))
    if (waits := choose(spec, ledger.standing, now).occasion) is not None:
        say(f"{waits.id} has waited: whoever runs the schedule begins it within a minute")
    else:
        say(next_words(_coming(spec, ledger, now), zone))


@app.command()
def systemd(
    file: FileArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the units.")] = Path(),
    user: Annotated[bool, typer.Option("--user", help="For systemctl --user.")] = False,
    timer: Annotated[
        bool, typer.Option("--timer", help="A timer that calls, not a service that stays.")
    ] = False,
    state: StateOption = None,
    registry: RegistryOption = HERE,
    runs: RunsOption = Path("runs"),
    station: StationOption = None,
    json: JsonFlag = False,
) -> None:
    """Write units that run it, with the paths of these options; installs nothing."""
    from hil.maintenance import bind_file, next_words, units_of, write_units

    spec = bind_file(file, station).spec
    arguments = [str(file.resolve())]
    given = {"--state": _state(spec, state), "--registry": registry, "--runs": runs}
    for option, path in (given | ({"--station": station} if station else {})).items():
        arguments += [option, str(path.resolve())]
    units = units_of(spec.name, tuple(arguments), Path.cwd(), timer=timer, user=user)
    files = write_units(units, out)
    commands = next_words(units, out, user=user)
    if json:
        print_json(
            {"schedule": spec.name, "files": [str(path) for path in files], "next": commands}
        )
        return
    for path in files:
        typer.echo(path)
    typer.echo("to install them:")
    for command in commands:
        typer.echo(f"  {command}")


def _armed_words(armed: dict[str, Any]) -> str:
    robots = ", ".join(f"{name} at {address}" for name, address in armed["robots"].items())
    return f"armed for {robots} by {armed['by']} ({armed['how']}, {armed['at'][:16]} UTC)"


def _armed_now(armed: dict[str, Any] | None, file: Path) -> str:
    """Return whether a schedule is armed, and what has changed since."""
    from hil.maintenance import bind_file
    from hil.workflow import changed_since

    if armed is None:
        return f"not armed: hil schedule arm {file}"
    station = Path(armed["station"]) if armed.get("station") else None
    try:
        changed = changed_since(armed, bind_file(file, station).moves(file))
    except HilError as error:
        return f"{_armed_words(armed)}, but: {error.message}"
    if not changed:
        return _armed_words(armed)
    return f"{_armed_words(armed)}; changed since: {', '.join(changed)}; arm it again"


def _zone(spec: "ScheduleSpec") -> "ZoneInfo":
    from zoneinfo import ZoneInfo

    return ZoneInfo(spec.timezone)


def _state(spec: "ScheduleSpec", given: Path | None) -> Path:
    return given or STATES / spec.name


def _led(file: Path, state: Path | None) -> "tuple[ScheduleSpec, Path, Ledger]":
    """The schedule, the folder of its state, and what became of everything."""
    from hil.maintenance import Ledger
    from hil.spec import load_schedule_spec

    spec = load_schedule_spec(file)
    folder = _state(spec, state)
    ledger = Ledger.read(folder)
    ledger.require_of(spec.name)
    return spec, folder, ledger


def _begun(file: Path, state: Path | None) -> "tuple[ScheduleSpec, Path, Ledger]":
    """The same of a schedule that has been started."""
    spec, folder, ledger = _led(file, state)
    if not ledger.lines:
        raise DataError(
            f"{folder}: {spec.name} has never been started", hint="is it kept elsewhere? --state"
        )
    return spec, folder, ledger


def _coming(spec: "ScheduleSpec", ledger: "Ledger", now: datetime) -> datetime | None:
    """When something is due next that is not settled."""
    from hil.maintenance import occasions

    standing = ledger.standing
    after = max(now, standing.until or now)
    coming = next(occasions(spec, standing.anchor or now, after), None)
    return coming.due if coming else None


def _end(text: str, zone: "ZoneInfo") -> datetime:
    """The end of a day, or a time of day there."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise SpecError(
            f"--until {text!r} is no date", hint="such as 2026-11-28 or 2026-11-28T03:00"
        ) from None
    if len(text) <= len("2026-11-28"):
        moment += timedelta(days=1)
    return moment if moment.tzinfo else moment.replace(tzinfo=zone)


def _tell_stage(text: str) -> None:
    say(f"  {text}")


def _iso(moment: datetime, zone: "ZoneInfo") -> str:
    return moment.astimezone(zone).isoformat(timespec="seconds")
