"""Re-identification, the work of a schedule: probe, and identify the robot again if it has changed.

    begin → probe → drift → campaign → fit → register → check → challenge → summary

A stage may be done again after a crash, so each first looks for what must not happen twice, in the
place where it would be. A run names the occasion in its start document before anything moves: a
complete run is used as it is, an interrupted one is resumed. Versions are found by the model's
digest. A decision is found in the registry's log, where its reason begins with the occasion.

If the robot has not changed, champion and challenger are compared on probes of earlier weeks, too:
a comparison on one day is certain for that day only, and at another room temperature the champion
may be the better one.
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
"""Default folder of the states of schedules, with a folder for each."""

BY_HAND = "by-hand"
"""Folder below a schedule's state, with the occasions of `hil reidentify`."""


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
    """Do the work of a schedule once, now, or continue it if it was interrupted recently.

    Args:
        schedule: Its file.
        station: In place of the one it names.
        runs: Where run directories are kept.
        registry: With the champion; challengers are registered in it.
        state: Folder of the schedule; by default `schedules/NAME`.
        campaign: Run the full program whatever the probe shows.
        observers: Receive progress events of the runs, each on its own thread.
        tell: Called with a short text about what begins.

    Returns:
        `outcome` (`quiet`, `drift`, `promoted`, `kept`), `text`, `name`, `champion`, `before`,
        `challenger`, `drift`, `decision`, `errors`, `runs`, `folder`: see docs/reference/files.md.

    Raises:
        SpecError: With every problem of the schedule and the files it names.
        DataError: Another process does the same now, or the schedule is held.
        HilError: What keeps a stage from its end; the next call continues there.
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
            hint=f"when the reason is gone: hil schedule release {file} --reason TEXT",
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
            report(f"going on with {home / occasion.id}")
        occasion = occasion or _new_occasion(home, job)
        return dict(work(occasion, home / occasion.id)) | {"folder": str(home / occasion.id)}


def _interrupted_occasion(home: Path, job: Job, within: timedelta) -> Occasion | None:
    """Return the newest occasion of a job if it was interrupted; not days ago, as robots change."""
    for folder in sorted(home.glob(f"*-{job}"), reverse=True)[:1]:
        newest = occasion_of(folder.name)
        if stored_result(folder, "summary") is None and newest.due >= datetime.now(UTC) - within:
            return newest
    return None


def _new_occasion(home: Path, job: Job) -> Occasion:
    """Return an occasion of now, or of the next second that none has: each has its own results."""
    occasion = Occasion(datetime.now(UTC).replace(microsecond=0), job)
    while (home / occasion.id).exists():
        occasion = Occasion(occasion.due + timedelta(seconds=1), job)
    return occasion


Adapt = Callable[[Experiment, Occasion, str], Experiment]
"""Returns an experiment as it is run at an occasion, in its stage `probe`, `campaign`, `check`."""


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
    """Return the work of a schedule.

    Args:
        spec: From `load_schedule_spec`.
        registry: With the champion; challengers are registered in it.
        runs: Where run directories are kept.
        station: In place of the one the schedule names.
        adapt: Changes an experiment for an occasion, for simulations; see `with_options`.
        observers: Receive progress events of the runs.
        confirm: Confirms that a real robot may move; by default it may not.
        tell: Called with the name of every stage that has something to do, when it begins.

    Returns:
        A `Work`. Its result has `outcome` (`quiet`, `drift`, `promoted`, `kept`), `text`, `name`,
        `champion` and `before` (labels of versions, or null), `challenger`, `drift`, `decision`,
        `errors` and `runs`; see docs/reference/files.md.

    Raises:
        SpecError: With every problem of the schedule and the files it names.
        PluginError: A driver is missing or does not load.
    """
    wait_s, may_move = spec.wait_for_robot.total_seconds(), confirm or Unconfirmed()
    measuring = Measuring(runs, wait_s, tuple(observers), confirm=may_move)
    return Reidentification(bind(spec, station), registry, measuring, adapt, tell)


@dataclass(frozen=True, slots=True)
class Reidentification:
    """The work of a bound schedule; see `reidentification`.

    Attributes:
        bound: The schedule and its experiments.
        registry: With the models.
        measuring: Makes runs.
        adapt: Changes an experiment for an occasion.
        tell: Called with the name of every stage that has something to do, when it begins.
    """

    bound: Bound
    registry: Registry
    measuring: Measuring
    adapt: Adapt
    tell: Callable[[str], object]

    def __call__(self, occasion: Occasion, folder: Path) -> Document:
        """Do what is due, or what is left of it; see `hil.maintenance.ledger.Work`."""
        stages = OccasionStages(
            self.bound, self.registry, self.measuring, self.adapt, occasion, self.tell
        )
        return run_stages(stages.all(), folder)["summary"]


Results = Mapping[str, Document]
"""Results of the stages before, by name."""

SKIPPED = "skipped"
"""Key of the result of a stage that was not called for: why it was not."""


@dataclass(frozen=True, slots=True)
class OccasionStages:
    """The stages of one occasion.

    Attributes:
        bound: The schedule and its experiments.
        registry: With the models.
        measuring: Makes runs.
        adapt: Changes an experiment for an occasion.
        occasion: What is due.
        tell: Called with the name of every stage that has something to do, when it begins.
    """

    bound: Bound
    registry: Registry
    measuring: Measuring
    adapt: Adapt
    occasion: Occasion
    tell: Callable[[str], object] = lambda stage: None

    def all(self) -> list[Stage]:
        """Return the stages in order; each needs those whose results it uses."""
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
        """Names the occasion in runs and in the registry's log."""
        return f"{self.bound.spec.name}/{self.occasion.id}"

    def begin(self, results: Results) -> Document:
        """Note the champion: what is compared with it must not depend on later promotions."""
        registry, name = self.registry, self.bound.name
        champion = registry.aliases(name).champion if name in registry.names() else 0
        return {"begun": utc_now(), "champion": champion or None}

    def probe(self, results: Results) -> Document:
        """Run the short program."""
        if self.bound.probe is None:
            return {SKIPPED: "the schedule has no probe"}
        if results["begin"]["champion"] is None:
            return {SKIPPED: "there is no champion to compare with"}
        return {"run": self._measured(self.bound.probe, "probe")}

    def drift(self, results: Results) -> Document:
        """Judge whether the probe shows a change, and which."""
        if SKIPPED in results["probe"]:
            return results["probe"]
        self.tell("drift")
        bound = self.bound
        run, alarm = Path(results["probe"]["run"]), bound.spec.false_alarm
        champion = f"v{results['begin']['champion']}"
        probe = assess(self.registry, bound.name, run, false_alarm=alarm, champion=champion)
        document = probe.to_dict()
        del document["features"]  # long; the history of the registry has them
        return document

    def campaign(self, results: Results) -> Document:
        """Run the full program, if it is called for."""
        bound, changed = self.bound, bool(results["drift"].get("changed"))
        if self.occasion.job == "campaign":
            why = "it is due"
        elif results["begin"]["champion"] is None:
            why = "the first one"
        elif changed and bound.spec.campaign.on_drift:
            why = str(results["drift"]["text"])
        else:
            return {SKIPPED: "only told, as on_drift is false" if changed else "nothing changed"}
        return {"why": why, "run": self._measured(bound.campaign, "campaign")}

    def fit(self, results: Results) -> Document:
        """Take the model that the run has fitted, with its criteria."""
        if SKIPPED in results["campaign"]:
            return results["campaign"]
        self.tell("fit")
        run, name = Path(results["campaign"]["run"]), self.bound.fit.estimator
        folders = [one for one in models_below(run) if one.name.rpartition("-")[0] == name]
        verdict = read_json(run / "verdict.json")
        if not folders:
            why = [one["error"] for one in verdict["problems"] if one["estimator"] in (name, "")]
            raise FitError(
                f"{run} has no {name}: {'; '.join(why) or 'it was removed'}",
                hint=f"hil show {run}",
            )
        model = max(folders, key=lambda folder: (folder / "evaluation.json").stat().st_mtime_ns)
        evaluation = read_json(model / "evaluation.json")
        if evaluation["protocol"] != HONEST:
            raise FitError(not_honest(name, evaluation["protocol"]), hint=f"hil show {run}")
        held_out = evaluation["held_out"]
        keys = ("what", "unit", "joint_names", "total")
        rows = [row for row in verdict["rows"] if row["estimator"] in (name, "")]
        return {
            "model": str(model),
            "held_out": {key: held_out[key] for key in keys},
            "criteria": rows,
        }

    def register(self, results: Results) -> Document:
        """Register the model as a version, and as challenger unless that was decided already."""
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
        """Run the short program again: the models are compared on data from before and after."""
        if SKIPPED in results["fit"]:
            return results["fit"]
        if self.bound.probe is None or results["begin"]["champion"] is None:
            return {SKIPPED: "there is no champion to compare with, or no probe"}
        return {"run": self._measured(self.bound.probe, "check")}

    def challenge(self, results: Results) -> Document:
        """Promote the version, or keep the champion, by the registry's rules; once."""
        if SKIPPED in results["register"]:
            return results["register"]
        self.tell("challenge")
        decision = Decision(self.registry, self.bound.name, self.key, results).take()
        return decision | {"champion": self.registry.aliases(self.bound.name).champion or None}

    def summary(self, results: Results) -> Document:
        """Return the result of the occasion, for the ledger and notifications."""
        errors = errors_on(self.registry, self.bound.name, results)
        return summary(self.bound.name, results, errors)

    def _measured(self, experiment: Experiment, stage: str) -> str:
        self.tell(stage)
        adapted = self.adapt(experiment, self.occasion, stage)
        return str(self.measuring.measure(adapted, f"{self.key}/{stage}").resolve())


@dataclass(frozen=True, slots=True)
class Measuring:
    """Makes unattended runs.

    Attributes:
        runs: Where run directories are kept.
        wait_s: How long to wait for a robot that another process holds [s].
        observers: Receive progress events.
        operator: Recorded; by default the user of this process.
        confirm: Confirms that a real robot may move; by default it may not.
    """

    runs: Path
    wait_s: float = 0.0
    observers: Sequence[Observer] = ()
    operator: str = ""
    confirm: Confirm = field(default_factory=Unconfirmed)

    def measure(self, experiment: Experiment, occasion: str) -> Path:
        """Return the run of an occasion: an earlier one, resumed if need be, or a new one.

        Args:
            experiment: What is measured.
            occasion: Unique among all runs with this spec.

        Returns:
            The run directory; its recording is complete and it was judged.

        Raises:
            NotConfirmed: A real robot may not, or no longer, be moved.
            RobotError: The run of this occasion was ended by something other than a crash or a
                signal: an operator has to look before the arm moves again.
            HilError: It cannot be begun, or ended early.
        """
        run = run_of(self.runs, experiment, occasion)
        if run is None:
            experiment = replace(experiment, occasion=occasion)
            return self._judged(run_experiment(experiment, runs=self.runs, **self._attendance()))
        # A verdict is written once everything was measured, whatever came after it.
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
        """Raise if the arm is not the one that made the run: the occasion continues with it."""
        with held(experiment, wait_s=self.wait_s, report=lambda text: None) as (robot, _):
            require_same_robot(RunDirectory.open(run), describe_robot(robot, experiment.robot))

    def _require_confirmed(self, experiment: Experiment) -> None:
        """Raise if the confirmation that the run began with does not hold any more.

        The confirmation of the run itself would do for its rest, but the schedule may have been
        disarmed since.
        """
        name = experiment.spec.robot
        with opened(name, experiment.robot) as robot:
            at = address_of(robot)
        if at.real:
            self.confirm.admit(name, at.text)

    def _judged(self, report: RunReport) -> Path:
        if not RunDirectory(report.run).is_judged:
            message = f"{report.run} ended early: {report.outcome}"
            raise report.error or RobotError(message, hint=f"hil show {report.run}")
        return report.run


class _NoConsole(Console):
    """No operator, even if the scheduler was started in a terminal."""

    @property
    def present(self) -> bool:
        """Return False."""
        return False


def run_of(runs: Path, experiment: Experiment, occasion: str) -> Path | None:
    """Return the run of an occasion with this spec at this station; None if there is none.

    Schedules of one name may share a folder of runs, and be due at the same time on two robots.
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
            start = json.loads(raw) if quoted in raw else {}  # parsing thousands would take long
            station = (path / "station.yaml").read_text("utf-8")
        except (OSError, ValueError):
            continue
        if station == experiment.station_text and facts.items() <= start.items():
            return path
    return None


def _require_harmless_end(run: Path) -> None:
    """Raise if an unfinished run did not end by a crash, a signal, or the end of its motion."""
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
            hint=f"look at the robot, then go on with: hil resume {run}",
        )


BY_SIGNAL = exit_code_of(Stopped("", by_signal=True))


def _ending_by_events(events: Sequence[Mapping[str, Any]]) -> str:
    """Return why the last attempt was being stopped when its process died; empty if it was not."""
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
    """Make the missing studies and the report of a run whose process died after its verdict."""
    if RunDirectory(run).is_reported:
        return
    with contextlib.suppress(HilError):  # a study that fails does not invalidate the run
        run_studies(run, missing_studies(run, entries))
    with contextlib.suppress(HilError):
        render_report(run)


def decision_in_log(registry: Registry, name: str, key: str, number: int) -> Entry | None:
    """Return what an occasion has decided already about a version, by the log; None if nothing.

    Args:
        registry: With the version.
        name: Of the models.
        key: Of the occasion.
        number: Of the version.
    """
    entries = (one for one in reversed(registry.log(name)) if one.event in ("promoted", "kept"))
    mine = (one for one in entries if one.version == number and one.reason.startswith(key))
    return next(mine, None)


@dataclass(frozen=True, slots=True)
class Decision:
    """The decision about the model of an occasion.

    Attributes:
        registry: With its version.
        name: Of the models.
        key: Of the occasion.
        results: Of the stages before.
    """

    registry: Registry
    name: str
    key: str
    results: Results

    @property
    def number(self) -> int:
        """Number of the challenger."""
        return int(self.results["register"]["version"])

    @property
    def before(self) -> int:
        """Champion when the occasion began, 0 for none."""
        return int(self.results["begin"]["champion"] or 0)

    def take(self) -> Document:
        """Decide, unless that was done before a crash; return `promoted`, `reason`, `evidence`."""
        if self.number == self.before:
            return {"promoted": False, "reason": "it is the champion itself", "evidence": {}}
        about = (self.registry, self.name, self.key, self.number)
        if (entry := decision_in_log(*about)) is None:
            self._decide()
            entry = decision_in_log(*about)
        if entry is None:
            return {"promoted": False, "reason": "it became champion meanwhile", "evidence": {}}
        reason = entry.reason.removeprefix(self.key).lstrip(" :")
        promoted = entry.event == "promoted"
        return {"promoted": promoted, "reason": reason, "evidence": dict(entry.evidence)}

    def _decide(self) -> None:
        criteria = self.results["fit"]["criteria"]
        now = self.registry.aliases(self.name).champion
        if missed := [row for row in criteria if not row["passed"]]:
            row = missed[0]
            first = f"{row['metric']} of {row['what']} is {row['value']}, at most {row['max']:g}"
            words = f"{len(missed)} criteria of the campaign are missed: {first}"
            self._keep(words, criteria=missed)
        elif now not in (self.before, self.number):
            instead = f", instead of v{self.before}" if self.before else ""
            self._keep(f"v{now} has become champion meanwhile{instead}")
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
        """Compare both models; criteria are about the campaign alone, which has met them."""
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
    """Return the last probes before one, as far back as nothing has changed; at most `MOST`.

    Args:
        registry: With the history of probes.
        name: Of the models.
        run: The present probe, by which nothing has changed.

    Returns:
        Those whose recordings are still there, newest first.

    Raises:
        RegistryError: The history is damaged.
    """
    # A probe has a line for each champion that it was compared with; one that was called changed
    # by any of them counts as changed.
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
    """Return whether a run or a recording is still there: neither pruned nor moved away."""
    folder = source / "recording"
    return source.is_file() or (folder.is_dir() and bool(recordings_in(folder)))


def summary(name: str, results: Results, errors: Document | None) -> Document:
    """Return the result of `Work`, from those of the stages before.

    Args:
        name: In the registry.
        results: Of the stages before.
        errors: From `errors_on`.
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
    stays = f"{_label(champion)} stays" if champion else "there is no champion yet"
    return f"{_label(challenger)} is not promoted, {stays}: {decision['reason']}"


def _label(number: int | None) -> str | None:
    return f"v{number}" if number else None


def errors_on(registry: Registry, name: str, results: Results) -> Document | None:
    """Return the RMSE of the champions on probes, per joint: at the beginning and at the end.

    Returns:
        `unit`, `joint_names`, `before` (champion of the beginning on the first probe) and `after`
        (champion of the end on the last probe), (n,) each, against the filtered effort; None
        without a probe.

    Raises:
        DataError, RegistryError: A run or a version was removed or changed meanwhile.
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
