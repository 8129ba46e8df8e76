"""What a run says about itself in its small files: documents, plan, events, models, studies.

Everything is read leniently: what is missing says nothing, and what is damaged becomes a warning,
because a report is most wanted of a run that went wrong. `read_facts` gathers it once for page,
terminal and dashboard. Samples are read by `run_samples`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from hil.core import (
    DataError,
    FloatArray,
    HilError,
    Source,
    SpecError,
    is_live,
    read_json,
    read_source,
)
from hil.data import FOUND_FILE
from hil.importers import completeness_of, rows_of
from hil.planning import Plan, read_plan
from hil.recording import (
    Counts,
    RunDirectory,
    attempt_of,
    has_its_beginning,
    hint_of_lost,
    name_of_attempt,
    recorded_s,
    torn_although_finished,
)
from hil.report.words import number, short_source
from hil.spec import load_spec
from hil.studies import StudyResult, problem_files, read_study, study_files

PLURALS = {"trajectory": "trajectories", "weigh": "weighings"}

UNDER_LOADS = ("load_error_ratio", "contradicted_loads")
"""Criteria about loads, judged on all models at once."""

UNENDED = ("interrupted", "running")
"""Status of a run whose last attempt has no stop document."""

Document: TypeAlias = Mapping[str, Any]

HONEST = "honest"
"""As in `hil.estimators.base`, which would load Pinocchio to show a few numbers."""

Part = Literal["held_out", "trained"]


@dataclass(frozen=True, slots=True)
class FitFacts:
    """One fitted model.

    Attributes:
        folder: `fit/<estimator>-<digest>`.
        name: The estimator's name, with the digest where two folders have the same estimator, and
            with a mark where the model follows a paper's protocol.
        label: The name, with the source where the model was judged on several.
        evaluation: Content of `evaluation.json`, empty when it was not evaluated.
        model: Content of `model.json`.
        under_loads: Rows of its run's verdict about loads.
    """

    folder: Path
    name: str
    label: str
    evaluation: Document
    model: Document
    under_loads: Sequence[Document] = ()

    @property
    def estimator(self) -> str:
        """As registered."""
        return _estimator_of(self.folder)

    @property
    def protocol(self) -> str:
        """`honest`, or how the model departs from that."""
        return _protocol(self.model, self.evaluation)

    @property
    def is_honest(self) -> bool:
        """Whether the model predicts without seeing the target."""
        return self.protocol == HONEST

    @property
    def held_out(self) -> Document:
        """Errors on data the model has not seen; empty when there are none."""
        if "held_out" in self.evaluation:
            return as_object(self.evaluation["held_out"])
        return self.evaluation if "total" in self.evaluation else {}

    @property
    def trained(self) -> Document:
        """Errors on the data the model was fitted to; empty when not stored."""
        return as_object(self.evaluation.get("trained"))

    @property
    def beside(self) -> Sequence[Document]:
        """Errors where only the load or only the motion is new; not judged."""
        return as_objects(self.evaluation.get("beside"))

    @property
    def above(self) -> str:
        """Where the high-frequency part of the signal begins, `12.5 Hz`; empty when unknown."""
        cutoff = self.held_out.get("cutoff_hz")
        if not isinstance(cutoff, list) or not cutoff:
            return ""
        edges = dict.fromkeys(number(as_float(edge)) for edge in cutoff)
        return f"{'–'.join(edges)} Hz"

    @property
    def fast_part(self) -> str:
        """What `noise_floor` is: the part the filter takes away, or the scatter within dwells."""
        if self.above:
            return f"part above {self.above}"
        if "cutoff_hz" in self.held_out:
            return "scatter within dwells"
        return "high-frequency part"

    @property
    def criteria(self) -> Sequence[Document]:
        """Rows of its verdict."""
        return as_objects(as_object(self.evaluation.get("verdict")).get("rows"))

    @property
    def source(self) -> str:
        """Recording it was judged on; empty for the part of a run that was held out."""
        return str(self.held_out.get("source") or "")

    @property
    def unit(self) -> str:
        """Unit of the effort, `A` or `N·m`; empty when unknown."""
        return str(self.held_out.get("unit", ""))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints, in the order of every value."""
        return as_names(self.held_out.get("joint_names"))

    def total(self, part: Part = "held_out") -> Document:
        """The errors over all rows of a part."""
        return as_object((self.held_out if part == "held_out" else self.trained).get("total"))

    def mean(self, metric: str, part: Part = "held_out") -> float:
        """Mean of a metric over the joints it is defined for; NaN when unknown.

        The two means the evaluation stores itself (`rmse_raw`, `rmse_filtered`) are read, not
        computed again.
        """
        stored = as_float(self.total(part).get(f"mean_{metric.removeprefix('rmse_')}"))
        if math.isfinite(stored):
            return stored
        known = self.values(metric, part)
        known = known[np.isfinite(known)]
        return float(known.mean()) if len(known) else float("nan")

    def values(self, metric: str, part: Part = "held_out") -> FloatArray:
        """(n,) a metric per joint; NaN where it is undefined or not stored."""
        values = self.total(part).get(metric)
        if not isinstance(values, list) or len(values) != len(self.joint_names):
            return np.full(len(self.joint_names), np.nan)
        return np.array([as_float(value) for value in values])


def _estimator_of(folder: Path) -> str:
    return folder.name.rpartition("-")[0] or folder.name


def _protocol(model: Document, evaluation: Document) -> str:
    """As the model says, or the evaluation; models of an older hil are honest and say nothing."""
    told = as_object(model.get("fitted")).get("protocol") or evaluation.get("protocol")
    return str(told or HONEST)


@dataclass(frozen=True, slots=True)
class StudyFacts:
    """The studies of a run.

    Attributes:
        made: What they found, in order of folder name.
        failed: Why studies have no result, or only an older one: `study`, `error`, `hint`.
    """

    made: tuple[StudyResult, ...] = ()
    failed: Sequence[Document] = ()

    @property
    def known(self) -> frozenset[str]:
        """The studies that were made or tried."""
        tried = (str(problem.get("study")) for problem in self.failed)
        return frozenset({*(result.study for result in self.made), *tried})

    @property
    def warnings(self) -> list[str]:
        """What is missing and why, then what the studies themselves left out."""
        missing = [
            f"The study {problem.get('study')} could not be made: "
            + " → ".join(filter(None, (str(problem.get(key) or "") for key in ("error", "hint"))))
            for problem in self.failed
        ]
        told = [f"{result.title}: {text}" for result in self.made for text in result.warnings]
        return missing + told


@dataclass(frozen=True, slots=True)
class RunFacts:
    """The small files of a run.

    Attributes:
        path: The run directory.
        status: `completed`, `stopped`, `tripped`, `failed`, `interrupted`, `running` or
            `damaged`.
        start, stop, plan, preflight, verdict: The documents; empty where absent or damaged. A
            resumed run has the stop document of its last attempt.
        recorded: What the stop document counts; where there is none, counted by the data.
        whole: Whether start document and plan can be used: nothing goes on without them.
        spec_source: The parsed file of the spec; without data where absent or damaged.
        steps: The plan's steps in JSON form.
        events: As logged.
        fits: In order of folder name.
        studies: What the studies found.
        problems: Files that are there but cannot be used.
    """

    path: Path
    status: str
    start: Document
    stop: Document
    recorded: Document
    whole: bool
    plan: Document
    preflight: Document
    verdict: Document
    spec_source: Source
    steps: Sequence[Document]
    events: Sequence[Document]
    fits: tuple[FitFacts, ...]
    studies: StudyFacts
    problems: tuple[str, ...]

    @property
    def spec(self) -> Document:
        """The spec as plain YAML; empty where absent or damaged."""
        return as_object(self.spec_source.data)

    @property
    def name(self) -> str:
        """The experiment's name."""
        return str(self.plan.get("name") or self.spec.get("name") or self.path.name)

    @property
    def run_name(self) -> str:
        """Of the run directory: `hil` finds a run by it, wherever the page was sent to."""
        return self.path.resolve().name

    @property
    def robot(self) -> Document:
        """What `start.json` says about the robot."""
        return as_object(self.start.get("robot"))

    @property
    def robot_title(self) -> str:
        """Model and serial number."""
        identity = as_object(self.robot.get("identity"))
        return " ".join(str(identity[k]) for k in ("model", "serial") if identity.get(k))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """From the plan or the robot; empty when neither says."""
        return as_names(self.plan.get("joint_names") or self.robot.get("joint_names"))

    @property
    def effort_unit(self) -> str:
        """`A` or `N·m`, from what the robot says it measures."""
        return "N·m" if self.robot.get("effort_kind") == "torque" else "A"

    @property
    def rate_hz(self) -> float:
        """Nominal sample rate [Hz]; NaN when the run does not say."""
        return as_float(self.robot.get("rate_hz") or self.plan.get("rate_hz"))

    @property
    def steps_done(self) -> int:
        """How far the program came: the stop document's count, or the last step logged."""
        if isinstance(self.stop.get("steps_done"), int):
            return int(self.stop["steps_done"])
        logged = [e["step"] for e in self.events if isinstance(e.get("step"), int)]
        return max(logged, default=0)

    @property
    def measured(self) -> str:
        """By the data, such as `6 of 24 dwells, 2 of 6 references`; empty when nobody counted."""
        counts = as_object(self.recorded.get("complete")).items()
        return ", ".join(
            f"{as_object(n).get('done')} of {as_object(n).get('of')} "
            f"{PLURALS.get(kind, f'{kind}s')}"
            for kind, n in counts
        )

    @property
    def ended_in(self) -> str:
        """Where a run was when it ended early: `preflight`, or `step 28, dwell at pose 5`."""
        at, states = self.steps_done, [e.get("state") for e in self.events_of("state")]
        if self.status != "completed" and states and "running" not in states:
            return "preflight, before anything moved"
        if self.status == "completed" or self.stop.get("attempt") or not 0 <= at < len(self.steps):
            return ""
        step = self.steps[at]
        pose, trajectory = step.get("pose", -1), step.get("trajectory", -1)
        where = f" at pose {pose}" if pose != -1 else ""
        which = f" {trajectory}" if trajectory != -1 else ""
        return f"step {at + 1}, {step.get('kind')}{which}{where}"

    @property
    def unsettled_steps(self) -> frozenset[int]:
        """Steps whose dwell ran into its time-out."""
        logged = [e.get("step") for e in self.events_of("dwell") if e.get("settled") is False]
        missed = self.stop.get("unsettled", logged)
        return frozenset(step for step in missed if isinstance(step, int))

    @property
    def unsettled(self) -> tuple[int, ...]:
        """Poses at which that happened, as often as it happened."""
        steps = self.steps
        known = sorted(i for i in self.unsettled_steps if 0 <= i < len(steps))
        return tuple(as_index(steps[i].get("pose")) for i in known)

    @property
    def judged_fits(self) -> tuple[FitFacts, ...]:
        """The fits with held-out errors, best first."""
        return best_first(self.fits)

    @property
    def listed_fits(self) -> tuple[FitFacts, ...]:
        """The same in the order of the spec, the one order of a page; others come last."""
        wanted = self.estimators_wanted

        def place(fit: FitFacts) -> tuple[bool, int]:
            named = fit.estimator in wanted
            return not fit.is_honest, wanted.index(fit.estimator) if named else len(wanted)

        return tuple(sorted(self.judged_fits, key=place))

    @property
    def estimators_wanted(self) -> tuple[str, ...]:
        """What the spec asks to be fitted."""
        return tuple(str(fit.get("estimator")) for fit in as_objects(self.spec.get("fit")))

    @property
    def studies_missing(self) -> tuple[str, ...]:
        """What the spec asks to be studied, and was never tried."""
        wanted = [str(entry.get("study")) for entry in as_objects(self.spec.get("study"))]
        return tuple(name for name in wanted if name not in self.studies.known)

    @property
    def commissioning(self) -> str:
        """Which part of the program was to be run, and how fast, in words; empty for all of it."""
        return str(as_object(self.start.get("commissioning")).get("text") or "")

    def events_of(self, kind: str) -> list[Document]:
        """The events of one kind."""
        return [event for event in self.events if event.get("kind") == kind]

    def indices(self, *kinds: str) -> list[int]:
        """Indices of the plan's steps of these kinds."""
        return [i for i, step in enumerate(self.steps) if step.get("kind") in kinds]

    def interlock_limit(self, kind: str, key: str) -> float:
        """The strictest limit of an interlock that watched, defaults included; NaN for none."""
        try:
            watching = load_spec(deepcopy(self.spec_source), look_up=False).interlocks
        except HilError:
            return float("nan")
        limits = (
            getattr(i, key, None)
            for i in watching
            if i.kind == kind and getattr(i, "enabled", True)
        )
        values = [np.min(limit) for limit in limits if limit is not None]
        return float(min(values, default=np.nan))


def read_facts(path: Path) -> RunFacts:
    """Read the small files of a run directory.

    Raises:
        DataError: `path` is not a run directory, or was written by a newer hil.
    """
    if not (path / "start.json").is_file() and not (path / "plan.json").is_file():
        raise DataError(
            f"{path} is not a run directory: it has neither start.json nor plan.json",
            hint="hil runs lists the runs there are",
        )
    problems: list[str] = []
    start = document(path / "start.json", problems)
    run = RunDirectory.open(path) if "hil_run" in start else RunDirectory(path)
    plan_document, plan = plan_of(path / "plan.json", problems)
    whole = is_known(path / "start.json", start, problems) and plan is not None
    stop = document(path / name_of_attempt("stop.json", run.attempts - 1), problems)
    verdict = document(path / "verdict.json", problems)
    rate_hz = as_float(as_object(start.get("robot")).get("rate_hz") or plan_document.get("rate_hz"))
    status = _status(run, problems)
    problems += torn(run)
    return RunFacts(
        path=path,
        status=status,
        start=start,
        stop=stop,
        recorded=recorded_by(run, plan, rate_hz) if status in UNENDED else stop,
        whole=whole,
        plan=plan_document,
        preflight=document(path / "preflight.json", problems),
        verdict=verdict,
        spec_source=yaml_source(path / "spec.yaml", problems),
        steps=as_objects(plan_document.get("steps")),
        events=_events(run, problems),
        fits=with_load_criteria(read_fits(model_folders(path), problems), verdict),
        studies=read_studies(path, problems),
        problems=tuple(problems),
    )


def _status(run: RunDirectory, problems: list[str]) -> str:
    try:
        status = run.status
        return "running" if status == "interrupted" and is_live(run.path) else status
    except DataError as error:
        if error.message not in problems:
            problems.append(error.message)
        return "damaged"


def _events(run: RunDirectory, problems: list[str]) -> list[Document]:
    try:
        problems += run.foreign_events()
        return list(run.events())
    except DataError as error:
        problems.append(error.message)
        return []


def with_load_criteria(fits: Sequence[FitFacts], verdict: Document) -> tuple[FitFacts, ...]:
    """Models with what the verdict of their run says of them under loads."""
    rows = [row for row in as_objects(verdict.get("rows")) if row.get("metric") in UNDER_LOADS]
    return tuple(
        replace(fit, under_loads=[row for row in rows if row.get("estimator") == fit.name])
        for fit in fits
    )


def model_folders(run: Path) -> list[Path]:
    """`fit/<estimator>-<digest>` of every model of a run."""
    path = run / "fit"
    return sorted(item for item in path.iterdir() if item.is_dir()) if path.is_dir() else []


def read_fits(folders: Sequence[Path], problems: list[str]) -> tuple[FitFacts, ...]:
    """The models in some folders; one that was judged on several sources appears once for each."""
    names = [_estimator_of(folder) for folder in folders]
    labels = (
        name if names.count(name) == 1 else folder.name
        for name, folder in zip(names, folders, strict=True)
    )
    pairs = zip(folders, labels, strict=True)
    return tuple(fit for folder, label in pairs for fit in _read(folder, label, problems))


def _read(folder: Path, name: str, problems: list[str]) -> list[FitFacts]:
    evaluation = document(folder / "evaluation.json", problems)
    model = document(folder / "model.json", problems)
    if _protocol(model, evaluation) != HONEST:
        name = f"{name} (paper protocol)"
    sources = as_objects(evaluation.get("validation"))
    if not sources:
        return [FitFacts(folder, name, name, evaluation, model)]
    return [
        FitFacts(
            folder,
            name,
            f"{name} on {short_source(str(one.get('source')))}" if len(sources) > 1 else name,
            {"held_out": {"what": short_source(str(one.get("source"))), **one}},
            model,
        )
        for one in sources
    ]


def best_first(fits: Iterable[FitFacts]) -> tuple[FitFacts, ...]:
    """The fits that have held-out errors, honest ones first, then smallest raw RMSE first."""

    def rank(fit: FitFacts) -> tuple[bool, bool, float]:
        error = fit.mean("rmse_raw")
        return not fit.is_honest, not math.isfinite(error), error

    return tuple(sorted((fit for fit in fits if fit.held_out), key=rank))


def read_studies(run: Path, problems: list[str]) -> StudyFacts:
    """The studies of a run; files that cannot be used are named in `problems`."""
    made = []
    for path in study_files(run):
        try:
            made.append(read_study(path))
        except DataError as error:
            problems.append(error.message)
    failed = [document(path, problems) for path in problem_files(run)]
    return StudyFacts(tuple(made), [problem for problem in failed if problem])


def plan_of(path: Path, problems: list[str]) -> tuple[Document, Plan | None]:
    """The plan as it stands there, and as what it is; None for one that nobody can execute.

    What was found in a passive recording is shown like a plan, and is none.
    """
    if not path.exists():
        return document(path.with_name(FOUND_FILE), problems), None
    told = document(path, problems)
    try:
        return told, read_plan(path)
    except DataError as error:
        if error.message not in problems:
            problems.append(error.message)
        return told, None


def is_known(path: Path, start: Document, problems: list[str]) -> bool:
    """Whether the start document is one; a damaged one is a problem already."""
    if "hil_run" in start:
        return True
    if path.exists() and not any(str(path) in problem for problem in problems):
        problems.append(f"{path} does not say which format it has (hil_run)")
    return False


def torn(run: RunDirectory) -> list[str]:
    """Finished recordings that have lost their end or their beginning, in words."""
    return [
        f"{path.name} is torn although it was finished: hil recover {run.path} makes a whole file "
        "of what is left"
        if has_its_beginning(path)
        else f"{path.name} is no MCAP file any more, its beginning is lost: {hint_of_lost(path)}"
        for path in torn_although_finished(run.recordings)
    ]


_ADDED = ("samples", "gaps", "missing", "duplicates")


def recorded_by(run: RunDirectory, plan: Plan | None, rate_hz: float) -> Document:
    """The part of a stop document that the recordings tell; empty when they tell nothing.

    Args:
        run: Without stop document of its last attempt.
        plan: What was to be measured; None when nobody can say.
        rate_hz: Nominal rate of the samples [Hz].
    """
    total = dict.fromkeys(_ADDED, 0)
    attempts: dict[int, Counts] = {}
    try:
        for path in run.recordings:
            rows = rows_of(path)
            if rows is not None and len(rows):
                attempt = attempt_of(path)
                attempts[attempt] = attempts.get(attempt, Counts()).after(rows, rate_hz)
        complete = completeness_of(plan, run.recordings).to_dict() if plan else {}
    except DataError:
        return {}
    for counts in attempts.values():
        total = {name: n + getattr(counts, name) for name, n in total.items()}
    return {**total, "device_s": recorded_s(run.recordings), "complete": complete}


def document(path: Path, problems: list[str]) -> Document:
    """The JSON object in a file; empty when absent or damaged, the latter added to `problems`."""
    if not path.exists():
        return {}
    try:
        return read_json(path)
    except DataError as error:
        if error.message not in problems:
            problems.append(error.message)
        return {}


def yaml_source(path: Path, problems: list[str]) -> Source:
    """Return the parsed YAML of a file; without data when it is absent or damaged."""
    if not path.is_file():
        return Source(str(path))
    try:
        return read_source(path)
    except SpecError as error:
        problems.append(f"{path} cannot be read: {error.message}")
        return Source(str(path))


def as_object(value: Any) -> Document:
    """A value where an object is expected; anything else is an empty one."""
    return value if isinstance(value, dict) else {}


def as_objects(value: Any) -> Sequence[Document]:
    """The objects of a list; whatever else is in it is left out."""
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def as_float(value: Any) -> float:
    """A value where a number is expected; anything else is NaN."""
    try:
        return float(value) if isinstance(value, int | float) else float("nan")
    except OverflowError:  # a whole number of hundreds of digits
        return float("nan")


def as_index(value: Any, default: int = -1) -> int:
    """A value where a small whole number is expected; anything else is the default."""
    fits = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**31
    return value if fits else default


def as_names(value: Any) -> tuple[str, ...]:
    """A list of names."""
    return tuple(str(item) for item in value) if isinstance(value, list) else ()
