"""What people are told of a residual network: its protocol, and what it is worth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hil.data.dataset import Dataset
from hil.data.filters import AT_REST, FilterSettings, sample_rate
from hil.data.parts import BY_SAMPLE
from hil.evaluate.persistence import persistence_rmse
from hil.identify.base import HONEST
from hil.identify.residual.fit import Learnt
from hil.identify.residual.judged import Judged
from hil.identify.residual.out_of_fold import NO_FOLD, Physics
from hil.identify.residual.settings import ResidualSettings

CUTOFF_HZ = 50.0
"""Of inputs and of what is learned, as in the PINN paper: reversals are quick."""

MOST_OF_NYQUIST = 0.4


def filters_for(dataset: Dataset) -> FilterSettings:
    """50 Hz over everything, less where samples are few."""
    rates = [
        sample_rate(dataset["t"][rows])
        for condition, rows in dataset.slices()
        if condition.kind not in AT_REST and rows.stop - rows.start > 1
    ]
    cutoff = round(min(CUTOFF_HZ, 0.5 * MOST_OF_NYQUIST * min(rates)), 2)
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
        *judged.selection.notes(data.joint_names, data.effort_unit),
        *_seen(physics),
        *_trivial(data, learnt, judged, network),
    )


def _seen(physics: Physics) -> Iterator[str]:
    if np.all(physics.fold == NO_FOLD):
        yield (
            f"{physics.model.estimator} may have learned from the trajectories by which its "
            "residual network was selected: bands are narrower than they should be"
        )


def _trivial(
    data: Dataset, learnt: Learnt, judged: Judged, network: ResidualSettings
) -> Iterator[str]:
    """How good torque of a moment ago is by itself, wherever a network hears torque."""
    if network.inputs == "motion":
        return
    age = network.latency_s if network.inputs == "history" else 1e-3
    column = "effort" if network.inputs == "history" else "effort_f"
    trivial = persistence_rmse(data, age, column, learnt.judged)
    ours = np.where(judged.selection.kept, judged.selection.corrected, judged.selection.without)
    yield (
        f"holding the torque measured {1e3 * age:g} ms before has an error of "
        f"{float(np.mean(trivial)):.3g} {data.effort_unit} on left-out trajectories (mean over "
        f"joints), this model {float(np.mean(ours)):.3g}"
    )
