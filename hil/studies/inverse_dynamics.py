"""Study of inverse dynamics: Table II of the PINN paper, and further methods, from one run.

The table contains Methods 1 to 6 of the PINN paper, the method called Proposed, corrections of this
method, and the methods of this project. All results are computed under two protocols, `paper` and
`honest`. The `paper` protocol draws the test samples at random from within the trajectories; the
`honest` protocol holds out whole trajectories (docs/explanation/inverse-dynamics.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

from hil.core import FitError, checked_address, cluster, cores
from hil.data import Dataset, SeriesKind
from hil.dynamics import RobotModel
from hil.estimators import MOST_SEED, Needs, flag, number, parameter, whole
from hil.studies import inverse_figures as drawn
from hil.studies import inverse_tables as tables
from hil.studies.base import Progress, Study, silent, subset
from hil.studies.dynamic_methods import NEEDS
from hil.studies.figure import Figure
from hil.studies.inverse_cases import CASES, load_names, recorded
from hil.studies.inverse_fits import Found, Seen, family_task, gathered
from hil.studies.inverse_methods import DEFAULT_KEYS, ROW_KEYS, ROWS, extras_of, families, missing
from hil.studies.inverse_tables import LABELS, LEFT_OUT, TEXTS, TITLES, summary
from hil.studies.result import Part, StudyResult, Table
from hil.studies.tasks import run_tasks


class InverseDynamics(Study):
    """Torque errors of identified and learned models on Fourier trajectories."""

    study: ClassVar[str] = "inverse-dynamics"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",),)

    protocols: list[str] = parameter(
        tuple(CASES), subset, tuple(CASES), doc="Protocols: `paper`, `honest` or both."
    )
    methods: list[str] = parameter(
        DEFAULT_KEYS,
        subset,
        ROW_KEYS,
        doc="Compared methods: keys of `hil.studies.inverse_methods.ROWS`.",
    )
    seeds: int = parameter(
        3, whole, at_least=1, at_most=1000,
        doc="Number of random splits per protocol, and of trainings of each network.",
    )  # fmt: skip
    seed: int = parameter(
        0, whole, at_least=0, at_most=MOST_SEED - 1000,
        doc="First random seed; the next splits and trainings use the next seeds.",
    )  # fmt: skip
    effort: float = parameter(
        1.0, number, above=0.0, at_most=1000.0,
        doc="Number of epochs of the networks relative to the default; below 1 for quick trials.",
    )  # fmt: skip
    cutoff_hz: float = parameter(
        50.0, number, above=0.0,
        doc="Cut-off frequency [Hz] of the zero-phase Butterworth filter of order 5.",
    )  # fmt: skip
    rate_hz: float = parameter(
        125.0, number, above=0.0,
        doc="Sample rate [Hz] of the fits, after filtering; residual networks use all samples.",
    )  # fmt: skip
    sign_width: float = parameter(
        0.01, number, at_least=0.0,
        doc="Width of the smooth sign function [rad/s], the same for every memoryless method.",
    )  # fmt: skip
    figures: bool = parameter(True, flag, doc="Whether to draw figures.")
    jobs: int | None = parameter(
        None, whole, at_least=1, at_most=4096, optional=True,
        doc="Number of processes; None: number of cores. The result does not depend on it.",
    )  # fmt: skip
    dask: str | None = parameter(
        None, checked_address,
        doc="Address of a Dask scheduler whose workers compute instead of local processes.",
    )  # fmt: skip

    def extras(self) -> dict[str, str]:
        """Return the optional dependencies (extras) of the estimators in the selected table rows.

        A study is rejected if an extra is missing, because its table of results would be
        incomplete.
        """
        return extras_of(self.methods)

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the required data: at least three trajectories, and drive gains."""
        return NEEDS

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Return tables, figures and texts of the selected protocols.

        Raises:
            FitError: There are too few trajectories, or none of the methods can be fitted.
            DataError: The data cannot be filtered with the selected cut-off frequency.
        """
        of = recorded(dataset, robot, self.cutoff_hz, self.rate_hz)
        absent = {key: name for key in self.methods if (name := missing(ROWS[key]))}
        known = families([key for key in self.methods if key not in absent])
        cases = {
            name: [CASES[name](of, seed) for seed in range(self.seed, self.seed + self.seeds)]
            for name in self.protocols
        }
        tasks = [
            family_task(root, keys, case, robot, self.sign_width, self.effort)
            for draws in cases.values()
            for root, keys in known.items()
            for case in draws
        ]
        # Computed first, because a failure after the fits would waste hours.
        seen = {name: [Seen.of(case) for case in draws] for name, draws in cases.items()}
        with cluster(self.dask) as executor:
            results = iter(run_tasks(tasks, self.jobs or cores(), "fits", progress, executor))
        loads = {} if of.loaded is None else load_names(of.loaded)
        found = [
            gathered(
                name,
                [(keys, [next(results) for _ in draws]) for keys in known.values()],
                seen[name],
                loads,
            )
            for name, draws in cases.items()
        ]
        notes = [*of.notes, *_absent(absent), *_failures(found), *_partly(found)]
        return StudyResult(
            self.study,
            "Inverse dynamics: Table II of the PINN paper, under two protocols",
            tuple(summary(found)),
            self._parts(found),
            self.get_params(),
            warnings=tuple(notes),
        )

    def _parts(self, found: Sequence[Found]) -> tuple[Part, ...]:
        parts = [self._part(one) for one in found]
        if len(found) > 1:
            parts.append(Part("Side by side", "", (), (tables.both(found),)))
        return tuple(parts)

    def _part(self, found: Found) -> Part:
        name = found.protocol
        shown = tuple(_tables(found))
        figures = tuple(_figures(found)) if self.figures else ()
        return Part(TITLES[name], LABELS[name], TEXTS[name], shown, figures)


def _tables(found: Found) -> Iterator[Table]:
    name = found.protocol
    what = TITLES[name].lower()
    yield tables.errors(found, f"table-{name}", what)
    yield tables.largest(found, f"table-{name}-mep", what)
    yield tables.measured(found, f"table-{name}-raw", "raw")
    if name == "honest":
        yield tables.measured(found, "table-moving", "moving")
        yield tables.measured(found, "table-within", "within")
    more = (
        tables.decided(found, f"table-{name}-decided", LEFT_OUT[name]),
        tables.under_loads(found) if name == "honest" else None,
    )
    yield from (table for table in more if table is not None)


def _figures(found: Found) -> Iterator[Figure]:
    name = found.protocol
    yield drawn.bars(found, f"fig-{name}-errors")
    if name == "honest":
        made = (
            drawn.torques(found, "fig-torques"),
            drawn.friction(found, "fig-friction"),
            drawn.residuals(found, "fig-residual"),
            drawn.loads(found),
            drawn.learning(found, "fig-learning"),
        )
        yield from (figure for figure in made if figure is not None)


def _absent(absent: dict[str, str]) -> Iterator[str]:
    yield from (f"{ROWS[key].words}: {name} is not installed" for key, name in absent.items())


def _partly(found: Sequence[Found]) -> Iterator[str]:
    for one in found:
        for key, scores in one.scores.items():
            least = min(score.known for score in scores)
            if least < 0.999:
                yield (
                    f"{one.words(key)}, {one.protocol}: evaluated only on the {100 * least:.1f} % "
                    "of the samples for which it is valid"
                )


def _listed(failed: Mapping[str, Sequence[str]]) -> str:
    """Return the failed table rows, each with the protocols under which the row failed."""
    return "; ".join(f"{row}, {' and '.join(protocols)}" for row, protocols in failed.items())


def _failures(found: Sequence[Found]) -> list[str]:
    """Return notes about the methods that failed, one note per reason.

    Raises:
        FitError: All methods of the study failed.
    """
    rows: dict[str, dict[str, list[str]]] = {}
    for one in found:
        for key, reason in one.failed.items():
            row = f"{one.words(key)} ({ROWS[key].estimator})"
            rows.setdefault(reason, {}).setdefault(row, []).append(one.protocol)
    notes = [f"{_listed(failed)}: omitted, {reason}" for reason, failed in rows.items()]
    if not any(one.scores for one in found):
        raise FitError(
            f"no method could be fitted: {next(iter(notes), 'none is installed')}",
            hint="the page lists the other reasons; hil doctor lists missing packages",
        )
    return notes
