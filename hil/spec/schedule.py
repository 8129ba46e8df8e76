"""What a schedule YAML may say: when a robot is probed, and when it is identified again."""

from __future__ import annotations

import re
from datetime import UTC, date, datetime, timedelta
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from hil.core import Duration, Source, read_source
from hil.spec.field_types import (
    Finite,
    FormatVersion,
    Name,
    Positive,
    RobotAddresses,
    Seed,
    Strict,
    mistake,
)
from hil.spec.load import is_kind, make_absolute, refuse_other_kind, validated

KEY = "hil_schedule"

Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
_FORESEEN = timedelta(days=8 * 366)
"""29 February comes within that, 31 February never does."""
_CLOCK = re.compile(r"([01]\d|2[0-3]):[0-5]\d|24:00")


def _known_zone(name: str) -> str:
    try:
        ZoneInfo(name)
    except (ValueError, OSError, KeyError):
        raise mistake(f"there is no time zone {name!r}; for example: Europe/Berlin") from None
    return name


def _cron(text: str) -> str:
    from apscheduler.triggers.cron import CronTrigger

    fields = text.split()
    if len(fields) != 5:
        raise mistake(f"must have five fields, minute hour day month weekday, not {len(fields)}")
    if re.search(r"\d", fields[4].split("/")[0]):
        # To cron 0 is Sunday, to others Monday: a robot moves on the day that was meant.
        raise mistake("the weekday must be given by name, such as sat or mon-fri")
    try:
        trigger = CronTrigger.from_crontab(text, timezone="UTC")
    except ValueError as error:
        raise mistake(f"cannot be read: {error}") from None
    now = datetime.now(UTC)
    due = trigger.get_next_fire_time(None, now)
    if due is None or due > now + _FORESEEN:
        raise mistake("is never due in the next eight years: no such day comes")
    return text


def _clock(text: str) -> str:
    if not _CLOCK.fullmatch(text):
        raise mistake(f'must be a time of day such as "08:00", not {text!r}')
    return text


def _moment(value: Any) -> Any:
    if not isinstance(value, str):
        raise mistake("must be a date and time such as 2026-11-28T03:00")
    return value


class Trigger(Strict):
    """When something is due: after an interval, or by the calendar."""

    every: Duration | None = Field(
        None, description="Interval, such as `7d`; counted from the schedule's `start`."
    )
    cron: Annotated[str, AfterValidator(_cron)] | None = Field(
        None,
        description="Minute, hour, day, month and weekday as cron has them, such as "
        '`"0 3 * * sat"`; weekdays by name.',
    )

    @model_validator(mode="after")
    def _one_at_most(self) -> Trigger:
        if self.every is not None and self.cron is not None:
            raise mistake("give either every or cron", "cron")
        if self.every is not None and self.every.total_seconds() < 60:
            raise mistake("must be at least 1min", "every")
        return self

    @property
    def by_time(self) -> bool:
        """Whether time triggers it."""
        return self.every is not None or self.cron is not None


class ProbeJob(Trigger):
    """A short program, the same every time, that is compared with the champion."""

    spec: str = Field(description="The experiment (YAML); a path starts at the schedule's folder.")

    @model_validator(mode="after")
    def _is_due_some_time(self) -> ProbeJob:
        if not self.by_time:
            raise mistake("give every or cron: a probe is never due otherwise")
        return self


class CampaignJob(Trigger):
    """The full program, whose model challenges the champion."""

    spec: str = Field(description="The experiment (YAML); a path starts at the schedule's folder.")
    on_drift: bool = Field(True, description="Whether a probe that shows a change starts it.")
    estimator: str = Field(
        "", description="Which of the spec's `fit` challenges; by default the first."
    )


class Blackout(Strict):
    """When nothing may begin, and nothing may be under way."""

    days: tuple[Day, ...] = Field((), description="Weekdays; by default all of them.")
    begin: Annotated[str, AfterValidator(_clock)] = Field(
        "00:00", description='Time of day at which it begins, such as `"08:00"`.'
    )
    end: Annotated[str, AfterValidator(_clock)] = Field(
        "24:00", description="Time of day at which it ends; before `begin`: on the next day."
    )
    first: date | None = Field(None, description="First day, such as 2026-12-23; by default any.")
    last: date | None = Field(None, description="Last day, itself included.")
    why: str = Field("", description="Shown where it keeps something from being done.")

    @model_validator(mode="after")
    def _is_a_part_of_time(self) -> Blackout:
        if self.begin == self.end:
            raise mistake("must differ from begin", "end")
        if self.first and self.last and self.first > self.last:
            raise mistake("must not be before first", "last")
        always = (self.begin, self.end) == ("00:00", "24:00") and not self.days
        if always and not (self.first and self.last):
            raise mistake("nothing could ever be done: give days, begin and end, or first and last")
        return self


class Wear(Strict):
    """Friction of a mock from some time on."""

    after: Duration = Field(description="Since the simulation's begin.")
    factors: tuple[Positive, ...] = Field(
        description="Factor on the friction of each joint; 1 is as good as new."
    )


class Simulated(Strict):
    """What happens to a mock in the weeks of `hil schedule simulate`."""

    room_c: tuple[Finite, Finite] = Field(
        (18.0, 26.0), description="Every occasion finds the room between these."
    )
    seed: Seed = Field(1, description="Of the room's temperatures and of the noise.")
    wear: tuple[Wear, ...] = Field((), description="How it ages; the last one that has come holds.")


class ScheduleSpec(Strict):
    """One robot that is probed, and identified again when it has changed."""

    hil_schedule: FormatVersion = Field(description="Version of the schedule format.")
    name: Name = Field(description="Names its folder; letters, digits, `_.-`.")
    description: str = Field("", description="What this is for; shown in the report.")
    model: Name | None = Field(
        None, description="Name in the registry; by default that of the campaign's robot."
    )
    station: str | None = Field(
        None, description="The station of probe and campaign; by default as with `hil run`."
    )
    robots: RobotAddresses = Field({})
    timezone: Annotated[str, AfterValidator(_known_zone)] = Field(
        "UTC", description="Of all times of day here, such as `Europe/Berlin`."
    )
    start: Annotated[datetime, BeforeValidator(_moment)] | None = Field(
        None, description="From when intervals count; by default when it is first started."
    )
    probe: ProbeJob | None = Field(None, description="What is compared with the champion, when.")
    campaign: CampaignJob = Field(description="What the next model is fitted to, and when.")
    blackout: tuple[Blackout, ...] = Field((), description="When nothing may be done.")
    missed: Literal["run", "skip"] = Field(
        "run",
        description="What is due while nobody can do it, because of a blackout, a robot that is "
        "not free, or a computer that is off: done once as soon as it can be, or left out.",
    )
    missed_within: Duration = Field(
        "24h", validate_default=True, description="What was due longer ago is left out."
    )
    wait_for_robot: Duration = Field(
        "10min", validate_default=True, description="How long a robot in use is waited for."
    )
    false_alarm: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        0.01,
        description="Probability, at most, with which a probe calls an unchanged robot changed.",
    )
    notify: tuple[str, ...] = Field(
        (),
        description="A command and its arguments, run after every occasion with JSON on its "
        "standard input; no shell.",
    )
    simulate: Simulated = Field(
        Simulated(), description="What happens to a mock with `hil schedule simulate`."
    )

    @model_validator(mode="after")
    def _something_is_due_some_time(self) -> ScheduleSpec:
        if self.probe is None and not self.campaign.by_time:
            raise mistake("nothing is ever due: give every or cron, or a probe", "campaign")
        return self


def is_schedule(file: str | FilePath | Source) -> bool:
    """Return whether a file, or what was read from it, is a schedule; an unreadable one is none."""
    return is_kind(file, KEY)


def load_schedule_spec(file: str | FilePath | Source) -> ScheduleSpec:
    """Read a schedule; the files it names must be experiments and a station.

    Args:
        file: The YAML file, or what was read from it.

    Returns:
        The schedule; its paths are absolute.

    Raises:
        SpecError: With a line `file:line:column: path: message` for every problem.
    """
    source = file if isinstance(file, Source) else read_source(file)
    folder = FilePath(source.name).parent
    refuse_other_kind(source, KEY)
    for place in (("station",), ("probe", "spec"), ("campaign", "spec")):
        make_absolute(source, place, folder)
    return validated(source, ScheduleSpec)
