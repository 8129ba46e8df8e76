"""What a model is held to in a trial, and whether it meets that."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hil.control.trial import laws, leading
from hil.control.trial.settings import HALF
from hil.core import FloatArray
from hil.studies import listed, mean_of

if TYPE_CHECKING:
    from hil.control.trial.result import Trial

ENDED, RESTED, TRACKED, HELPED = "ended", "at rest", "tracking", "hand"


@dataclass(frozen=True, slots=True)
class Criterion:
    """One of them.

    Attributes:
        name: Short and stable.
        asked: What is asked for.
        met: Whether it is so.
        found: What was found instead, in words.
        mend: What to do when it is not met.
    """

    name: str
    asked: str
    met: bool
    found: str
    mend: str


def judged(trial: Trial) -> tuple[Criterion, ...]:
    """All of them. Runs without the model are what it is compared with, and not judged."""
    return (*_runs(trial), _tracking(trial), _hand(trial))


def unaided(trial: Trial) -> str:
    """The law that tracks best of those that need no identification; empty when all were braked."""
    known = {run.law: mean_of(run.rms) for run in trial.tracked if run.law in laws.UNIDENTIFIED}
    known = {law: rms for law, rms in known.items() if np.isfinite(rms)}
    return min(known, key=lambda law: known[law], default="")


def improvement(trial: Trial) -> float:
    """Mean RMS error with the best law that needs no identification over that with the model."""
    by_law = {run.law: mean_of(run.rms) for run in trial.tracked}
    return by_law.get(unaided(trial), np.nan) / by_law[laws.MODEL]


def relief(trial: Trial, of: str, over: str) -> FloatArray:
    """(n,) RMS effort of the hand with one help over that with another; NaN without a run."""
    by_way = {run.way: run.rms for run in trial.led}
    if of not in by_way or over not in by_way:
        return np.full(len(trial.joint_names), np.nan)
    return by_way[of] / by_way[over]


def most_help(trial: Trial) -> str:
    """The most that the model helps a hand with."""
    return [run.way for run in trial.led if run.way in leading.OF_THE_MODEL][-1]


def halves(share: FloatArray) -> str:
    """Which joints of (n,) are at most half, and the mean, in words."""
    half = [f"J{j + 1}" for j in np.flatnonzero(share <= HALF)]
    which = "every joint" if len(half) == len(share) else listed(half) or "no joint"
    each = " ".join(f"{100 * value:.0f}" for value in share)
    return f"{each} % (mean {100 * np.mean(share):.0f} %): at most half in {which}"


def _runs(trial: Trial) -> Iterator[Criterion]:
    ways = [run for run in trial.led if run.way in leading.OF_THE_MODEL]
    braked = [f"{run.law}: {run.stopped}" for run in trial.tracked
              if run.stopped and run.law not in laws.UNIDENTIFIED]  # fmt: skip
    braked += [f"{run.way}: {run.stopped}" for run in ways if run.stopped]
    yield Criterion(
        ENDED, "no run with the model has to be braked", not braked,
        f"BRAKED, {listed(braked)}" if braked else "none was",
        "try a model that was fitted on this very arm, or --friction-share 0",
    )  # fmt: skip
    restless = [run.way for run in ways if not np.isfinite(run.rest_s)]
    last = max((run.rest_s for run in ways), default=np.nan)
    yield Criterion(
        RESTED, "let go, the arm comes to rest", not restless,
        f"NOT AT REST with {listed(restless)}" if restless else f"within {last:.1f} s every time",
        "take less of the friction (--friction-share), or a model that knows gravity better",
    )  # fmt: skip


def _tracking(trial: Trial) -> Criterion:
    better = improvement(trial)
    best = unaided(trial)
    found = (
        f"an error {better:.1f} times smaller than with {best}"
        if np.isfinite(better)
        else "not known"
    )
    return Criterion(
        TRACKED, "the model tracks better than what needs no identification", bool(better > 1.0),
        found, "fit a model with inertia and friction, to trajectories of this very arm",
    )  # fmt: skip


def _hand(trial: Trial) -> Criterion:
    way = most_help(trial)
    share = relief(trial, way, leading.NOTHING)
    found = f"with {way} {halves(share)}" if np.isfinite(share).all() else "not known"
    return Criterion(
        HELPED, "effort of the hand at most half of that with the drives off, in every joint",
        bool(np.all(share <= HALF)), found,
        "take more of the friction (--friction-share, below 1), or a model that knows it better",
    )  # fmt: skip
