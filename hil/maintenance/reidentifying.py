"""Re-identification, the work of a schedule: probe a robot, and identify it anew after a change.

    begin → probe → drift → campaign → fit → register → check → challenge → summary

A stage of the re-identification may be repeated after a crash. Each stage therefore first checks
whether its side effects already exist. The start document of a run names the occasion before the
robot moves. A complete run of the occasion is therefore reused, and an interrupted run is resumed.
A registered version is recognised by the digest of its model. A decision is recognised in the
registry's log, because its reason begins with the name of the occasion.

If the robot has not changed, champion and challenger are compared on probes of earlier weeks, too.
A comparison on one day is valid for that day only, because the champion may be better at a
different room temperature.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import (
    AnyPath,
    DataError,
    FitError,
    HilError,
    RobotError,
    Stopped,
    exit_code_of,
    path_of,
    read_json,
)
from hil.engine import Observer, nobody_goes_on
from hil.estimators import HONEST, models_below
from hil.evaluation import evaluate, usable_part
from hil.importers import load_source
from hil.maintenance.binding import Bound, bind, bind_file, not_honest
from hil.maintenance.ledger import Job, Ledger, Occasion, Work, occasion_of, open_ledger
from hil.maintenance.stages import Document, Stage, run_stages, stored_result
from hil.models import Entry, Registry, assess, challenge, facts_of, probes_of
from hil.planning import Experiment, held, opened
from hil.recording import RunDirectory, recordings_in, run_folders, utc_now
from hil.report import render_report
from hil.robot import address_of
from hil.spec import ScheduleSpec, StudyEntry, spec_hash
from hil.workflow import (
    Confirm,
    Console,
    ConsoleOperator,
    OperatorChannel,
    RunReport,
    Unconfirmed,
    describe_robot,
    missing_studies,
    require_armed,
    require_extras,
    require_same_robot,
    run_studies,
    whole,
)
from hil.workflow import resume as resume_experiment
from hil.workflow import run as run_experiment

if TYPE_CHECKING:
    from hil.evaluation import Evaluation


STATES = Path("schedules")
"""Default folder of schedule states, with one subfolder per schedule."""

BY_HAND = "by-hand"
"""Name of the subfolder of a schedule's state that contains the occasions of `hil reidentify`."""


def reidentify(
    schedule: AnyPath,
    *,
    station: AnyPath | None = None,
    runs: AnyPath = "runs",
    registry: AnyPath = "registry",
    state: AnyPath | None = None,
    campaign: bool = False,
    observers: Sequence[Observer] = (),
    tell: Callable[[str], object] | None = None,
) -> dict[str, Any]:
    """Do the work of a schedule now, exactly one time, or continue it after a recent interruption.

    Args:
        schedule: Schedule file.
        station: Station file that replaces the station of the schedule; None for the station of the
            schedule.
        runs: Folder of run directories.
        registry: Folder of the registry with the champion; challengers are registered in this
            registry.
        state: Folder of the schedule's state; None for `schedules/NAME`.
        campaign: Flag; if true, the campaign runs regardless of the result of the probe.
        observers: Receivers of progress events of the runs; each receiver is called on a separate
            thread.
        tell: Callback that receives a short text at the beginning of each stage.

    Returns:
        Mapping with the keys `outcome` (`quiet`, `drift`, `promoted`, `kept`), `text`, `name`,
        `champion`, `before`, `challenger`, `drift`, `decision`, `errors`, `runs`, `folder`: see
        docs/reference/files.md.

    Raises:
        SpecError: The schedule or a file named in it has problems; the message lists all of them.
        DataError: A different process is running the same schedule, or the schedule is held.
        HilError: A stage failed; the next call continues with that stage.
    """
    file, at = path_of(schedule), path_of(station) if station else None
    bound = bind_file(file, at)
    for experiment in bound.experiments:
        require_extras(experiment.spec)
    of_schedule = path_of(state) if state else STATES / bound.spec.name
    confirm = require_armed(bound.moves(file), of_schedule)
    if hold := Ledger.read(of_schedule).standing.held:
        raise DataError(
            f"the schedule {bound.spec.name} is held: {hold['why']}",
            hint=f"after you have removed the cause: hil schedule release {file} --reason TEXT",
        )
    job: Job = "campaign" if campaign or bound.probe is None else "probe"
    home = of_schedule / BY_HAND
    report = tell or (lambda text: None)
    work = reidentification(
        bound.spec, registry=Registry(path_of(registry)), runs=path_of(runs), station=at,
        observers=observers, confirm=confirm, tell=lambda stage: report(f"stage: {stage}"),
    )  # fmt: skip
    with open_ledger(home, bound.spec.name):
        occasion = _interrupted_occasion(home, job, bound.spec.missed_within)
        if occasion is not None:
            report(f"continuing {home / occasion.id}")
        occasion = occasion or _new_occasion(home, job)
        return dict(work(occasion, home / occasion.id)) | {"folder": str(home / occasion.id)}


def _interrupted_occasion(home: Path, job: Job, within: timedelta) -> Occasion | None:
    """Return the newest occasion of a job if this occasion was interrupted recently, or None.

    An occasion older than `within` is not continued, because the robot may have changed since.
    """
    for folder in sorted(home.glob(f"*-{job}"), reverse=True)[:1]:
        newest = occasion_of(folder.name)
        if stored_result(folder, "summary") is None and newest.due >= datetime.now(UTC) - within:
            return newest
    return None


def _new_occasion(home: Path, job: Job) -> Occasion:
    """Return an occasion that is due now, or at the next second that has no occasion yet.

    Each occasion has a separate folder for its results.
    """
    occasion = Occasion(datetime.now(UTC).replace(microsecond=0), job)
    while (home / occasion.id).exists():
        occasion = Occasion(occasion.due + timedelta(seconds=1), job)
    return occasion


Adapt = Callable[[Experiment, Occasion, str], Experiment]
"""Function that adapts an experiment to an occasion and a stage.

The stage that is passed is `probe`, `campaign` or `check`.
"""


def as_it_is(experiment: Experiment, occasion: Occasion, stage: str) -> Experiment:
    """Return the experiment unchanged."""
    return experiment


def reidentification(
    spec: ScheduleSpec,
    *,
    registry: Registry,
    runs: Path,
    station: Path | None = None,
    adapt: Adapt = as_it_is,
    observers: Sequence[Observer] = (),
    confirm: Confirm | None = None,
    tell: Callable[[str], object] = lambda stage: None,
) -> Work:
    """Return the function object that does the work of a schedule.

    Args:
        spec: Content of the schedule file, from `load_schedule_spec`.
        registry: Registry with the champion; challengers are registered in this registry.
        runs: Folder of run directories.
        station: Station file that replaces the station of the schedule; None for the station of the
            schedule.
        adapt: Function that changes an experiment for an occasion, used by simulations; see
            `with_options`.
        observers: Receivers of progress events of the runs.
        confirm: Confirmation that a real robot may move; without it, real robots must not move.
        tell: Callback that receives the name of each stage that is not skipped, when the stage
            begins.

    Returns:
        A `Work`. The result of the returned function has the keys `outcome` (`quiet`, `drift`,
        `promoted`, `kept`), `text`, `name`, `champion` and `before` (labels of versions, or null),
        `challenger`, `drift`, `decision`, `errors` and `runs`; see docs/reference/files.md.

    Raises:
        SpecError: The schedule or a file named in it has problems; the message lists all of them.
        PluginError: A robot driver is missing or cannot be loaded.
    """
    wait_s, may_move = spec.wait_for_robot.total_seconds(), confirm or Unconfirmed()
    measuring = Measuring(runs, wait_s, tuple(observers), confirm=may_move)
    return Reidentification(bind(spec, station), registry, measuring, adapt, tell)


@dataclass(frozen=True, slots=True)
class Reidentification:
    """Function object that does the work of a bound schedule; see `reidentification`.

    Attributes:
        bound: Schedule with its loaded experiments.
        registry: Registry with the models of the schedule.
        measuring: Unattended runs.
        adapt: Function that changes an experiment for an occasion.
        tell: Callback that receives the name of each stage that is not skipped, when the stage
            begins.
    """

    bound: Bound
    registry: Registry
    measuring: Measuring
    adapt: Adapt
    tell: Callable[[str], object]

    def __call__(self, occasion: Occasion, folder: Path) -> Document:
        """Do the remaining stages of an occasion; see `hil.maintenance.ledger.Work`."""
        stages = OccasionStages(
            self.bound, self.registry, self.measuring, self.adapt, occasion, self.tell
        )
        return run_stages(stages.all(), folder)["summary"]


Results = Mapping[str, Document]
"""Results of the previous stages of an occasion, by stage name."""

SKIPPED = "skipped"
"""Key in the result of a skipped stage; its value is the reason for skipping it."""


@dataclass(frozen=True, slots=True)
class OccasionStages:
    """Stages of the work of one occasion.

    Attributes:
        bound: Schedule with its loaded experiments.
        registry: Registry with the models of the schedule.
        measuring: Unattended runs.
        adapt: Function that changes an experiment for an occasion.
        occasion: Occasion whose stages are done.
        tell: Callback that receives the name of each stage that is not skipped, when the stage
            begins.
    """

    bound: Bound
    registry: Registry
    measuring: Measuring
    adapt: Adapt
    occasion: Occasion
    tell: Callable[[str], object] = lambda stage: None

    def all(self) -> list[Stage]:
        """Return the stages in order; each stage depends on the stages whose results it uses."""
        bound = self.bound
        campaign = {"spec": spec_hash(bound.campaign.spec)}
        probe = {"spec": bound.probe and spec_hash(bound.probe.spec)}
        fit = {"estimator": bound.fit.estimator, "parameters": bound.fit.parameters}
        return [
            Stage("begin", self.begin, (), {"occasion": self.key, "model": bound.name}),
            Stage("probe", self.probe, ("begin",), probe),
            Stage("drift", self.drift, ("begin", "probe"), {"false_alarm": bound.spec.false_alarm}),
            Stage(
                "campaign", self.campaign, ("begin", "drift"),
                campaign | {"on_drift": bound.spec.campaign.on_drift},
            ),
            Stage("fit", self.fit, ("campaign",), fit),
            Stage("register", self.register, ("fit",), {"name": bound.name}),
            Stage("check", self.check, ("begin", "fit"), probe),
            Stage(
                "challenge", self.challenge,
                ("begin", "probe", "drift", "campaign", "fit", "register", "check"),
            ),
            Stage(
                "summary", self.summary,
                ("begin", "probe", "drift", "campaign", "fit", "register", "check", "challenge"),
            ),
        ]  # fmt: skip

    @property
    def key(self) -> str:
        """Name of the occasion, as used in runs and in the registry's log."""
        return f"{self.bound.spec.name}/{self.occasion.id}"

    def begin(self, results: Results) -> Document:
        """Store the current champion, so later promotions do not affect the comparison."""
        registry, name = self.registry, self.bound.name
        champion = registry.aliases(name).champion if name in registry.names() else 0
        return {"begun": utc_now(), "champion": champion or None}

    def probe(self, results: Results) -> Document:
        """Run the probe."""
        if self.bound.probe is None:
            return {SKIPPED: "the schedule has no probe"}
        if results["begin"]["champion"] is None:
            return {SKIPPED: "there is no champion to compare with"}
        return {"run": self._measured(self.bound.probe, "probe")}

    def drift(self, results: Results) -> Document:
        """Check whether the probe shows a change of the robot, and determine the causes."""
        if SKIPPED in results["probe"]:
            return results["probe"]
        self.tell("drift")
        bound = self.bound
        run, alarm = Path(results["probe"]["run"]), bound.spec.false_alarm
        champion = f"v{results['begin']['champion']}"
        probe = assess(self.registry, bound.name, run, false_alarm=alarm, champion=champion)
        document = probe.to_dict()
        del document["features"]  # too long; stored in the history of the registry
        return document

    def campaign(self, results: Results) -> Document:
        """Run the campaign if it is due, or if the probe shows a change."""
        bound, changed = self.bound, bool(results["drift"].get("changed"))
        if self.occasion.job == "campaign":
            why = "it is due"
        elif results["begin"]["champion"] is None:
            why = "first campaign"
        elif changed and bound.spec.campaign.on_drift:
            why = str(results["drift"]["text"])
        else:
            return {
                SKIPPED: "change reported only, because on_drift is false"
                if changed
                else "nothing changed"
            }
        return {"why": why, "run": self._measured(bound.campaign, "campaign")}

    def fit(self, results: Results) -> Document:
        """Return the model that the campaign's run has fitted, with the criteria of its spec."""
        if SKIPPED in results["campaign"]:
            return results["campaign"]
        self.tell("fit")
        run, name = Path(results["campaign"]["run"]), self.bound.fit.estimator
        folders = [one for one in models_below(run) if one.name.rpartition("-")[0] == name]
        verdict = read_json(run / "verdict.json")
        if not folders:
            why = [one["error"] for one in verdict["problems"] if one["estimator"] in (name, "")]
            raise FitError(
                f"{run} has no model of {name}: {'; '.join(why) or 'it was removed'}",
                hint=f"see: hil show {run}",
            )
        model = max(folders, key=lambda folder: (folder / "evaluation.json").stat().st_mtime_ns)
        evaluation = read_json(model / "evaluation.json")
        if evaluation["protocol"] != HONEST:
            raise FitError(not_honest(name, evaluation["protocol"]), hint=f"see: hil show {run}")
        held_out = evaluation["held_out"]
        keys = ("what", "unit", "joint_names", "total")
        rows = [row for row in verdict["rows"] if row["estimator"] in (name, "")]
        return {
            "model": str(model),
            "held_out": {key: held_out[key] for key in keys},
            "criteria": rows,
        }

    def register(self, results: Results) -> Document:
        """Register the model as a version, and as challenger unless a decision already exists."""
        if SKIPPED in results["fit"]:
            return results["fit"]
        self.tell("register")
        model, name = Path(results["fit"]["model"]), self.bound.name
        facts, registry = facts_of(model), self.registry
        version = registry.register(name, model, facts)
        if decision_in_log(registry, name, self.key, version.number) is None:
            registry.register(name, model, facts, challenger=True)
        return {"version": version.number, "digest": version.digest}

    def check(self, results: Results) -> Document:
        """Run the probe again, to have data from before and after the campaign."""
        if SKIPPED in results["fit"]:
            return results["fit"]
        if self.bound.probe is None or results["begin"]["champion"] is None:
            return {SKIPPED: "there is no champion to compare with, or the schedule has no probe"}
        return {"run": self._measured(self.bound.probe, "check")}

    def challenge(self, results: Results) -> Document:
        """Promote the version or retain the champion by the registry's rules, exactly one time."""
        if SKIPPED in results["register"]:
            return results["register"]
        self.tell("challenge")
        decision = Decision(self.registry, self.bound.name, self.key, results).take()
        return decision | {"champion": self.registry.aliases(self.bound.name).champion or None}

    def summary(self, results: Results) -> Document:
        """Return the result of the occasion, for the ledger and for notifications."""
        errors = errors_on(self.registry, self.bound.name, results)
        return summary(self.bound.name, results, errors)

    def _measured(self, experiment: Experiment, stage: str) -> str:
        self.tell(stage)
        adapted = self.adapt(experiment, self.occasion, stage)
        return str(self.measuring.measure(adapted, f"{self.key}/{stage}").resolve())


@dataclass(frozen=True, slots=True)
class Measuring:
    """Executor of unattended runs of experiments.

    Attributes:
        runs: Folder of run directories.
        wait_s: Maximum time to wait for a robot that a different process has leased [s].
        observers: Receivers of progress events of the runs.
        operator: Operator to record in the runs; empty for the user of this process.
        confirm: Confirmation that a real robot may move; without it, real robots must not move.
    """

    runs: Path
    wait_s: float = 0.0
    observers: Sequence[Observer] = ()
    operator: str = ""
    confirm: Confirm = field(default_factory=Unconfirmed)

    def measure(self, experiment: Experiment, occasion: str) -> Path:
        """Return the run of an occasion: a complete run, a resumed run, or a new run.

        Args:
            experiment: Experiment to run.
            occasion: Name of the occasion, unique among all runs with the spec of `experiment`.

        Returns:
            Run directory that contains a complete recording and a verdict.

        Raises:
            NotConfirmed: Moving a real robot is not allowed, or the confirmation was withdrawn.
            RobotError: The run of this occasion ended early, but not by a crash or a signal. After
                such an error, an operator must inspect the robot before the arm moves again.
            HilError: The run cannot be started, or it ended early.
        """
        run = run_of(self.runs, experiment, occasion)
        if run is None:
            experiment = replace(experiment, occasion=occasion)
            return self._judged(run_experiment(experiment, runs=self.runs, **self._attendance()))
        # With a verdict, the measurement is complete, even if a later step failed.
        if RunDirectory(run).is_judged:
            self._require_same_robot(run, experiment)
            _complete_views(run, experiment.spec.study)
            return run
        _require_harmless_end(run)
        self._require_confirmed(experiment)
        return self._judged(resume_experiment(run, **self._attendance()))

    def _attendance(self) -> dict[str, Any]:
        operator = ConsoleOperator(console=_NoConsole())
        desk = OperatorChannel(operator, nobody_goes_on, self.wait_s, self.confirm)
        return {"desk": desk, "observers": self.observers, "operator": self.operator}

    def _require_same_robot(self, run: Path, experiment: Experiment) -> None:
        """Raise if the connected arm differs from the arm of the run."""
        with held(experiment, wait_s=self.wait_s, report=lambda text: None) as (robot, _):
            require_same_robot(RunDirectory.open(run), describe_robot(robot, experiment.robot))

    def _require_confirmed(self, experiment: Experiment) -> None:
        """Raise if the confirmation recorded at the start of the run is no longer valid.

        The confirmation of a run would also cover its remainder, but the schedule may have been
        disarmed after the start of the run.
        """
        name = experiment.spec.robot
        with opened(name, experiment.robot) as robot:
            at = address_of(robot)
        if at.real:
            self.confirm.admit(name, at.text)

    def _judged(self, report: RunReport) -> Path:
        if not RunDirectory(report.run).is_judged:
            message = f"{report.run} ended early: {report.outcome}"
            raise report.error or RobotError(message, hint=f"see: hil show {report.run}")
        return report.run


class _NoConsole(Console):
    """Console without an operator, used even if the scheduler was started in a terminal."""

    @property
    def present(self) -> bool:
        """Always False."""
        return False


def run_of(runs: Path, experiment: Experiment, occasion: str) -> Path | None:
    """Return the run of an occasion with the same spec at the same station, or None.

    The spec and the station are compared because schedules with the same name may share a folder of
    runs and may be due at the same time on two robots.
    """
    quoted = json.dumps(occasion, ensure_ascii=False).encode()
    facts = {
        "occasion": occasion,
        "spec_hash": spec_hash(experiment.spec),
        "station": whole(experiment.station_source),
    }
    for path in reversed(run_folders(runs)):
        try:
            raw = (path / "start.json").read_bytes()
            start = json.loads(raw) if quoted in raw else {}  # avoids parsing thousands of files
            station = (path / "station.yaml").read_text("utf-8")
        except (OSError, ValueError):
            continue
        if station == experiment.station_text and facts.items() <= start.items():
            return path
    return None


def _require_harmless_end(run: Path) -> None:
    """Raise unless an unfinished run ended by a crash, by a signal or after all of its motion."""
    directory = RunDirectory.open(run)
    stop = directory.stop
    if stop is None:
        ending = _ending_by_events(directory.events())
    elif stop.get("outcome") == "completed" or stop.get("exit_code") == BY_SIGNAL:
        ending = ""
    else:
        ending = f"{stop.get('outcome')}: {stop.get('reason')}"
    if ending:
        raise RobotError(
            f"{run} was {ending}",
            hint=f"inspect the robot, then resume the run: hil resume {run}",
        )


BY_SIGNAL = exit_code_of(Stopped("", by_signal=True))


def _ending_by_events(events: Sequence[Mapping[str, Any]]) -> str:
    """Return the reason for a stop during which the process died; empty if there was none."""
    ending = ""
    for event in events:
        if event["kind"] in ("trip", "hung"):
            ending = f"tripped: {event.get('reason')}"
        elif event.get("state") == "preflight":  # a later attempt, resumed by an operator
            ending = ""
        elif event.get("state") == "stopping" and event.get("reason"):
            ending = ending or ("" if event.get("by_signal") else f"stopped: {event['reason']}")
    return ending


def _complete_views(run: Path, entries: Sequence[StudyEntry]) -> None:
    """Create the missing studies and report of a run whose process died after the verdict."""
    if RunDirectory(run).is_reported:
        return
    with contextlib.suppress(HilError):  # a study that fails does not invalidate the run
        run_studies(run, missing_studies(run, entries))
    with contextlib.suppress(HilError):
        render_report(run)


def decision_in_log(registry: Registry, name: str, key: str, number: int) -> Entry | None:
    """Return the decision of an occasion about a version from the registry's log, or else None.

    Args:
        registry: Registry that contains the version.
        name: Name of the model.
        key: Name of the occasion.
        number: Number of the version.
    """
    entries = (one for one in reversed(registry.log(name)) if one.event in ("promoted", "kept"))
    mine = (one for one in entries if one.version == number and one.reason.startswith(key))
    return next(mine, None)


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision about the model that an occasion identified.

    Attributes:
        registry: Registry that contains the version of the model.
        name: Name of the model.
        key: Name of the occasion.
        results: Results of the previous stages of the occasion.
    """

    registry: Registry
    name: str
    key: str
    results: Results

    @property
    def number(self) -> int:
        """Version number of the challenger."""
        return int(self.results["register"]["version"])

    @property
    def before(self) -> int:
        """Version number of the champion at the beginning of the occasion, 0 for no champion."""
        return int(self.results["begin"]["champion"] or 0)

    def take(self) -> Document:
        """Decide unless a decision is logged; return `promoted`, `reason` and `evidence`."""
        if self.number == self.before:
            return {"promoted": False, "reason": "it is the champion already", "evidence": {}}
        about = (self.registry, self.name, self.key, self.number)
        if (entry := decision_in_log(*about)) is None:
            self._decide()
            entry = decision_in_log(*about)
        if entry is None:
            return {
                "promoted": False,
                "reason": "it has become champion in the meantime",
                "evidence": {},
            }
        reason = entry.reason.removeprefix(self.key).lstrip(" :")
        promoted = entry.event == "promoted"
        return {"promoted": promoted, "reason": reason, "evidence": dict(entry.evidence)}

    def _decide(self) -> None:
        criteria = self.results["fit"]["criteria"]
        now = self.registry.aliases(self.name).champion
        if missed := [row for row in criteria if not row["passed"]]:
            row = missed[0]
            first = f"{row['metric']} of {row['what']} is {row['value']}, at most {row['max']:g}"
            words = f"{len(missed)} criteria of the campaign are not met: {first}"
            self._keep(words, criteria=missed)
        elif now not in (self.before, self.number):
            instead = f" instead of v{self.before}" if self.before else ""
            self._keep(f"v{now} has become champion{instead} in the meantime")
        elif self.before:
            self._challenge()
        else:
            words = "it meets its criteria" if criteria else "there are no criteria"
            evidence = {"criteria": criteria}
            self.registry.promote(
                self.name, self.number, reason=f"{self._why}: {words}", evidence=evidence,
                instead_of=0,
            )  # fmt: skip

    def _challenge(self) -> None:
        """Compare challenger and champion without criteria; only the campaign has to meet them."""
        results = self.results
        runs = [results[stage].get("run") for stage in ("campaign", "probe", "check")]
        earlier: list[Path] = []
        if results["drift"].get("changed") is False:
            earlier = earlier_probes(self.registry, self.name, Path(results["probe"]["run"]))
        challenge(
            self.registry, self.name, f"v{self.number}", [Path(run) for run in runs if run],
            reason=self._why, earlier=earlier,
        )  # fmt: skip

    def _keep(self, words: str, **evidence: object) -> None:
        reason = f"{self._why}: {words}"
        self.registry.keep(self.name, self.number, reason=reason, evidence=evidence)

    @property
    def _why(self) -> str:
        return f"{self.key}: {self.results['campaign']['why']}"


MOST = 5


def earlier_probes(registry: Registry, name: str, run: Path) -> list[Path]:
    """Return up to `MOST` probes before the current one that show no change.

    Args:
        registry: Registry with the history of probes.
        name: Name of the model.
        run: Run of the current probe, which shows no change.

    Returns:
        Earlier probes whose recordings still exist, newest first.

    Raises:
        RegistryError: The history of probes is damaged.
    """
    # A probe has one line per champion; it counts as changed if any of these lines reports a
    # change.
    lines = sorted(probes_of(registry, name), key=lambda one: one.changed)
    by_uid = {one.uid: one for one in lines}
    sources: list[Path] = []
    for probe in sorted(by_uid.values(), key=lambda one: one.at, reverse=True):
        if probe.changed or len(sources) == MOST:
            break
        source = Path(probe.source)
        if source.resolve() != run.resolve() and _has_recording(source):
            sources.append(source)
    return sources


def _has_recording(source: Path) -> bool:
    """Return whether a run or a recording still exists, neither pruned nor moved."""
    folder = source / "recording"
    return source.is_file() or (folder.is_dir() and bool(recordings_in(folder)))


def summary(name: str, results: Results, errors: Document | None) -> Document:
    """Return the result of `Work`, composed from the results of the previous stages.

    Args:
        name: Name of the model in the registry.
        results: Results of the previous stages of the occasion.
        errors: RMSE of the champions, as returned by `errors_on`.
    """
    drift = results["drift"] if "changed" in results["drift"] else None
    decision = results["challenge"] if "promoted" in results["challenge"] else None
    before, challenger = results["begin"]["champion"], results["register"].get("version")
    champion = decision["champion"] if decision else before
    runs = {stage: results[stage].get("run") for stage in ("probe", "campaign", "check")}
    return {
        "outcome": _outcome(drift, decision),
        "text": _text(drift, decision, challenger),
        "name": name,
        "begun": results["begin"]["begun"],
        "before": _label(before),
        "champion": _label(champion),
        "challenger": _label(challenger),
        "drift": drift,
        "decision": decision,
        "held_out": results["fit"].get("held_out"),
        "errors": errors,
        "runs": {stage: run for stage, run in runs.items() if run},
    }


def _outcome(drift: Document | None, decision: Document | None) -> str:
    if decision is not None:
        return "promoted" if decision["promoted"] else "kept"
    return "drift" if drift and drift["changed"] else "quiet"


def _text(drift: Document | None, decision: Document | None, challenger: int | None) -> str:
    if decision is None:
        return str(drift["text"]) if drift else "nothing was due"
    if decision["promoted"]:
        return f"{_label(challenger)} is champion: {decision['reason']}"
    champion = decision["champion"]
    stays = f"{_label(champion)} stays champion" if champion else "there is no champion yet"
    return f"{_label(challenger)} is not promoted, {stays}: {decision['reason']}"


def _label(number: int | None) -> str | None:
    return f"v{number}" if number else None


def errors_on(registry: Registry, name: str, results: Results) -> Document | None:
    """Return the RMSE of the first and the last champion of an occasion on its probes.

    Returns:
        Mapping with the keys `unit`, `joint_names`, `before` (RMSE of the champion at the beginning
        of the occasion, on the first probe) and `after` (RMSE of the champion at the end, on the
        last probe). Each RMSE, (n,), is computed with respect to the filtered effort. None without
        a probe.

    Raises:
        DataError, RegistryError: A run or a version was removed or changed since the stages used
            it.
    """
    first, last = results["probe"].get("run"), results["check"].get("run")
    if first is None:
        return None
    old = f"v{results['begin']['champion']}"
    new = f"v{results['challenge']['champion']}" if "champion" in results["challenge"] else old

    def evaluated(label: str, run: Path) -> Evaluation:
        model = registry.load(name, label)
        return evaluate(model, usable_part(load_source(run), model))

    then = evaluated(old, Path(first))
    now = then if last is None else evaluated(new, Path(last))
    return {
        "unit": then.unit,
        "joint_names": list(then.joint_names),
        "before": then.total.rmse_filtered.tolist(),
        "after": now.total.rmse_filtered.tolist(),
    }
