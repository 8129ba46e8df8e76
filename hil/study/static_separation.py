"""The static friction separation paper: its tables and figures, under its protocol and honestly.

Everything is computed twice from one run: as the paper does, labelled so, and so that the numbers
say how well a current is predicted (docs/explanation/static-separation.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from hil.data.dataset import Dataset
from hil.dynamics import RobotModel
from hil.errors import FitError, SpecError
from hil.executor import cores
from hil.identify.linear_methods import Weights
from hil.identify.lm.network import Mlp
from hil.identify.lm.settings import whole
from hil.identify.parameters import choice, flag, number
from hil.study.base import Progress, Study, silent
from hil.study.result import Figure, Part, StudyResult, Table
from hil.study.separation_band import bands
from hil.study.separation_data import Recording, mean_noise, recording_of, sample_noise
from hil.study.separation_drawn import honest_figures, paper_figures
from hil.study.separation_figures import joint_angles
from hil.study.separation_honest import HonestProtocol
from hil.study.separation_honest_part import honest_part
from hil.study.separation_honest_part import summary as honest_summary
from hil.study.separation_methods import METHOD_KEYS, known_methods
from hil.study.separation_networks import NetworkSettings
from hil.study.separation_paper import Layout, PaperProtocol
from hil.study.separation_paper_part import paper_part
from hil.study.separation_paper_part import summary as paper_summary
from hil.study.separation_tasks import run_tasks
from hil.study.separation_text import joint_titles, with_mean

TABLE_3: tuple[Layout, ...] = (
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
        methods: Of the honest comparison, see `hil.study.separation_methods`.
        folds: Of the honest comparison: each pose is held out in one of them.
        hold_out_percent: Hold out this share of the poses once instead.
        joint: Shown beside joint 1 in Fig. 5, and in Fig. 7; from 1.
        figures: Whether to draw any.
        seed: Of splits, drawn approaches and start weights.
        jobs: Processes; None: as many as there are cores. The result does not depend on it.
    """

    study: ClassVar[str] = "static-separation"

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
        self.protocols = _words("protocols", protocols, PROTOCOLS)
        self.layouts = [_layout(f"layouts[{i}]", one) for i, one in enumerate(_list(layouts))]
        self.layout = _layout("layout", layout)
        self.first_layer = choice("first_layer", first_layer, ("tanh", "linear"))
        self.epochs = whole("epochs", epochs, at_least=1)
        self.alpha = number("alpha", alpha, at_least=0.0)
        self.weights = choice("weights", weights, ("paper", "repeats", "pose"))
        self.methods = _words("methods", methods, METHOD_KEYS)
        self.folds = whole("folds", folds, at_least=2)
        self.hold_out_percent = hold_out_percent
        if hold_out_percent is not None:
            self.hold_out_percent = number("hold_out_percent", hold_out_percent, above=0.0)
            if hold_out_percent >= 100.0:
                raise SpecError(f"hold_out_percent is {hold_out_percent:g}, but must be below 100")
        self.joint = whole("joint", joint, at_least=1)
        self.figures = flag("figures", figures)
        self.seed = whole("seed", seed, at_least=0)
        self.jobs = None if jobs is None else whole("jobs", jobs, at_least=1)

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Tables, figures and words of both protocols.

        Raises:
            FitError: There are too few dwells or poses, or no protocol can be followed.
        """
        recording = recording_of(dataset, robot)
        if self.joint > robot.n:
            raise FitError(f"joint is {self.joint}, but {robot.name} has {robot.n}")
        notes = list(recording.notes)
        prepared = self._prepared(recording, notes)
        tasks = {name: protocol.tasks() for name, protocol in prepared.items()}
        flat = [task for name in tasks for task in tasks[name]]
        results = run_tasks(flat, self.jobs or cores(), "fitting and training", progress)
        parts, told, start = [self._data_part(recording)], list[str](), 0
        for name, protocol in prepared.items():
            stop = start + len(tasks[name])
            part, words, more = self._shown(recording, protocol, results[start:stop])
            parts.append(part)
            told, notes, start = told + words, notes + more, stop
        title = "Static friction separation, as printed and honestly"
        return StudyResult(
            self.study, title, tuple(told), tuple(parts), self.get_params(), warnings=tuple(notes)
        )

    def _prepared(
        self, recording: Recording, notes: list[str]
    ) -> dict[str, PaperProtocol | HonestProtocol]:
        """The protocols that can be followed; notes why others cannot."""
        prepared: dict[str, PaperProtocol | HonestProtocol] = {}
        last: FitError | None = None
        for name in self.protocols:
            try:
                prepared[name] = self._protocol(name, recording)
            except FitError as error:
                last = error
                notes.append(f"the {name} protocol is left out: {error.message}")
        if not prepared and last is not None:
            raise last
        return prepared

    def _protocol(self, name: str, recording: Recording) -> PaperProtocol | HonestProtocol:
        if name == "paper":
            if not recording.is_current:
                raise FitError("eq. 20 is about motor currents, the recording holds torques")
            settings = NetworkSettings(self.epochs, self.seed, self.first_layer == "linear")
            return PaperProtocol(
                recording, layouts=[tuple(one) for one in self.layouts],
                layout=tuple(self.layout), settings=settings, alpha=self.alpha,
                weights=self.weights,
            )  # fmt: skip
        known = known_methods(
            alpha=self.alpha, weights=self.weights, layout=tuple(self.layout),
            epochs=self.epochs, seed=self.seed,
        )  # fmt: skip
        return HonestProtocol(
            recording, methods=[known[key] for key in self.methods], folds=self.folds,
            hold_out_percent=self.hold_out_percent, seed=self.seed,
        )  # fmt: skip

    def _shown(
        self, recording: Recording, protocol: PaperProtocol | HonestProtocol, results: list[Any]
    ) -> tuple[Part, list[str], list[str]]:
        """The part of a protocol, sentences for the summary, and notes."""
        drawn: tuple[Figure, ...] = ()
        if isinstance(protocol, PaperProtocol):
            paper = protocol.gather(results)
            drawn = paper_figures(paper, self.joint - 1) if self.figures else ()
            return paper_part(paper, drawn, self.epochs), paper_summary(paper), []
        found = protocol.gather(results)
        both = bands(found)
        notes = list(found.notes)
        if both is None:
            notes.append("no pose was approached from both sides: friction cannot be told apart")
        if self.figures:
            drawn = honest_figures(recording, found, both, self.joint - 1, self.weights)
        return honest_part(found, both, drawn), honest_summary(found), notes

    def _data_part(self, recording: Recording) -> Part:
        """What was recorded, and the noise in it."""
        dwells = recording.dwells
        unit = dwells.effort_unit
        rows = (
            ("a sample about the mean of its dwell", *with_mean(sample_noise(dwells))),
            ("left in the mean of a dwell", *with_mean(mean_noise(dwells))),
        )
        table = Table(
            "table-noise",
            f"Noise of the {dwells.effort_kind} at rest, standard deviation [{unit}]",
            ("of", *joint_titles(dwells.n_joints), "mean"),
            rows,
            "From the scatter within dwells; what a whole dwell has wrong does not show in it.",
        )
        drawn = (joint_angles(recording.whole),) if self.figures else ()
        poses = len({(c.source, c.pose) for c in dwells.conditions})
        text = f"{len(dwells.conditions)} dwells of {poses} poses, {len(dwells)} samples at rest."
        return Part("The recording", "", (text,), (table,), drawn)


def _list(given: Any) -> list[Any]:
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SpecError(f"layouts is {given!r}, but must be a list of layouts")
    return list(given)


def _layout(name: str, given: Any) -> list[int]:
    """Units per layer, four inputs first and one output last."""
    try:
        layers = [whole(name, units, at_least=1) for units in given]
        Mlp(layers)
    except TypeError as error:
        raise SpecError(f"{name} is {given!r}, but must be a list of whole numbers") from error
    except SpecError as error:
        raise SpecError(f"{name}: {error.message}", hint=error.hint) from error
    if layers[0] != 4:
        raise SpecError(f"{name} begins with {layers[0]}, but the networks see q2, q3, q4 and q5")
    return layers


def _words(name: str, given: Any, known: Sequence[str]) -> list[str]:
    """Some of the known words, in the order of those."""
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SpecError(f"{name} is {given!r}, but must be a list of {', '.join(known)}")
    chosen = {choice(name, word, known) for word in given}
    return [word for word in known if word in chosen]
