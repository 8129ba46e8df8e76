"""Model of a schedule YAML file: times of probes and campaigns of a robot."""

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
"""Period in which the next due time of a cron expression is searched.

The search period contains a 29 February. A date that does not occur within the search period, such
as 31 February, never occurs.
"""
_CLOCK = re.compile(r"([01]\d|2[0-3]):[0-5]\d|24:00")


def _known_zone(name: str) -> str:
    try:
        ZoneInfo(name)
    except (ValueError, OSError, KeyError):
        raise mistake(f"unknown time zone {name!r}; for example: Europe/Berlin") from None
    return name


def _cron(text: str) -> str:
    from apscheduler.triggers.cron import CronTrigger

    fields = text.split()
    if len(fields) != 5:
        raise mistake(f"must have five fields, minute hour day month weekday, not {len(fields)}")
    if re.search(r"\d", fields[4].split("/")[0]):
        # Weekday 0 is Sunday in cron, but Monday elsewhere: the robot might move on a wrong day.
        raise mistake("the weekday must be given by name, such as sat or mon-fri")
    try:
        trigger = CronTrigger.from_crontab(text, timezone="UTC")
    except ValueError as error:
        raise mistake(f"is not a valid cron expression: {error}") from None
    now = datetime.now(UTC)
    due = trigger.get_next_fire_time(None, now)
    if due is None or due > now + _FORESEEN:
        raise mistake("is not due within the next eight years: there is no such date")
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
    """Time at which a job is due: after an interval, or by the calendar."""

    every: Duration | None = Field(
        None, description="Interval, such as `7d`, counted from `start` of the schedule."
    )
    cron: Annotated[str, AfterValidator(_cron)] | None = Field(
        None,
        description='Minute, hour, day, month and weekday in cron syntax, such as `"0 3 * * '
        'sat"`; weekdays by name.',
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
        """Whether the job is due at intervals or at calendar times."""
        return self.every is not None or self.cron is not None


class ProbeJob(Trigger):
    """Short program that is always the same and is compared with the champion."""

    spec: str = Field(
        description="Experiment (YAML); a relative path starts at the folder of the schedule."
    )

    @model_validator(mode="after")
    def _is_due_some_time(self) -> ProbeJob:
        if not self.by_time:
            raise mistake("give every or cron: a probe is never due otherwise")
        return self


class CampaignJob(Trigger):
    """Full program, whose model becomes the challenger of the champion."""

    spec: str = Field(
        description="Experiment (YAML); a relative path starts at the folder of the schedule."
    )
    on_drift: bool = Field(
        True, description="Whether a probe that shows a change starts the campaign."
    )
    estimator: str = Field(
        "",
        description="Estimator of `fit` in the spec whose model becomes the challenger; by "
        "default the first.",
    )


class Blackout(Strict):
    """Time in which no job may begin or be running."""

    days: tuple[Day, ...] = Field((), description="Weekdays; by default all.")
    begin: Annotated[str, AfterValidator(_clock)] = Field(
        "00:00", description='Time of day at which the blackout begins, such as `"08:00"`.'
    )
    end: Annotated[str, AfterValidator(_clock)] = Field(
        "24:00",
        description="Time of day at which the blackout ends; a time before `begin` is on the "
        "next day.",
    )
    first: date | None = Field(
        None, description="First day, such as 2026-12-23; by default any day."
    )
    last: date | None = Field(None, description="Last day, inclusive; by default any day.")
    why: str = Field(
        "", description="Reason, shown when the blackout delays or prevents an occasion."
    )

    @model_validator(mode="after")
    def _is_a_part_of_time(self) -> Blackout:
        if self.begin == self.end:
            raise mistake("must differ from begin", "end")
        if self.first and self.last and self.first > self.last:
            raise mistake("must not be before first", "last")
        always = (self.begin, self.end) == ("00:00", "24:00") and not self.days
        if always and not (self.first and self.last):
            raise mistake("leaves no time for any job: give days, begin and end, or first and last")
        return self


class Wear(Strict):
    """Friction of a mock after a given time."""

    after: Duration = Field(description="Time since the beginning of the simulation.")
    factors: tuple[Positive, ...] = Field(
        description="Factor on the friction of each joint; 1 for a new joint."
    )


class Simulated(Strict):
    """Simulated changes of a mock during `hil schedule simulate`."""

    room_c: tuple[Finite, Finite] = Field(
        (18.0, 26.0),
        description="Range of the room temperature, which is drawn anew for every occasion.",
    )
    seed: Seed = Field(1, description="Seed for the room temperatures and the noise.")
    wear: tuple[Wear, ...] = Field(
        (),
        description="Wear of the mock over time; the latest entry whose time has passed applies.",
    )


class ScheduleSpec(Strict):
    """Schedule of one robot, which is probed, and identified again after a change."""

    hil_schedule: FormatVersion = Field(description="Version of the schedule format.")
    name: Name = Field(description="Name of the schedule's folder; letters, digits, `_.-`.")
    description: str = Field("", description="Purpose of the schedule; shown in the report.")
    model: Name | None = Field(
        None,
        description="Name of the model in the registry; by default the name of the campaign's "
        "robot.",
    )
    station: str | None = Field(
        None,
        description="Station of probe and campaign; by default the station that `hil run` would "
        "choose.",
    )
    robots: RobotAddresses = Field({})
    timezone: Annotated[str, AfterValidator(_known_zone)] = Field(
        "UTC", description="Time zone of all times of day in this file, such as `Europe/Berlin`."
    )
    start: Annotated[datetime, BeforeValidator(_moment)] | None = Field(
        None,
        description="Time from which intervals are counted; by default the first start of the "
        "schedule.",
    )
    probe: ProbeJob | None = Field(
        None, description="Program that is compared with the champion, and its times."
    )
    campaign: CampaignJob = Field(
        description="Program to which the next model is fitted, and its times."
    )
    blackout: tuple[Blackout, ...] = Field(
        (), description="Times in which no job may begin or run."
    )
    missed: Literal["run", "skip"] = Field(
        "run",
        description="Handling of an occasion that cannot be executed when it is due, because of "
        "a blackout, a robot in use or a computer that is off: `run` executes it once, as soon "
        "as possible; `skip` omits it.",
    )
    missed_within: Duration = Field(
        "24h",
        validate_default=True,
        description="Maximum delay of a missed occasion; an occasion that was due earlier is "
        "omitted.",
    )
    wait_for_robot: Duration = Field(
        "10min", validate_default=True, description="Maximum time to wait for a robot in use."
    )
    false_alarm: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        0.01,
        description="Maximum probability that a probe reports a change of an unchanged robot.",
    )
    notify: tuple[str, ...] = Field(
        (),
        description="Command and its arguments, executed after every occasion without a shell; "
        "its standard input is JSON.",
    )
    simulate: Simulated = Field(
        Simulated(), description="Changes of a mock during `hil schedule simulate`."
    )

    @model_validator(mode="after")
    def _something_is_due_some_time(self) -> ScheduleSpec:
        if self.probe is None and not self.campaign.by_time:
            raise mistake("no job is ever due: give every or cron, or a probe", "campaign")
        return self


def is_schedule(file: str | FilePath | Source) -> bool:
    """Return whether a file, or its source, is a schedule; False if it is unreadable."""
    return is_kind(file, KEY)


def load_schedule_spec(file: str | FilePath | Source) -> ScheduleSpec:
    """Read a schedule and check that the files it names are experiments and a station.

    Args:
        file: YAML file of the schedule, or the source read from the file.

    Returns:
        Validated schedule, in which all paths are absolute.

    Raises:
        SpecError: The file has problems; the message has one line `file:line:column: path: message`
            per problem.
    """
    source = file if isinstance(file, Source) else read_source(file)
    folder = FilePath(source.name).parent
    refuse_other_kind(source, KEY)
    for place in (("station",), ("probe", "spec"), ("campaign", "spec")):
        make_absolute(source, place, folder)
    return validated(source, ScheduleSpec)
