"""What a run says about itself in its small files: documents, plan, events, models, studies.

`read_facts` gathers them once for page, terminal and dashboard. Reading is lenient (`documents`):
files that cannot be used become `RunFacts.problems`. Of a run without stop document, samples and
steps are counted by its recordings (`_recorded_by`). Samples are read by `run_recording`, models
by `fit_facts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hil.core import DataError, HilError, Source, is_live
from hil.importers import PASSIVE_PLAN_FILE, completeness_of, recorded_rows
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
from hil.report.documents import (
    Document,
    as_float,
    as_index,
    as_names,
    as_object,
    as_objects,
    document,
    yaml_source,
)
from hil.report.fit_facts import FitFacts, best_first, model_folders, read_fits
from hil.spec import load_spec
from hil.studies import StudyResult, problem_files, read_study, study_files


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
        left_out = [f"{result.title}: {text}" for result in self.made for text in result.warnings]
        return missing + left_out


PLURALS = {"trajectory": "trajectories", "weigh": "weighings"}


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
    def is_dwell_program(self) -> bool:
        """Whether the spec asks for static poses, not for trajectories."""
        return as_object(self.spec.get("excitation")).get("kind") == "dwell"

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


UNENDED = ("interrupted", "running")
"""Status of a run whose last attempt has no stop document."""


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
    plan_document, plan = _plan_of(path / "plan.json", problems)
    whole = _is_known(path / "start.json", start, problems) and plan is not None
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
        recorded=_recorded_by(run, plan, rate_hz) if status in UNENDED else stop,
        whole=whole,
        plan=plan_document,
        preflight=document(path / "preflight.json", problems),
        verdict=verdict,
        spec_source=yaml_source(path / "spec.yaml", problems),
        steps=as_objects(plan_document.get("steps")),
        events=_events(run, problems),
        fits=_with_load_criteria(read_fits(model_folders(path), problems), verdict),
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


UNDER_LOADS = ("load_error_ratio", "contradicted_loads")
"""Criteria about loads, judged on all models at once."""


def _with_load_criteria(fits: Sequence[FitFacts], verdict: Document) -> tuple[FitFacts, ...]:
    """Models with what the verdict of their run says of them under loads."""
    rows = [row for row in as_objects(verdict.get("rows")) if row.get("metric") in UNDER_LOADS]
    return tuple(
        replace(fit, under_loads=[row for row in rows if row.get("estimator") == fit.name])
        for fit in fits
    )


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


def _plan_of(path: Path, problems: list[str]) -> tuple[Document, Plan | None]:
    """The plan as JSON, and as a `Plan`; None for one that cannot be executed.

    What was found in a passive recording is shown like a plan, and is none.
    """
    if not path.exists():
        return document(path.with_name(PASSIVE_PLAN_FILE), problems), None
    content = document(path, problems)
    try:
        return content, read_plan(path)
    except DataError as error:
        if error.message not in problems:
            problems.append(error.message)
        return content, None


def _is_known(path: Path, start: Document, problems: list[str]) -> bool:
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


def _recorded_by(run: RunDirectory, plan: Plan | None, rate_hz: float) -> Document:
    """The counts of a stop document, taken from the recordings; empty when none can be read.

    Args:
        run: Without stop document of its last attempt.
        plan: What was to be measured; None when nobody can say.
        rate_hz: Nominal rate of the samples [Hz].
    """
    total = dict.fromkeys(_ADDED, 0)
    attempts: dict[int, Counts] = {}
    try:
        for path in run.recordings:
            rows = recorded_rows(path)
            if rows is not None and len(rows):
                attempt = attempt_of(path)
                attempts[attempt] = attempts.get(attempt, Counts()).after(rows, rate_hz)
        complete = completeness_of(plan, run.recordings).to_dict() if plan else {}
    except DataError:
        return {}
    for counts in attempts.values():
        total = {name: n + getattr(counts, name) for name, n in total.items()}
    return {**total, "device_s": recorded_s(run.recordings), "complete": complete}
