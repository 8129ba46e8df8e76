"""How long the occasions of a schedule move the robot, from the plans of what it names."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

from hil.core import SpecError, duration_text
from hil.maintenance.schedule.occasion import Job
from hil.maintenance.schedule.times import next_free
from hil.planning import Experiment
from hil.spec import ScheduleSpec
from hil.workflow import preview_experiment

ALLOWANCE = 1.1
"""Share of a plan's time that settling and pauses of the controller may add to it."""

AROUND = timedelta(seconds=60)
"""For connecting, preflight and the recording's end, a run."""


@dataclass(frozen=True, slots=True)
class Motions:
    """Motion of the programs of a schedule.

    Attributes:
        probe: Of the short program; zero without one.
        campaign: Of the full program.
        on_drift: Whether a probe may lead to a campaign.
    """

    probe: timedelta = timedelta()
    campaign: timedelta = timedelta()
    on_drift: bool = True

    def expected(self, job: Job) -> timedelta:
        """With nothing found: the probe; or campaign and the probe after it."""
        return self.probe if job == "probe" else self.campaign + 2 * self.probe

    def longest(self, job: Job) -> timedelta:
        """With all that may come of it, and what runs take beside motion."""
        runs = [self.probe]
        if job == "campaign" or self.on_drift:
            runs += [self.campaign, self.probe]
        return sum((ALLOWANCE * each + AROUND for each in runs if each), timedelta())


def motions(spec: ScheduleSpec, probe: Experiment | None, campaign: Experiment) -> Motions:
    """Plan both programs, without connecting to anything.

    Raises:
        PlanError: No safe plan follows from one of them.
    """
    short, full = (
        timedelta(seconds=round(preview_experiment(each)[1].duration_s)) if each else timedelta()
        for each in (probe, campaign)
    )
    return Motions(short, full, spec.campaign.on_drift)


def require_room(spec: ScheduleSpec, motions: Motions, now: datetime) -> None:
    """Refuse a schedule whose blackouts leave no room for what it does.

    Raises:
        SpecError: They do not.
    """
    jobs: tuple[Job, ...] = ("campaign",) if spec.probe is None else ("probe", "campaign")
    for job in jobs:
        longest = motions.longest(job)
        if next_free(spec, now, longest)[0] is None:
            raise SpecError(
                f"blackout: a {job}, with all that may come of it, takes up to "
                f"{duration_text(longest)}, and there is never so much time between blackouts",
                hint="make the programs shorter, or the blackouts",
            )
