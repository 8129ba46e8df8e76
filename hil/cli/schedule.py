"""`hil schedule`: probe a robot, and re-identify it, at due times.

The verb `run` works in the foreground until it is stopped, and records every action in the ledger
in the state folder of the schedule. The verbs `show`, `hold` and `release` read and write the
ledger of the schedule. Times of occasions are printed in the time zone of the schedule.
"""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.options import (
    REGISTRY,
    JsonFlag,
    OperatorOption,
    RegistryOption,
    RunsOption,
    ScheduleArgument,
    StationOption,
    parse_duration,
)
from hil.cli.output import fail, ignore_from_now_on, print_json, print_table, say
from hil.core import DataError, HilError, SpecError
from hil.report import duration

if TYPE_CHECKING:
    from zoneinfo import ZoneInfo

    from hil.maintenance import Expected, Ledger, Line
    from hil.spec import ScheduleSpec

StateOption = Annotated[
    Path | None,
    typer.Option("--state", help="State folder of the schedule; default: schedules/NAME."),
]
ReasonOption = Annotated[
    str, typer.Option("--reason", help="Reason; recorded in the ledger.", show_default=False)
]

app = typer.Typer(
    name="schedule",
    no_args_is_help=True,
    help="Probe a robot on a schedule and re-identify it when it has changed.",
)


@app.command()
def run(
    file: ScheduleArgument,
    once: Annotated[
        bool, typer.Option("--once", help="Execute the occasions that are due now, then exit.")
    ] = False,
    state: StateOption = None,
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    station: StationOption = None,
) -> None:
    """Execute a schedule until Ctrl-C or SIGTERM."""
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
    spec, times = bound.spec, Motions()
    if spec.blackout:  # only blackouts need the durations, and planning takes seconds
        times = motions(spec, bound.probe, bound.campaign)
        require_room(spec, times, datetime.now(UTC))
    folder, zone = _state(spec, state), _zone(spec)

    def tell_stage(text: str) -> None:
        say(f"  {text}")

    work = reidentification(
        spec,
        registry=Registry(registry),
        runs=runs,
        station=station,
        confirm=require_armed(bound.moves(file), folder),
        tell=tell_stage,
    )
    with open_ledger(folder, spec.name) as ledger, WallClock() as clock:
        scheduler = Scheduler(
            spec,
            ledger,
            work,
            clock,
            lasting=times.longest,
            ready=RobotReady(bound.campaign, spec.wait_for_robot.total_seconds(), tell_stage),
            guard=interrupt_at,
            tell=lambda line: say(_line_words(line, zone)),
            notify=Command(spec.notify, spec.name),
        )
        if once:
            scheduler.run_once()
        else:
            scheduler.run_due()
        if held := ledger.standing.held:
            say(_held_words(held, file, zone))
        elif not once:
            say(_next_words(scheduler.next_moment(), zone))
        if not once:
            scheduler.run()
    if once and scheduler.failure is not None:
        raise scheduler.failure


@app.command()
def arm(
    file: ScheduleArgument,
    state: StateOption = None,
    station: StationOption = None,
    operator: OperatorOption = "",
    yes: Annotated[
        bool, typer.Option("--yes", help="Confirm without a prompt; recorded in the ledger.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Confirm that a schedule may move its real robot at every occasion; does not connect.

    Repeat the confirmation after a change of the schedule, an experiment, or the robot in the
    station.
    """
    from hil.maintenance import bind_file
    from hil.workflow import arm as arm_moves

    bound = bind_file(file, station)
    name, folder = bound.spec.name, _state(bound.spec, state)
    armed = arm_moves(bound.moves(file), folder, station=station, who=operator, yes=yes)
    if json:
        print_json({"schedule": name, "armed": armed})
    elif armed is None:
        say(f"{name} moves no real robot and needs no arming")
    else:
        say(f"{name}: {_armed_words(armed)}")


def _armed_words(armed: Mapping[str, Any]) -> str:
    robots = ", ".join(f"{name} at {address}" for name, address in armed["robots"].items())
    return f"armed for {robots} by {armed['by']} ({armed['how']}, {armed['at'][:16]} UTC)"


MOST_ALIKE = 40
"""Maximum number of similar rows in the output of `plan`; probes every minute would fill the
terminal."""


@app.command()
def plan(
    file: ScheduleArgument,
    weeks: Annotated[
        float, typer.Option("--weeks", min=0, max=520, help="Number of weeks to list.")
    ] = 4.0,
    until: Annotated[
        str | None,
        typer.Option(
            "--until",
            metavar="DATE",
            help="Last day or moment to list, such as 2026-11-28 or 2026-11-28T03:00, instead of "
            "--weeks.",
        ),
    ] = None,
    state: StateOption = None,
    station: StationOption = None,
    json: JsonFlag = False,
) -> None:
    """List the coming occasions of a schedule; execute nothing."""
    from hil.maintenance import Ledger, bind_file, forecast, motions, require_room

    bound, now = bind_file(file, station), datetime.now(UTC)
    spec = bound.spec
    zone = _zone(spec)
    end = _end(until, zone) if until else now + timedelta(weeks=weeks)
    if end <= now:
        raise SpecError(f"--until {until} is in the past", hint="choose a later date")
    times = motions(spec, bound.probe, bound.campaign)
    require_room(spec, times, now)
    ledger = Ledger.read(_state(spec, state))
    ledger.require_of(spec.name)
    held = ledger.standing.held
    expected = forecast(spec, ledger, times, now, end, alike=None if json else MOST_ALIKE)
    if json:
        longest = times.longest("probe" if spec.probe else "campaign")
        document = {
            "schedule": spec.name,
            "from": _iso(now, zone),
            "until": _iso(end, zone),
            "held": dict(held) if held else None,
            "probe_s": times.probe.total_seconds(),
            "campaign_s": times.campaign.total_seconds(),
            "at_most_s": longest.total_seconds(),
            "expected": [one.to_dict(zone) for one in expected],
        }
        print_json(document)
        return
    if held:
        say(_held_words(held, file, zone))
    _print_expected(expected, zone)
    probe = f"probe {duration(times.probe.total_seconds())}, " if spec.probe else ""
    say(f"duration of motion: {probe}campaign {duration(times.campaign.total_seconds())}")


def _end(text: str, zone: "ZoneInfo") -> datetime:
    """Return the point in time for a text; for a text without time of day, the end of the day."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise SpecError(
            f"--until {text!r} is not a date", hint="for example: --until 2026-11-28T03:00"
        ) from None
    if len(text) <= len("2026-11-28"):
        moment += timedelta(days=1)
    return moment if moment.tzinfo else moment.replace(tzinfo=zone)


def _print_expected(expected: "Iterable[Expected]", zone: "ZoneInfo") -> None:
    """Print expected occasions as a table: the first of each kind, and the number of the others."""
    rows = []
    alike: dict[tuple[str, str], list[Expected]] = {}
    for one in expected:
        kind = alike.setdefault((one.job, one.what), [])
        kind.append(one)
        if len(kind) > MOST_ALIKE:
            continue
        times = f" ({one.count} times)" if one.count > 1 else ""
        begins = "skipped" if one.begins is None else f"{one.begins.astimezone(zone):%a %H:%M:%S}"
        motion = duration(one.motion.total_seconds()) if one.motion else ""
        why = "resumed" + (f", {one.why}" if one.why else "") if one.again else one.why
        rows.append((_minute(one.due, zone), one.job + times, begins, motion, why))
    if not rows:
        say("no occasion is due in this period")
        return
    print_table((f"due ({zone})", "occasion", "begins", "motion", "reason for a delay"), rows)
    for (job, what), kind in alike.items():
        if rest := kind[MOST_ALIKE:]:
            count = f"{sum(one.count for one in rest)} more: {job}"
            missed = ", skipped" if what == "missed" else ""
            say(f"… and {count}{missed}, until {_minute(rest[-1].due, zone)}")


@app.command()
def show(file: ScheduleArgument, state: StateOption = None, json: JsonFlag = False) -> None:
    """Show executed and skipped occasions with reasons, and the next due occasion."""
    from hil.core import LOCK, holder_of
    from hil.maintenance import clock_problem
    from hil.workflow import read_armed

    spec, folder, ledger = _read(file, state)
    zone, now, standing = _zone(spec), datetime.now(UTC), ledger.standing
    holder, armed, due = holder_of(folder / LOCK), read_armed(folder), _next_due(spec, ledger, now)
    if json:
        document = {
            "schedule": spec.name,
            "state": str(folder),
            "run_by": holder and holder.told(zone),
            "held": dict(standing.held) if standing.held else None,
            "armed": armed and {key: armed[key] for key in ("how", "by", "at", "robots")},
            "open": standing.open.id if standing.open else None,
            "next": due and _iso(due, zone),
            "lines": [dict(line) for line in ledger.lines],
        }
        print_json(document)
        return
    if armed is not None or spec.robots:
        say(_still_armed(armed, file))
    if not ledger.lines:
        say(f"{spec.name} has never been started: hil schedule run {file}")
        return
    rows = [_cells(line, zone) for line in ledger.lines]
    print_table((f"time ({zone})", "event", "occasion", "details"), rows)
    if standing.held:
        say(_held_words(standing.held, file, zone))
    else:
        say(clock_problem(standing, now) or _next_words(due, zone))
    say(f"run by {holder.told(zone)}" if holder else f"not running: hil schedule run {file}")


def _still_armed(armed: dict[str, Any] | None, file: Path) -> str:
    """Return whether a schedule is armed, and the changes of its files since arming."""
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


@app.command()
def hold(file: ScheduleArgument, reason: ReasonOption, state: StateOption = None) -> None:
    """Suspend a schedule until `hil schedule release`; an active occasion is completed."""
    from hil.maintenance import hold as hold_ledger

    spec, ledger = _read_started(file, state)
    say(_line_words(hold_ledger(ledger, datetime.now(UTC), reason), _zone(spec)))


@app.command()
def release(file: ScheduleArgument, reason: ReasonOption, state: StateOption = None) -> None:
    """Release a suspended schedule after an operator has inspected the robot."""
    from hil.maintenance import choose
    from hil.maintenance import release as release_ledger

    spec, ledger = _read_started(file, state)
    zone, now = _zone(spec), datetime.now(UTC)
    say(_line_words(release_ledger(ledger, now, reason), zone))
    if (waits := choose(spec, ledger.standing, now).occasion) is not None:
        say(f"{waits.id} is overdue: the process of the schedule begins it within a minute")
    else:
        say(_next_words(_next_due(spec, ledger, now), zone))


@app.command()
def systemd(
    file: ScheduleArgument,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the systemd units; created if missing.")
    ] = Path(),
    user: Annotated[
        bool, typer.Option("--user", help="Write units for `systemctl --user`.")
    ] = False,
    timer: Annotated[
        bool, typer.Option("--timer", help="Write a timer instead of a permanent service.")
    ] = False,
    state: StateOption = None,
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    station: StationOption = None,
    json: JsonFlag = False,
) -> None:
    """Write systemd units that execute a schedule; install nothing."""
    from hil.maintenance import bind_file, next_words, units_of, write_units

    spec = bind_file(file, station).spec
    paths = {"--state": _state(spec, state), "--registry": registry, "--runs": runs}
    paths |= {"--station": station} if station else {}
    arguments = [str(file.resolve())]
    for option, path in paths.items():
        arguments += [option, str(path.resolve())]
    units = units_of(spec.name, tuple(arguments), Path.cwd(), timer=timer, user=user)
    files = write_units(units, out)
    commands = next_words(units, out, user=user)
    if json:
        names = [str(path) for path in files]
        print_json({"schedule": spec.name, "files": names, "next": commands})
        return
    for path in files:
        typer.echo(path)
    typer.echo("to install them:")
    for command in commands:
        typer.echo(f"  {command}")


@app.command()
def simulate(
    file: ScheduleArgument,
    lasting: Annotated[
        str,
        typer.Argument(
            metavar="DURATION", help="Simulated duration, such as 12w.", show_default=False
        ),
    ],
    station: StationOption = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Simulate weeks of a schedule on the embedded mock robot, which wears and heats up."""
    from hil.core import new_folder, read_source
    from hil.maintenance import bind, require_mock
    from hil.maintenance import simulate as live_through
    from hil.recording import name_for_path
    from hil.report import render_simulation
    from hil.spec import load_schedule_spec
    from hil.workflow import require_extras

    source = read_source(file)
    span = parse_duration("DURATION", lasting, "12w, 30min")
    spec = load_schedule_spec(source)
    bound = bind(spec, station, source)
    require_mock(bound)
    for experiment in bound.experiments:
        require_extras(experiment.spec)
    above = runs / datetime.now().astimezone().date().isoformat() / "simulations"
    folder = new_folder(above, f"simulation-{name_for_path(spec.name)}")
    result = live_through(spec, span, folder, station=station, tell=_tell_simulated)
    page = render_simulation(folder)
    ignore_from_now_on()
    occasions = result["occasions"]
    if json:
        print_json(result | {"folder": str(folder), "report": str(page)})
    else:
        weeks = span >= timedelta(weeks=1)
        columns = ("week" if weeks else "after", "room [°C]", "champion", "result")
        print_table(columns, [_simulated_row(each, weeks=weeks) for each in occasions])
        typer.echo(f"report: {page}")
    if failed := [each for each in occasions if each["event"] == "failed"]:
        message = f"{len(failed)} of {len(occasions)} occasions failed: {failed[0]['why']}"
        fail(HilError(message, hint=f"see {folder}"), json)


def _tell_simulated(line: Mapping[str, Any]) -> None:
    if line["event"] in ("done", "failed", "missed", "deferred"):
        text = line.get("why") or line["result"]["text"]
        typer.echo(f"{line['at'][:16]} {line['occasion']}: {text}", err=True)


def _simulated_row(occasion: Mapping[str, Any], *, weeks: bool) -> tuple[str, ...]:
    result, week = occasion["result"] or {}, occasion["week"]
    text = str(result.get("text") or f"{occasion['event']}: {occasion['why']}")
    at = f"{week:g}" if weeks else f"{week * 7 * 24 * 60:.0f} min"
    return at, f"{occasion['room_c']:g}", str(result.get("champion") or ""), text


# The state of a schedule


def _state(spec: "ScheduleSpec", folder: Path | None) -> Path:
    return folder or Path("schedules") / spec.name


def _read(file: Path, state: Path | None) -> "tuple[ScheduleSpec, Path, Ledger]":
    """Return the schedule, the folder of its state, and its ledger."""
    from hil.maintenance import Ledger
    from hil.spec import load_schedule_spec

    spec = load_schedule_spec(file)
    folder = _state(spec, state)
    ledger = Ledger.read(folder)
    ledger.require_of(spec.name)
    return spec, folder, ledger


def _read_started(file: Path, state: Path | None) -> "tuple[ScheduleSpec, Ledger]":
    """Return a schedule that has been started at least once, and its ledger."""
    spec, folder, ledger = _read(file, state)
    if not ledger.lines:
        raise DataError(
            f"{folder}: {spec.name} has never been started",
            hint="if its state is in a different folder: --state FOLDER",
        )
    return spec, ledger


def _next_due(spec: "ScheduleSpec", ledger: "Ledger", now: datetime) -> datetime | None:
    """Return the due time of the next occasion that is not completed yet."""
    from hil.maintenance import occasions

    standing = ledger.standing
    after = max(now, standing.until or now)
    occasion = next(occasions(spec, standing.anchor or now, after), None)
    return occasion.due if occasion else None


# Texts for times and lines of the ledger


def _zone(spec: "ScheduleSpec") -> "ZoneInfo":
    from zoneinfo import ZoneInfo

    return ZoneInfo(spec.timezone)


def _iso(moment: datetime, zone: "ZoneInfo") -> str:
    return moment.astimezone(zone).isoformat(timespec="seconds")


def _minute(moment: datetime, zone: "ZoneInfo") -> str:
    return f"{moment.astimezone(zone):%a %Y-%m-%d %H:%M}"


def _next_words(moment: datetime | None, zone: "ZoneInfo") -> str:
    return f"next: {_minute(moment, zone)} ({zone})" if moment else "no further occasion is due"


def _held_words(line: "Line", file: Path, zone: "ZoneInfo") -> str:
    return (
        f"held since {_cells(line, zone)[0]} ({zone}): {line['why']}\n"
        f"  → after inspecting the robot: hil schedule release {file} --reason TEXT"
    )


def _line_words(line: "Line", zone: "ZoneInfo") -> str:
    return "  ".join(cell for cell in _cells(line, zone) if cell)


def _cells(line: "Line", zone: "ZoneInfo") -> tuple[str, str, str, str]:
    """Return a line of the ledger as four texts: time, event, occasion, and details."""
    at = f"{datetime.fromisoformat(line['at']).astimezone(zone):%Y-%m-%d %H:%M:%S}"
    count = int(line.get("count", 1))
    more = f" and {count - 1} before it" if count > 1 else ""
    occasion = f"{line.get('occasion', '')}{more}"
    return at, str(line["event"]), occasion, _text(line)


def _text(line: "Line") -> str:
    result: dict[str, Any] = line.get("result") or {}
    if result:
        return f"{result.get('outcome', '')}: {result.get('text', '')}"
    why = str(line.get("why", "")) or ("again" if line.get("again") else "")
    return f"{line['by']}: {why}" if "by" in line else why
