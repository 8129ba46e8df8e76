"""Facts about a run from its small files: documents, plan, events, models and studies.

The function `read_facts` reads these small files once for page, terminal and dashboard. Invalid
files do not raise an error; they are listed in `RunFacts.problems` (see `documents`). For a run
without a stop document, samples and steps are counted from its recordings (`_recorded_by`). The
module `run_recording` reads the samples of a run, and `fit_facts` reads its models.
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
    """Studies of a run.

    Attributes:
        made: Study results in the order of the folder names.
        failed: Problem documents of studies without a current result, with the keys `study`,
            `error` and `hint`.
    """

    made: tuple[StudyResult, ...] = ()
    failed: Sequence[Document] = ()

    @property
    def known(self) -> frozenset[str]:
        """Names of the studies that have a result or failed."""
        tried = (str(problem.get("study")) for problem in self.failed)
        return frozenset({*(result.study for result in self.made), *tried})

    @property
    def warnings(self) -> list[str]:
        """Warnings about failed studies, followed by the warnings in the study results."""
        missing = [
            f"The study {problem.get('study')} failed: "
            + " → ".join(filter(None, (str(problem.get(key) or "") for key in ("error", "hint"))))
            for problem in self.failed
        ]
        left_out = [f"{result.title}: {text}" for result in self.made for text in result.warnings]
        return missing + left_out


PLURALS = {"trajectory": "trajectories", "weigh": "weighings"}


@dataclass(frozen=True, slots=True)
class RunFacts:
    """Content of the small files of a run.

    Attributes:
        path: Path of the run directory.
        status: Status of the run: `completed`, `stopped`, `tripped`, `failed`, `interrupted`,
            `running` or `damaged`.
        start, stop, plan, preflight, verdict: Contents of the JSON documents of the run; empty if
            missing or damaged. The document `stop` is the stop document of the last attempt of the
            run.
        recorded: Counts of samples and steps, from the stop document or, if there is none, from the
            recordings.
        whole: Whether the start document and the plan are valid; otherwise, the run cannot be
            resumed.
        spec_source: Parsed spec file; without data if the file is missing or damaged.
        steps: Steps of the plan in JSON form.
        events: Logged events.
        fits: Summaries of the models in the order of the folder names.
        studies: Results and failures of the studies of the run.
        problems: Messages about files that exist but are invalid.
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
        """Spec of the run as plain YAML data; empty if missing or damaged."""
        return as_object(self.spec_source.data)

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return str(self.plan.get("name") or self.spec.get("name") or self.path.name)

    @property
    def run_name(self) -> str:
        """Name of the run directory, by which hil finds the run from any copy of its page."""
        return self.path.resolve().name

    @property
    def robot(self) -> Document:
        """Section about the robot in `start.json`."""
        return as_object(self.start.get("robot"))

    @property
    def robot_title(self) -> str:
        """Model and serial number of the robot as one text."""
        identity = as_object(self.robot.get("identity"))
        return " ".join(str(identity[k]) for k in ("model", "serial") if identity.get(k))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names from the plan or from the robot; empty if unknown."""
        return as_names(self.plan.get("joint_names") or self.robot.get("joint_names"))

    @property
    def effort_unit(self) -> str:
        """Unit of effort, `A` or `N·m`, according to the measured quantity of the robot."""
        return "N·m" if self.robot.get("effort_kind") == "torque" else "A"

    @property
    def rate_hz(self) -> float:
        """Nominal sample rate [Hz]; NaN if unknown."""
        return as_float(self.robot.get("rate_hz") or self.plan.get("rate_hz"))

    @property
    def steps_done(self) -> int:
        """Number of completed steps: from the stop document, or the last logged step."""
        if isinstance(self.stop.get("steps_done"), int):
            return int(self.stop["steps_done"])
        logged = [e["step"] for e in self.events if isinstance(e.get("step"), int)]
        return max(logged, default=0)

    @property
    def measured(self) -> str:
        """Text about the completed measurements, such as `6 of 24 dwells`; empty if unknown."""
        counts = as_object(self.recorded.get("complete")).items()
        return ", ".join(
            f"{as_object(n).get('done')} of {as_object(n).get('of')} "
            f"{PLURALS.get(kind, f'{kind}s')}"
            for kind, n in counts
        )

    @property
    def ended_in(self) -> str:
        """Phase or step in which a run ended early, such as `step 28, dwell at pose 5`.

        The text is empty if the run was completed.
        """
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
        """Indices of the steps whose dwell reached its time-out before the arm settled."""
        logged = [e.get("step") for e in self.events_of("dwell") if e.get("settled") is False]
        missed = self.stop.get("unsettled", logged)
        return frozenset(step for step in missed if isinstance(step, int))

    @property
    def unsettled(self) -> tuple[int, ...]:
        """Pose numbers of the unsettled dwells; a pose occurs one time for each unsettled dwell."""
        steps = self.steps
        known = sorted(i for i in self.unsettled_steps if 0 <= i < len(steps))
        return tuple(as_index(steps[i].get("pose")) for i in known)

    @property
    def judged_fits(self) -> tuple[FitFacts, ...]:
        """Fits with held-out errors, ordered from best to worst."""
        return best_first(self.fits)

    @property
    def listed_fits(self) -> tuple[FitFacts, ...]:
        """Fits with held-out errors in the order of the spec; fits outside the spec come last.

        All lists of models in a page use the order of this property. Fits that do not follow the
        honest protocol come last.
        """
        wanted = self.estimators_wanted

        def place(fit: FitFacts) -> tuple[bool, int]:
            named = fit.estimator in wanted
            return not fit.is_honest, wanted.index(fit.estimator) if named else len(wanted)

        return tuple(sorted(self.judged_fits, key=place))

    @property
    def estimators_wanted(self) -> tuple[str, ...]:
        """Names of the estimators that the spec requests."""
        return tuple(str(fit.get("estimator")) for fit in as_objects(self.spec.get("fit")))

    @property
    def is_dwell_program(self) -> bool:
        """Whether the spec requests static poses instead of trajectories."""
        return as_object(self.spec.get("excitation")).get("kind") == "dwell"

    @property
    def studies_missing(self) -> tuple[str, ...]:
        """Names of the studies that the spec requests and that were never started."""
        wanted = [str(entry.get("study")) for entry in as_objects(self.spec.get("study"))]
        return tuple(name for name in wanted if name not in self.studies.known)

    @property
    def commissioning(self) -> str:
        """Text on part of the program and speed of a commissioning run; empty for other runs."""
        return str(as_object(self.start.get("commissioning")).get("text") or "")

    def events_of(self, kind: str) -> list[Document]:
        """Return the events of one kind in the order of the log."""
        return [event for event in self.events if event.get("kind") == kind]

    def indices(self, *kinds: str) -> list[int]:
        """Return the indices of the plan steps of certain kinds."""
        return [i for i, step in enumerate(self.steps) if step.get("kind") in kinds]

    def interlock_limit(self, kind: str, key: str) -> float:
        """Return the strictest limit of all enabled interlocks of a kind, defaults included.

        NaN is returned if no interlock of this kind is enabled.
        """
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
"""Possible statuses of a run whose last attempt has no stop document."""


def read_facts(path: Path) -> RunFacts:
    """Read the small files of a run directory.

    Raises:
        DataError: The path is not a run directory, or the run was written by a newer version of
            hil.
    """
    if not (path / "start.json").is_file() and not (path / "plan.json").is_file():
        raise DataError(
            f"{path} is not a run directory: it has neither start.json nor plan.json",
            hint="list the runs: hil runs",
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
"""Metrics of the acceptance criteria about payloads, which are evaluated for all models
together.
"""


def _with_load_criteria(fits: Sequence[FitFacts], verdict: Document) -> tuple[FitFacts, ...]:
    """Return the models, supplemented by the verdict rows about payloads."""
    rows = [row for row in as_objects(verdict.get("rows")) if row.get("metric") in UNDER_LOADS]
    return tuple(
        replace(fit, under_loads=[row for row in rows if row.get("estimator") == fit.name])
        for fit in fits
    )


def read_studies(run: Path, problems: list[str]) -> StudyFacts:
    """Return the study results of a run; messages about invalid files are added to `problems`."""
    made = []
    for path in study_files(run):
        try:
            made.append(read_study(path))
        except DataError as error:
            problems.append(error.message)
    failed = [document(path, problems) for path in problem_files(run)]
    return StudyFacts(tuple(made), [problem for problem in failed if problem])


def _plan_of(path: Path, problems: list[str]) -> tuple[Document, Plan | None]:
    """Return the plan as JSON and as a `Plan`, which is None if the plan cannot be executed.

    The motions that were detected in a passive recording are returned as JSON only.
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
    """Return whether the start document has a known format; if not, add a problem.

    A damaged start document has already been added to the problems.
    """
    if "hil_run" in start:
        return True
    if path.exists() and not any(str(path) in problem for problem in problems):
        problems.append(f"{path} lacks its format version (hil_run)")
    return False


def torn(run: RunDirectory) -> list[str]:
    """Return messages about finished recordings whose end or beginning is lost."""
    return [
        f"{path.name} was finished but is truncated: hil recover {run.path} writes a complete file "
        "from the remaining samples"
        if has_its_beginning(path)
        else f"the beginning of {path.name} is lost, so that it is not an MCAP file any more: "
        f"{hint_of_lost(path)}"
        for path in torn_although_finished(run.recordings)
    ]


_ADDED = ("samples", "gaps", "missing", "duplicates")


def _recorded_by(run: RunDirectory, plan: Plan | None, rate_hz: float) -> Document:
    """Return the counts of a stop document, determined from the recordings; empty if unreadable.

    Args:
        run: Run directory without a stop document of the last attempt.
        plan: Plan of the run; None if the plan is unknown.
        rate_hz: Nominal sample rate [Hz].
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
