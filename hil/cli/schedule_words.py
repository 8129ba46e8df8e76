"""How `hil schedule` words what is in a ledger and what is expected."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.cli.output import duration, print_table, say

if TYPE_CHECKING:
    from zoneinfo import ZoneInfo

    from hil.maintenance import Expected, Line
    from hil.spec import ScheduleSpec


SHOWN = 40
"""Rows of a plan that are alike: a probe every minute is none to be read to its end."""


def print_plan(spec: ScheduleSpec, expected: list[Expected], zone: ZoneInfo) -> None:
    """What would happen when, as a table; of each kind the first ones, and how many more."""
    if not expected:
        say("nothing is due until then")
        return
    rows = []
    alike: dict[tuple[str, str], list[Expected]] = {}
    for one in expected:
        kind = alike.setdefault((one.job, one.what), [])
        kind.append(one)
        if len(kind) > SHOWN:
            continue
        times = f" ({one.count} times)" if one.count > 1 else ""
        begins = "not done" if one.begins is None else f"{one.begins.astimezone(zone):%a %H:%M:%S}"
        motion = duration(one.motion.total_seconds()) if one.motion else ""
        why = "gone on with" + (f", {one.why}" if one.why else "") if one.again else one.why
        rows.append((f"{one.due.astimezone(zone):%a %Y-%m-%d %H:%M}", one.job + times, begins,
                     motion, why))  # fmt: skip
    print_table((f"due ({spec.timezone})", "what", "begins", "motion", "why not then"), rows)
    for (job, what), kind in alike.items():
        if rest := kind[SHOWN:]:
            count = f"{sum(one.count for one in rest)} more: {job}"
            left = ", not done" if what == "missed" else ""
            until = f"{rest[-1].due.astimezone(zone):%a %Y-%m-%d %H:%M}"
            say(f"… and {count}{left}, until {until}")


def print_ledger(lines: list[Line], zone: ZoneInfo) -> None:
    """Every line, as a table."""
    print_table(
        (f"when ({zone})", "event", "occasion", "what"), [_cells(line, zone) for line in lines]
    )


def words(line: Line, zone: ZoneInfo) -> str:
    """A line of the ledger, for people."""
    return "  ".join(cell for cell in _cells(line, zone) if cell)


def next_words(moment: datetime | None, zone: ZoneInfo) -> str:
    """When something is due next."""
    return (
        f"next: {moment.astimezone(zone):%a %Y-%m-%d %H:%M} ({zone})"
        if moment
        else "nothing is due again"
    )


def held_words(line: Line, file: Path, zone: ZoneInfo) -> str:
    """That nothing happens any more, why, and how to change that."""
    return (
        f"held since {_at(line, zone)} ({zone}): {line['why']}\n"
        f"  → when somebody has looked: hil schedule release {file} --reason TEXT"
    )


def _cells(line: Line, zone: ZoneInfo) -> tuple[str, str, str, str]:
    return _at(line, zone), str(line["event"]), _occasion(line), _told(line)


def _at(line: Line, zone: ZoneInfo) -> str:
    return f"{datetime.fromisoformat(line['at']).astimezone(zone):%Y-%m-%d %H:%M:%S}"


def _occasion(line: Line) -> str:
    count = int(line.get("count", 1))
    more = f" and {count - 1} before it" if count > 1 else ""
    return str(line.get("occasion", "")) + more


def _told(line: Line) -> str:
    result: dict[str, Any] = line.get("result") or {}
    if result:
        return f"{result.get('outcome', '')}: {result.get('text', '')}"
    told = str(line.get("why", "")) or ("again" if line.get("again") else "")
    return f"{line['by']}: {told}" if "by" in line else told
