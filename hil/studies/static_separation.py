"""The static friction separation paper: its tables and figures, under its protocol and honestly.

Everything is computed twice from one run: as the paper does (`separation_paper`), labelled so, and
so that the numbers say how well a current is predicted (`separation_honest`). Both only prepare
their fits and trainings; all of them are spread over the processes at once, the longest first
(docs/explanation/static-separation.md).
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
    """What came of a protocol: its part, sentences for the summary, and what was left out."""

    part: Part
    summary: list[str]
    notes: list[str]


Followed: TypeAlias = tuple[list[Task], Callable[[list[Any]], Shown]]
"""What a protocol has to compute, and how its results are shown."""

ONE_SIDED = (
    "no pose was approached from both sides, so gravity and stick friction cannot be told apart "
    "without a model (excitation: {approach: both})"
)


INPUTS = 4


def checked_layouts(name: str, given: Any) -> list[list[int]]:
    """A list of layouts.

    Raises:
        SpecError: It is none, or one of them is none.
    """
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SpecError(f"{name} is {given!r}, but must be a list of layouts")
    return [checked_layout(f"{name}[{i}]", one) for i, one in enumerate(given)]


def checked_layout(name: str, given: Any) -> list[int]:
    """Units per layer, four inputs first and one output last.

    Raises:
        SpecError: It is no such list.
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
            f"{name} begins with {layers[0]}, but the paper's networks have {INPUTS} inputs, q2…q5"
        )
    return layers


def percent(name: str, given: Any) -> float:
    """A share in per cent, above 0 and below 100.

    Raises:
        SpecError: It is none.
    """
    found = number(name, given, above=0.0)
    if found >= 100.0:
        raise SpecError(f"{name} is {given!r}, but must be below 100")
    return found


class StaticSeparation(Study):
    """Tables 2 to 4 and figures 3 to 8 of the static paper, as printed and honestly."""

    study: ClassVar[str] = "static-separation"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("dwell",),)

    protocols: list[str] = parameter(PROTOCOLS, subset, PROTOCOLS, doc="`paper`, `honest` or both.")
    layouts: list[list[int]] = parameter(
        tuple(TABLE_3), checked_layouts,
        doc="Of networks to compare in Table 3, four inputs (q2…q5) and one output each.",
    )  # fmt: skip
    layout: list[int] = parameter(
        TABLE_4_LAYOUT, checked_layout,
        doc="The one of Table 4 and the figures, and of the honest networks.",
    )  # fmt: skip
    first_layer: str = parameter(
        "tanh", choice, ("tanh", "linear"),
        doc="Of the paper's networks, `tanh` (as pyrenn has it) or `linear` (its text).",
    )  # fmt: skip
    epochs: int = parameter(
        1000, whole, at_least=1,
        doc="Of Levenberg–Marquardt; the honest networks stop earlier by held-out poses.",
    )  # fmt: skip
    alpha: float = parameter(0.001, number, above=0.0, doc="Of ridge, LASSO and elastic net.")
    weights: Weights = parameter(
        "paper", choice, ("paper", "repeats", "pose"), doc="Of WLS, see `static-linear`."
    )
    methods: list[str] = parameter(
        METHOD_KEYS, subset, METHOD_KEYS,
        doc="Of the honest comparison, see `hil.studies.separation_honest.known_methods`.",
    )  # fmt: skip
    folds: int = parameter(
        5, whole, at_least=2,
        doc="Of the honest comparison: each pose is held out in one of them.",
    )  # fmt: skip
    hold_out_percent: float | None = parameter(
        None, percent, optional=True, doc="Hold out this share of the poses once instead."
    )
    joint: int = parameter(
        3, whole, at_least=1, doc="Shown beside joint 1 in Fig. 5, and in Fig. 7; from 1."
    )
    figures: bool = parameter(True, flag, doc="Whether to draw any.")
    seed: int = parameter(
        0, whole, at_least=0, doc="Of splits, drawn approaches and start weights."
    )
    jobs: int | None = parameter(
        None, whole, at_least=1, optional=True,
        doc="Processes; None: as many as there are cores. The result does not depend on it.",
    )  # fmt: skip

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what it cannot do without: four poses."""
        return NEEDS

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Tables, figures and words of both protocols.

        Raises:
            FitError: There are too few dwells or poses, or no protocol can be followed.
        """
        recording = recording_of(dataset, robot)
        if self.joint > robot.n:
            raise FitError(
                f"joint is {self.joint}, but {robot.name} has {robot.n}",
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
            "Static friction separation, as printed and honestly",
            tuple(sentence for one in shown for sentence in one.summary),
            (data_part(recording, angles), *(one.part for one in shown)),
            self.get_params(),
            warnings=(*notes, *(note for one in shown for note in one.notes)),
        )

    def _all_followed(self, recording: Recording, notes: list[str]) -> list[Followed]:
        """The protocols that can be followed; notes why others cannot.

        Raises:
            FitError: None can be.
        """
        found: list[Followed] = []
        errors: list[FitError] = []
        ways = {"paper": self._paper, "honest": self._honest}
        for name in self.protocols:
            try:
                found.append(ways[name](recording))
            except FitError as error:
                errors.append(error)
                notes.append(f"the {name} protocol is left out: {error.message}")
        if not found:
            raise errors[-1]
        return found

    def _paper(self, recording: Recording) -> Followed:
        if recording.dwells.effort_kind != "current":
            raise FitError(
                "eq. 16 to 20 are about motor currents, and the recording holds torques",
                hint="ask for protocols: [honest]",
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
