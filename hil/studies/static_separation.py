"""Study of the static friction separation paper: tables and figures under two protocols.

All results are computed under two protocols from one run. The module `separation_paper` follows the
static paper and labels its results accordingly. The module `separation_honest` holds out whole
poses; its errors show how accurately the models predict the current at new poses. The two protocols
only prepare their fits and trainings as tasks. The tasks of the two protocols are then distributed
over the processes together, longest tasks first (docs/explanation/static-separation.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

from hil.core import FitError, SpecError, cores
from hil.data import Dataset, SeriesKind
from hil.dynamics import RobotModel
from hil.estimators import Needs, Weights, choice, flag, number, parameter, whole
from hil.networks import Mlp
from hil.studies.base import Progress, Study, silent, subset
from hil.studies.result import Part, StudyResult
from hil.studies.separation_data import NEEDS, Recording, recording_of
from hil.studies.separation_figures import honest_figures, joint_angles, paper_figures
from hil.studies.separation_honest import METHOD_KEYS, HonestProtocol, bands, known_methods
from hil.studies.separation_paper import NetworkSettings, PaperProtocol
from hil.studies.separation_tables import (
    TABLE_3,
    TABLE_4_LAYOUT,
    data_part,
    honest_part,
    honest_summary,
    paper_part,
    paper_summary,
)
from hil.studies.tasks import Task, run_tasks

PROTOCOLS = ("paper", "honest")


class Shown(NamedTuple):
    """Part, summary sentences and notes of one protocol."""

    part: Part
    summary: list[str]
    notes: list[str]


Followed: TypeAlias = tuple[list[Task], Callable[[list[Any]], Shown]]
"""Tasks of a protocol, and the function that converts the task results into tables and figures."""

ONE_SIDED = (
    "no pose was approached from both directions, so that gravity and static friction cannot be "
    "separated without a model (excitation: {approach: both})"
)


INPUTS = 4


def checked_layouts(name: str, given: Any) -> list[list[int]]:
    """Return a validated list of network layouts.

    Raises:
        SpecError: The value is not a list, or a layout is invalid.
    """
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SpecError(f"{name} is {given!r}, but must be a list of layouts")
    return [checked_layout(f"{name}[{i}]", one) for i, one in enumerate(given)]


def checked_layout(name: str, given: Any) -> list[int]:
    """Return a validated network layout: units per layer, with four inputs and one output.

    Raises:
        SpecError: The value is not a list of positive integers with four inputs and one output.
    """
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise SpecError(f"{name} is {given!r}, but must be a list of whole numbers")
    layers = [whole(name, units, at_least=1) for units in given]
    try:
        Mlp(layers)
    except SpecError as error:
        raise SpecError(f"{name}: {error.message}", hint=error.hint) from error
    if layers[0] != INPUTS:
        raise SpecError(
            f"{name} begins with {layers[0]}, but the networks of the paper have {INPUTS} inputs, "
            "q2…q5"
        )
    return layers


def percent(name: str, given: Any) -> float:
    """Return a validated share in per cent, greater than 0 and less than 100.

    Raises:
        SpecError: The value is not a number between 0 and 100.
    """
    found = number(name, given, above=0.0)
    if found >= 100.0:
        raise SpecError(f"{name} is {given!r}, but must be below 100")
    return found


class StaticSeparation(Study):
    """Tables 2 to 4 and figures 3 to 8 of the static paper, under two protocols."""

    study: ClassVar[str] = "static-separation"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("dwell",),)

    protocols: list[str] = parameter(
        PROTOCOLS, subset, PROTOCOLS, doc="Protocols: `paper`, `honest` or both."
    )
    layouts: list[list[int]] = parameter(
        tuple(TABLE_3), checked_layouts,
        doc="Layer sizes of the networks in Table 3, each with four inputs (q2…q5) and one output.",
    )  # fmt: skip
    layout: list[int] = parameter(
        TABLE_4_LAYOUT, checked_layout,
        doc="Layer sizes of the network in Table 4 and the figures, and of the honest networks.",
    )  # fmt: skip
    first_layer: str = parameter(
        "tanh", choice, ("tanh", "linear"),
        doc="First layer of the networks of the paper: `tanh` as in pyrenn, or `linear` as in the "
        "text of the paper.",
    )  # fmt: skip
    epochs: int = parameter(
        1000, whole, at_least=1,
        doc="Maximum number of Levenberg–Marquardt epochs; the honest networks stop earlier by "
        "means of held-out poses.",
    )  # fmt: skip
    alpha: float = parameter(
        0.001, number, above=0.0, doc="Penalty of ridge, LASSO and elastic net."
    )
    weights: Weights = parameter(
        "paper", choice, ("paper", "repeats", "pose"),
        doc="Weighting of the rows in WLS, see `static-linear`.",
    )  # fmt: skip
    methods: list[str] = parameter(
        METHOD_KEYS, subset, METHOD_KEYS,
        doc="Methods of the honest comparison, see `hil.studies.separation_honest.known_methods`.",
    )  # fmt: skip
    folds: int = parameter(
        5, whole, at_least=2,
        doc="Number of folds of the honest comparison; each pose is held out in one fold.",
    )  # fmt: skip
    hold_out_percent: float | None = parameter(
        None, percent, optional=True,
        doc="Share of the poses [%] that is held out once, instead of folds.",
    )  # fmt: skip
    joint: int = parameter(
        3, whole, at_least=1,
        doc="Number of the joint (counted from 1) in Fig. 7, and beside joint 1 in Fig. 5.",
    )  # fmt: skip
    figures: bool = parameter(True, flag, doc="Whether to draw figures.")
    seed: int = parameter(
        0, whole, at_least=0, doc="Random seed of splits, approach directions and initial weights."
    )
    jobs: int | None = parameter(
        None, whole, at_least=1, optional=True,
        doc="Number of processes; None: number of cores. The result does not depend on it.",
    )  # fmt: skip

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the required data: at least four poses."""
        return NEEDS

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Return tables, figures and texts of the selected protocols.

        Raises:
            FitError: There are too few dwells or poses, or none of the selected protocols can be
                applied.
        """
        recording = recording_of(dataset, robot)
        if self.joint > robot.n:
            raise FitError(
                f"joint is {self.joint}, but {robot.name} has {robot.n} joints",
                hint="joints are counted from 1",
            )
        notes = list(recording.notes)
        followed = self._all_followed(recording, notes)
        tasks = [task for own, _ in followed for task in own]
        results = iter(run_tasks(tasks, self.jobs or cores(), "fits and trainings", progress))
        shown = [show([next(results) for _ in own]) for own, show in followed]
        angles = (joint_angles(recording.whole),) if self.figures else ()
        return StudyResult(
            self.study,
            "Static friction separation, paper protocol and honest protocol",
            tuple(sentence for one in shown for sentence in one.summary),
            (data_part(recording, angles), *(one.part for one in shown)),
            self.get_params(),
            warnings=(*notes, *(note for one in shown for note in one.notes)),
        )

    def _all_followed(self, recording: Recording, notes: list[str]) -> list[Followed]:
        """Return the protocols that can be applied; add a note for each protocol that cannot.

        Raises:
            FitError: None of the selected protocols can be applied.
        """
        found: list[Followed] = []
        errors: list[FitError] = []
        ways = {"paper": self._paper, "honest": self._honest}
        for name in self.protocols:
            try:
                found.append(ways[name](recording))
            except FitError as error:
                errors.append(error)
                notes.append(f"the {name} protocol is omitted: {error.message}")
        if not found:
            raise errors[-1]
        return found

    def _paper(self, recording: Recording) -> Followed:
        if recording.dwells.effort_kind != "current":
            raise FitError(
                "eq. 16 to 20 require motor currents, but the recording contains torques",
                hint="set protocols: [honest]",
            )
        protocol = PaperProtocol(
            recording,
            layouts=[tuple(one) for one in self.layouts],
            layout=tuple(self.layout),
            settings=NetworkSettings(self.epochs, self.seed, self.first_layer == "linear"),
            alpha=self.alpha,
            weights=self.weights,
        )

        def show(results: list[Any]) -> Shown:
            found = protocol.gather(results)
            drawn = paper_figures(found, self.joint - 1) if self.figures else ()
            return Shown(paper_part(found, drawn, self.epochs), paper_summary(found), [])

        return protocol.tasks(), show

    def _honest(self, recording: Recording) -> Followed:
        known = known_methods(
            alpha=self.alpha,
            weights=self.weights,
            layout=tuple(self.layout),
            epochs=self.epochs,
            seed=self.seed,
        )
        protocol = HonestProtocol(
            recording,
            methods=[known[key] for key in self.methods],
            folds=self.folds,
            hold_out_percent=self.hold_out_percent,
            seed=self.seed,
        )

        def show(results: list[Any]) -> Shown:
            found = protocol.gather(results)
            both, joint = bands(found), self.joint - 1
            notes = [*found.notes, *([] if both else [ONE_SIDED])]
            drawn = (
                honest_figures(recording, found, both, joint, self.weights) if self.figures else ()
            )
            return Shown(honest_part(found, both, drawn), honest_summary(found), notes)

        return protocol.tasks(), show
