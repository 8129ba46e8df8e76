"""Methods 1 to 3 of the PINN paper's Table I, and what else there is, under both protocols.

Everything is computed twice from one run of Fourier trajectories: with samples drawn at random from
within the trajectories, as the paper does, and with whole trajectories held out
(docs/explanation/dynamic-identification.md).
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
    """Torque errors of identified models on Fourier trajectories, as printed and honestly."""

    study: ClassVar[str] = "dynamic-identification"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",),)

    protocols: list[str] = parameter(
        tuple(PROTOCOLS), subset, tuple(PROTOCOLS), doc="`paper`, `honest` or both."
    )
    methods: list[str] = parameter(
        METHOD_KEYS, subset, METHOD_KEYS, doc="Keys of `hil.studies.dynamic_methods.METHODS`."
    )
    splits: int = parameter(3, whole, at_least=1, doc="How often each protocol's split is drawn.")
    cutoff_hz: float = parameter(
        50.0, number, above=0.0, doc="Of the zero-phase Butterworth filter of order 5."
    )
    rate_hz: float = parameter(
        125.0, number, above=0.0, doc="Samples a fit keeps per second after filtering."
    )
    sign_width: float = parameter(
        0.01, number, at_least=0.0,
        doc="Of the smooth sign [rad/s], the same for every memoryless method.",
    )  # fmt: skip
    figures: bool = parameter(True, flag, doc="Whether to draw any.")
    seed: int = parameter(0, whole, at_least=0, doc="Of the first split; the others follow.")
    jobs: int | None = parameter(
        None, whole, at_least=1, optional=True,
        doc="Processes; None: as many as there are cores. The result does not depend on it.",
    )  # fmt: skip

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what it cannot do without: three trajectories, and drive gains."""
        return NEEDS

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Tables, figures and words of both protocols.

        Raises:
            FitError: There are too few trajectories, or no method can be fitted.
            DataError: The data cannot be filtered as asked.
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
            "Dynamic identification, as printed and honestly",
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
                "The last row is the noise and whatever else lies above the filter's cut-off.",
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
    """Notes about methods that failed.

    Raises:
        FitError: None is left.
    """
    notes = dict.fromkeys(
        f"{METHODS[key].words} ({METHODS[key].estimator}), {one.protocol}: left out, {reason}"
        for one in found
        for key, reason in one.failed.items()
    )
    if not any(one.scores for one in found):
        raise FitError(
            f"no method could be fitted: {next(iter(notes), 'none is installed')}",
            hint="see the reasons of the others on the page; hil doctor tells what is missing",
        )
    return list(notes)
