"""The static friction separation paper: its tables and figures, under its protocol and honestly.

Everything is computed twice from one run: as the paper does, labelled so, and so that the numbers
say how well a current is predicted (docs/explanation/static-separation.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

from hil.core import FitError, cores
from hil.data import Dataset, SeriesKind
from hil.dynamics import RobotModel
from hil.estimators import Needs, Weights, choice, flag, number, whole
from hil.studies.base import Progress, Study, silent
from hil.studies.result import Part, StudyResult
from hil.studies.separation_band import bands
from hil.studies.separation_data import NEEDS, Recording, recording_of
from hil.studies.separation_data_part import data_part
from hil.studies.separation_drawn import honest_figures, paper_figures
from hil.studies.separation_honest import HonestProtocol
from hil.studies.separation_honest_part import honest_part, honest_summary
from hil.studies.separation_methods import METHOD_KEYS, known_methods
from hil.studies.separation_networks import NetworkSettings
from hil.studies.separation_paper import PaperProtocol
from hil.studies.separation_paper_part import paper_part, paper_summary
from hil.studies.separation_parameters import layout as checked_layout
from hil.studies.separation_parameters import layouts as checked_layouts
from hil.studies.separation_parameters import share, words
from hil.studies.separation_tasks import Task, run_tasks

TABLE_3 = (
    (4, 20, 10, 10, 1),
    (4, 10, 10, 1),
    (4, 20, 10, 1),
    (4, 15, 10, 1),
    (4, 20, 15, 10, 1),
    (4, 15, 15, 10, 1),
    (4, 10, 10, 10, 1),
    (4, 20, 20, 10, 1),
)
PROTOCOLS = ("paper", "honest")


class Shown(NamedTuple):
    """What came of a protocol: its part, sentences for the summary, and what was left out."""

    part: Part
    summary: list[str]
    notes: list[str]


Followed: TypeAlias = tuple[list[Task], Callable[[list[Any]], Shown]]
"""What a protocol has to compute, and how its results are shown."""


class StaticSeparation(Study):
    """Tables 2 to 4 and figures 3 to 8 of the static paper, as printed and honestly.

    Args:
        protocols: `paper`, `honest` or both.
        layouts: Of networks to compare in Table 3, four inputs (q2…q5) and one output each.
        layout: The one of Table 4 and the figures, and of the honest networks.
        first_layer: Of the paper's networks, `tanh` (as pyrenn has it) or `linear` (its text).
        epochs: Of Levenberg–Marquardt; the honest networks stop earlier by held-out poses.
        alpha: Of ridge, LASSO and elastic net.
        weights: Of WLS, see `static-linear`.
        methods: Of the honest comparison, see `hil.studies.separation_methods`.
        folds: Of the honest comparison: each pose is held out in one of them.
        hold_out_percent: Hold out this share of the poses once instead.
        joint: Shown beside joint 1 in Fig. 5, and in Fig. 7; from 1.
        figures: Whether to draw any.
        seed: Of splits, drawn approaches and start weights.
        jobs: Processes; None: as many as there are cores. The result does not depend on it.
    """

    study: ClassVar[str] = "static-separation"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("dwell",),)

    def __init__(
        self,
        *,
        protocols: Sequence[str] = PROTOCOLS,
        layouts: Sequence[Sequence[int]] = TABLE_3,
        layout: Sequence[int] = TABLE_3[-1],
        first_layer: str = "tanh",
        epochs: int = 1000,
        alpha: float = 0.001,
        weights: Weights = "paper",
        methods: Sequence[str] = METHOD_KEYS,
        folds: int = 5,
        hold_out_percent: float | None = None,
        joint: int = 3,
        figures: bool = True,
        seed: int = 0,
        jobs: int | None = None,
    ) -> None:
        self.protocols = words("protocols", protocols, PROTOCOLS)
        self.layouts = checked_layouts("layouts", layouts)
        self.layout = checked_layout("layout", layout)
        self.first_layer = choice("first_layer", first_layer, ("tanh", "linear"))
        self.epochs = whole("epochs", epochs, at_least=1)
        self.alpha = number("alpha", alpha, above=0.0)
        self.weights = choice("weights", weights, ("paper", "repeats", "pose"))
        self.methods = words("methods", methods, METHOD_KEYS)
        self.folds = whole("folds", folds, at_least=2)
        self.hold_out_percent = share("hold_out_percent", hold_out_percent)
        self.joint = whole("joint", joint, at_least=1)
        self.figures = flag("figures", figures)
        self.seed = whole("seed", seed, at_least=0)
        self.jobs = None if jobs is None else whole("jobs", jobs, at_least=1)

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
        return StudyResult(
            self.study,
            "Static friction separation, as printed and honestly",
            tuple(sentence for one in shown for sentence in one.summary),
            (data_part(recording, figures=self.figures), *(one.part for one in shown)),
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


ONE_SIDED = (
    "no pose was approached from both sides, so gravity and stick friction cannot be told apart "
    "without a model (excitation: {approach: both})"
)
