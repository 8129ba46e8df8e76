"""Study of dynamic identification: Methods 1 to 3 of Table I of the PINN paper, and further ones.

All results are computed under two protocols from one run of Fourier trajectories. The `paper`
protocol draws the test samples at random from within the trajectories. The `honest` protocol holds
out whole trajectories (docs/explanation/dynamic-identification.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from hil.core import FitError, cores
from hil.data import Dataset, SeriesKind
from hil.dynamics import RobotModel
from hil.estimators import Needs, flag, number, parameter, whole
from hil.studies import dynamic_tables as tables
from hil.studies.base import Progress, Study, silent, subset
from hil.studies.dynamic_figures import by_protocol, torques
from hil.studies.dynamic_methods import (
    METHOD_KEYS,
    METHODS,
    NEEDS,
    PROTOCOLS,
    Found,
    Protocol,
    missing,
    trajectories_of,
)
from hil.studies.dynamic_tables import LABELS, TEXTS, TITLES, summary
from hil.studies.figure import Figure
from hil.studies.result import Part, StudyResult
from hil.studies.tasks import run_tasks


class DynamicIdentification(Study):
    """Torque errors of identified models on Fourier trajectories, under two protocols."""

    study: ClassVar[str] = "dynamic-identification"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",),)

    protocols: list[str] = parameter(
        tuple(PROTOCOLS), subset, tuple(PROTOCOLS), doc="Protocols: `paper`, `honest` or both."
    )
    methods: list[str] = parameter(
        METHOD_KEYS,
        subset,
        METHOD_KEYS,
        doc="Compared methods: keys of `hil.studies.dynamic_methods.METHODS`.",
    )
    splits: int = parameter(
        3, whole, at_least=1, doc="Number of random splits of the data per protocol."
    )
    cutoff_hz: float = parameter(
        50.0, number, above=0.0,
        doc="Cut-off frequency [Hz] of the zero-phase Butterworth filter of order 5.",
    )  # fmt: skip
    rate_hz: float = parameter(
        125.0, number, above=0.0, doc="Sample rate [Hz] of the fits, after filtering."
    )
    sign_width: float = parameter(
        0.01, number, at_least=0.0,
        doc="Width of the smooth sign function [rad/s], the same for every memoryless method.",
    )  # fmt: skip
    figures: bool = parameter(True, flag, doc="Whether to draw figures.")
    seed: int = parameter(
        0, whole, at_least=0, doc="Random seed of the first split; each further split adds 1."
    )
    jobs: int | None = parameter(
        None, whole, at_least=1, optional=True,
        doc="Number of processes; None: number of cores. The result does not depend on it.",
    )  # fmt: skip

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the required data: at least three trajectories, and drive gains."""
        return NEEDS

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Return tables, figures and texts of the selected protocols.

        Raises:
            FitError: There are too few trajectories, or none of the methods can be fitted.
            DataError: The data cannot be filtered with the selected cut-off frequency.
        """
        trajectories = trajectories_of(dataset, robot, self.cutoff_hz, self.rate_hz)
        known = [METHODS[key] for key in self.methods]
        methods = [method for method in known if not missing(method)]
        notes = [*trajectories.notes, *(f"{m.words}: {m.estimator} is not installed"
                                        for m in known if missing(m))]  # fmt: skip
        seeds = range(self.seed, self.seed + self.splits)
        followed = [
            Protocol(name, trajectories, robot, methods, seeds, self.sign_width)
            for name in self.protocols
        ]
        tasks = [task for protocol in followed for task in protocol.tasks()]
        results = iter(run_tasks(tasks, self.jobs or cores(), "fits", progress))
        found = [protocol.gather(results) for protocol in followed]
        notes += _failures(found)
        return StudyResult(
            self.study,
            "Dynamic identification, paper protocol and honest protocol",
            tuple(summary(found)),
            self._parts(found),
            self.get_params(),
            warnings=tuple(notes),
        )

    def _parts(self, found: Sequence[Found]) -> tuple[Part, ...]:
        compared = (Part("Side by side", "", (), (tables.both(found),),
                         (by_protocol(found),) if self.figures else ()),)  # fmt: skip
        return (*(self._part(one) for one in found), *(compared if len(found) > 1 else ()))

    def _part(self, found: Found) -> Part:
        name, honest = found.protocol, found.protocol == "honest"
        shown = [
            tables.errors(found, f"table-{name}", TITLES[name].lower()),
            tables.measured(
                found, f"table-{name}-raw", "raw", "Against the measured effort [N·m]",
                "The last row contains the noise and all other signals above the cut-off frequency "
                "of the filter.",
            ),
        ]  # fmt: skip
        drawn: tuple[Figure, ...] = ()
        if honest:
            shown += [
                tables.measured(
                    found, "table-moving", "moving", "In motion: |qd| > 0.05 rad/s [N·m]", ""
                ),
                tables.measured(
                    found, "table-reversal", "reversal", "Within 50 ms of a reversal [N·m]", ""
                ),
                tables.fits(found, "table-fits"),
            ]
            drawn = (torques(found, "fig-torques"),) if self.figures else ()
        return Part(TITLES[name], LABELS[name], TEXTS[name], tuple(shown), drawn)


def _failures(found: Sequence[Found]) -> list[str]:
    """Return notes about the methods that failed.

    Raises:
        FitError: All methods of the study failed.
    """
    notes = dict.fromkeys(
        f"{METHODS[key].words} ({METHODS[key].estimator}), {one.protocol}: omitted, {reason}"
        for one in found
        for key, reason in one.failed.items()
    )
    if not any(one.scores for one in found):
        raise FitError(
            f"no method could be fitted: {next(iter(notes), 'none is installed')}",
            hint="the page lists the other reasons; hil doctor lists missing packages",
        )
    return list(notes)
