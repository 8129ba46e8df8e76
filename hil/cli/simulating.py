"""`hil schedule simulate SCHEDULE 12w`: weeks of a schedule on the embedded mock, at once."""

from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.output import JsonFlag, RunsOption, StationOption, print_json, print_table
from hil.cli.runs import fail
from hil.core import HilError, SpecError

WEEK_MIN = 7 * 24 * 60


def simulate(
    file: Annotated[Path, typer.Argument(help="Schedule (YAML).", show_default=False)],
    lasting: Annotated[
        str, typer.Argument(metavar="DURATION", help="How long, such as 12w.", show_default=False)
    ],
    station: StationOption = None,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Simulate weeks of a schedule at once on the embedded mock, with wear and changing rooms."""
    from hil.core import new_folder, read_source
    from hil.engine import ignore_from_now_on
    from hil.maintenance import bind, require_mock
    from hil.maintenance import simulate as live_through
    from hil.recording import name_for_path
    from hil.report import render_simulation
    from hil.spec import load_schedule_spec
    from hil.workflow import require_extras

    source, duration = read_source(file), _duration(lasting)
    spec = load_schedule_spec(source)
    bound = bind(spec, station, source)
    require_mock(bound)
    for experiment in bound.experiments:
        require_extras(experiment.spec)
    above = runs / datetime.now().astimezone().date().isoformat() / "simulations"
    folder = new_folder(above, f"simulation-{name_for_path(spec.name)}")
    told = live_through(spec, duration, folder, station=station, tell=_said)
    page = render_simulation(folder)
    ignore_from_now_on()
    failed = [each for each in told["occasions"] if each["event"] == "failed"]
    if json:
        print_json(told | {"folder": str(folder), "report": str(page)})
    else:
        weeks = duration >= timedelta(weeks=1)
        columns = ("week" if weeks else "after", "room [°C]", "champion", "what came of it")
        print_table(columns, [_row(each, weeks=weeks) for each in told["occasions"]])
        typer.echo(f"report: {page}")
    if failed:
        told_why = f"{len(failed)} of {len(told['occasions'])} occasions failed: {failed[0]['why']}"
        fail(HilError(told_why, hint=f"see {folder}"), json)


def _duration(text: str) -> timedelta:
    from hil.core import duration_of

    try:
        return duration_of(text)
    except ValueError as error:
        raise SpecError(f"DURATION {error}", hint="such as 12w or 30min") from None


def _said(line: Mapping[str, Any]) -> None:
    if line["event"] in ("done", "failed", "missed", "deferred"):
        text = line.get("why") or line["result"]["text"]
        typer.echo(f"{line['at'][:16]} {line['occasion']}: {text}", err=True)


def _row(each: Mapping[str, Any], *, weeks: bool) -> tuple[str, ...]:
    result = each["result"] or {}
    text = str(result.get("text") or f"{each['event']}: {each['why']}")
    at = f"{each['week']:g}" if weeks else f"{each['week'] * WEEK_MIN:.0f} min"
    return at, f"{each['room_c']:g}", str(result.get("champion") or ""), text
