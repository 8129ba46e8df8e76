"""What people are told of a residual network: its protocol, and what it is worth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hil.data import (
    BY_SAMPLE,
    Dataset,
    FilterSettings,
    motion_rates,
    persistence,
    rmse,
    told_by_sample,
)
from hil.estimators import HONEST
from hil.networks.residual.fit import Learnt
from hil.networks.residual.judged import Judged
from hil.networks.residual.out_of_fold import NO_FOLD, Physics
from hil.networks.residual.settings import ResidualSettings

CUTOFF_HZ = 50.0
"""Of inputs and of what is learned, as in the PINN paper: reversals are quick."""

MOST_OF_NYQUIST = 0.4


def filters_for(dataset: Dataset) -> FilterSettings:
    """50 Hz over everything, less where samples are few."""
    slowest = min(rate for rate, _ in motion_rates(dataset))
    highest = min(CUTOFF_HZ, 0.5 * MOST_OF_NYQUIST * slowest)
    cutoff = round(highest, 2) or highest
    return FilterSettings(unit="hz", velocity=cutoff, acceleration=cutoff, effort=cutoff)


def protocol_of(base: str, network: ResidualSettings, *, by_sample: bool) -> str:
    """The least honest of what the network hears, the physics, and the rows."""
    if network.inputs == "measured":
        return network.protocol
    if base != HONEST:
        return base
    return BY_SAMPLE if by_sample else network.protocol


def words(
    data: Dataset, physics: Physics, learnt: Learnt, judged: Judged, network: ResidualSettings
) -> tuple[str, ...]:
    """Notes for the model: of the physics, the selection, and the trivial observer."""
    return (
        *physics.model.notes_,
        *judged.selection.notes(data.joint_names, data.effort_unit, _left_out(data)),
        *_seen(physics),
        *_torn(data),
        *_trivial(data, physics, learnt, judged, network),
    )


def _seen(physics: Physics) -> Iterator[str]:
    if np.all(physics.fold == NO_FOLD):
        yield (
            f"{physics.model.estimator} may have learned from the trajectories by which its "
            "residual network was selected: bands are narrower than they should be"
        )


def _left_out(data: Dataset) -> str:
    return "left-out samples" if told_by_sample(data) else "left-out trajectories"


def _torn(data: Dataset) -> Iterator[str]:
    """What smoothing does where rows to learn from and to judge alternate; no split mends it."""
    if told_by_sample(data):
        yield (
            "rows that are judged lie between rows learned from, and the filter without phase "
            "shift brought their torque into these: errors tell how gaps in known motions are "
            "filled, nothing of new ones"
        )


def _trivial(
    data: Dataset, physics: Physics, learnt: Learnt, judged: Judged, network: ResidualSettings
) -> Iterator[str]:
    """How good torque of a moment ago is by itself, wherever a network hears torque.

    Both errors are of the same rows, and on the torque that is heard: as recorded, or filtered.
    """
    if network.inputs == "motion":
        return
    rate = learnt.networks[0].rate_hz
    lag = max(1, network.lag(rate))
    column = "effort" if network.inputs == "history" else "effort_f"
    # Half a sample less: stamps that jitter must not make it hold an older one.
    held = persistence(data, (lag - 0.5) / rate, column)
    rows = learnt.judged & np.all(np.isfinite(held), axis=1)
    ours = physics.predicted + judged.correction.bounded(learnt.correction)
    trivial, model = (float(np.mean(rmse(data[column][rows], of[rows]))) for of in (held, ours))
    target = "as recorded" if network.inputs == "history" else "filtered"
    yield (
        f"holding the torque measured {1e3 * lag / rate:.4g} ms before has an error of "
        f"{trivial:.3g} {data.effort_unit} on {_left_out(data)} (mean over joints, torque "
        f"{target}), this model {model:.3g}"
    )
