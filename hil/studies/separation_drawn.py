"""Which figures a separation study shows: those of the paper, and the same under both protocols."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray, HilError
from hil.estimators import StaticLinear, Weights
from hil.studies.figure import Figure
from hil.studies.separation_data import Recording
from hil.studies.separation_figures import ROW, clouds, parameters, regression, series
from hil.studies.separation_honest import SHORT, Bands, HonestRun, friction_of
from hil.studies.separation_paper import METHODS, PaperRun
from hil.studies.separation_tables import WORDS

OURS = ("hysteresis", "network-approach", "coulomb", "network", "gravity", "wls")
"""What is shown as the model in the honest figures: the first of them that was fitted."""


def paper_figures(run: PaperRun, joint: int) -> tuple[Figure, ...]:
    """Figures 4, 5, 7 and 8; `joint` from 0 beside joint 1 in Fig. 5, and in Fig. 7."""
    current, test, train = run.data["effort"], run.partition.test, run.partition.train
    whole = run.wls.estimate + run.separated().friction
    axes = ("test sample, in order of time", "current [A]")
    linear = {WORDS[method]: run.linear[method].estimate[test] for method in METHODS}
    fitted = {
        "a) training samples": (current[train, joint], whole[train, joint]),
        "b) test samples": (current[test, joint], whole[test, joint]),
    }
    modelled = {"measured": current[test], "WLS and networks": whole[test]}
    return (
        parameters("fig-4", run.wls.model, "Of eq. 20: gravity over K₁, in amperes. The six "
                   "columns of φ₂ repeat each other, so single parameters are uncertain where "
                   "their sum is not."),
        series("fig-5", "Measured and estimated currents", "Five methods on eq. 20, the measured "
               "current among their inputs.", {"measured": current[test], **linear},
               sorted({0, joint}), axes),
        regression("fig-7", f"Regression plots of J{joint + 1}", "Gravity and friction together; "
                   "each point is a sample, and each pose is in both panels.", fitted,
                   ("measured [A]", "estimated [A]")),
        series("fig-8", "Performance of the static model", "Measured and modelled currents of "
               "test samples, whose poses were trained on.", modelled,
               range(run.data.n_joints), axes),
    )  # fmt: skip


def honest_figures(
    recording: Recording, run: HonestRun, both: Bands | None, joint: int, weights: Weights
) -> tuple[Figure, ...]:
    """The same with whole poses held out, and what the approach leaves in the current."""
    unit = run.dwells.effort_unit
    effort, axes = f"effort [{unit}]", "dwell held out, in order of time"
    found = _parameters(recording, weights)
    linear = {
        WORDS[method]: run.methods[method].effort for method in METHODS if method in run.methods
    }
    if linear:
        found.append(
            series("fig-5h", "Measured and estimated efforts", "The five methods without the "
                   "measured current, at poses they have not seen. Their lines lie on each "
                   f"other. {ROW}",
                   {"measured": run.measured, **linear}, sorted({0, joint}), (axes, effort))
        )  # fmt: skip
    best = next((key for key in OURS if key in run.methods), next(iter(run.methods)))
    chosen = [run.methods[key] for key in dict.fromkeys(("network", best)) if key in run.methods]
    sets = {one.method.words: (run.measured[:, joint], one.effort[:, joint]) for one in chosen}
    modelled = {"measured": run.measured, "modelled": run.methods[best].effort}
    found += [
        regression("fig-7h", f"Regression plots of J{joint + 1}", "Poses not seen; each point "
                   "is the mean of a dwell.", sets,
                   (f"measured [{unit}]", f"estimated [{unit}]")),
        series("fig-8h", "Performance of the static model", "Measured and modelled means of "
               f"dwells at poses not seen; the model: {run.methods[best].method.words}. {ROW}",
               modelled, range(run.dwells.n_joints), (axes, effort)),
    ]  # fmt: skip
    if both is not None:
        found.append(_band(both))
    return tuple(found)


def _parameters(recording: Recording, weights: Weights) -> list[Figure]:
    """Fig. 4 without the current among the regressors; nothing for arms eq. 15 is not for."""
    model = StaticLinear(method="wls", form="paper", weights=weights)
    try:
        model.fit(recording.dwells, recording.robot)
    except HilError:
        return []
    caption = "From the mean of every dwell, both approaches, nothing measured among the inputs."
    return [parameters("fig-4h", model, caption)]


def _band(both: Bands) -> Figure:
    curves: dict[str, FloatArray] = {"measured": both.measured.half}
    curves |= {SHORT[key]: both.predicted[key].half for key in reversed(friction_of(both))}
    known = both.common
    shown = {name: np.where(known, half, np.nan) for name, half in curves.items()}
    return clouds(
        "fig-band",
        "Half the difference of both approaches over the load",
        "Stick friction of a pose, measured and as predicted for poses not seen.",
        both.load,
        shown,
        (f"load [{both.unit}]", f"half difference [{both.unit}]"),
    )
