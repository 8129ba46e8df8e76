"""What is done when a schedule is due: probe, and identify the robot again if it has changed.

    begin → probe → drift → campaign → fit → register → check → challenge → summary

A stage may be called again after a crash, so what must not happen twice is looked for where it is
done. A run names the occasion in its start document before anything moves: one that is complete is
taken as it is, one that was cut off is gone on with. Versions are found by the model's digest. A
decision is found in the registry's log, whose reason begins with the occasion.

Where a robot is as it was, champion and challenger are compared on probes of the weeks before, too:
a comparison on one day is sure of that day, and in another room the champion may be the better one.
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
from hil.maintenance.ledger import Job, Ledger, Occasion, Work, kept, occasion_of
from hil.maintenance.stages import Document, Stage, kept_document, run_stages
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
    Desk,
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


def as_it_is(experiment: Experiment, occasion: Occasion, stage: str) -> Experiment:
    """The same on every occasion."""
    return experiment


Adapt = Callable[[Experiment, Occasion, str], Experiment]
"""The experiment as it is done at an occasion, for its stage `probe`, `campaign` or `check`."""


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
    """The work of a schedule.

    Args:
        spec: From `load_schedule_spec`.
        registry: Where the champion is, and challengers go.
        runs: Where run directories are kept.
        station: In place of the one the schedule names.
        adapt: Changes an experiment for an occasion, for simulations; see `with_options`.
        observers: Receive progress events of the runs.
        confirm: Confirms that a real robot may move; by default it may not.
        tell: Told the name of every stage that has something to do, when it begins.

    Returns:
        A `Work`. Its document has `outcome` (`quiet`, `drift`, `promoted`, `kept`), `text`, `name`,
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
class Measuring:
    """How runs are made that nobody attends.

    Attributes:
        runs: Where run directories are kept.
        wait_s: How long to wait for a robot that somebody else holds [s].
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
        """The run of an occasion: found, gone on with, or made now.

        Args:
            experiment: What is to be done.
            occasion: Unique among all runs with this spec.

        Returns:
            The run directory; its recording is complete and it was judged.

        Raises:
            NotConfirmed: A real robot may not, or no longer, be moved.
            RobotError: The run of this occasion was ended by something other than a crash or a
                signal: nobody is there to look before the arm moves again.
            HilError: It cannot be begun, or ended early.
        """
        found = run_of(self.runs, experiment, occasion)
        if found is None:
            begun = replace(experiment, occasion=occasion)
            return self._judged(run_experiment(begun, runs=self.runs, **self._attendance()))
        if _is_done(found):
            self._require_its_robot(found, experiment)
            _complete_views(found, experiment.spec.study)
            return found
        _require_harmless(found)
        self._require_confirmed(experiment)
        return self._judged(resume_experiment(found, **self._attendance()))

    def _attendance(self) -> dict[str, Any]:
        operator = ConsoleOperator(console=_NoConsole())
        desk = Desk(operator, nobody_goes_on, self.wait_s, self.confirm)
        return {"desk": desk, "observers": self.observers, "operator": self.operator}

    def _require_its_robot(self, run: Path, experiment: Experiment) -> None:
        """What goes on is done with the arm that made it, as in a run that is gone on with."""
        with held(experiment, wait_s=self.wait_s, report=lambda text: None) as (robot, _):
            require_same_robot(RunDirectory.open(run), describe_robot(robot, experiment.robot))

    def _require_confirmed(self, experiment: Experiment) -> None:
        """What was confirmed when the run began may be withdrawn: a schedule is armed no more."""
        name = experiment.spec.robot
        with opened(name, experiment.robot) as robot:
            at = address_of(robot)
        if at.real:
            self.confirm.admit(name, at.text)

    def _judged(self, report: RunReport) -> Path:
        if not _is_done(report.run):
            told = f"{report.run} ended early: {report.outcome}"
            raise report.error or RobotError(told, hint=f"hil show {report.run}")
        return report.run


def _is_done(run: Path) -> bool:
    """Only what was measured to its end is judged; whoever judged it after a crash ended no run."""
    return RunDirectory(run).is_judged


def _complete_views(run: Path, entries: Sequence[StudyEntry]) -> None:
    """Make the missing studies and report of a run whose process died after its verdict."""
    if RunDirectory(run).is_reported:
        return
    with contextlib.suppress(HilError):  # a study that fails does not invalidate the run
        run_studies(run, missing_studies(run, entries))
    with contextlib.suppress(HilError):
        render_report(run)


BY_SIGNAL = exit_code_of(Stopped("", by_signal=True))


def _require_harmless(run: Path) -> None:
    """A crash or a signal says nothing against going on, nor does a motion that came to its end."""
    directory = RunDirectory.open(run)
    stop = directory.stop
    if stop is None:
        told = _told_by_events(directory.events())
    elif stop.get("outcome") == "completed" or stop.get("exit_code") == BY_SIGNAL:
        told = ""
    else:
        told = f"{stop.get('outcome')}: {stop.get('reason')}"
    if told:
        raise RobotError(
            f"{run} was {told}",
            hint=f"look at the robot, then go on with: hil resume {run}",
        )


def _told_by_events(events: Sequence[Mapping[str, Any]]) -> str:
    """Why the last attempt was being ended when its process died; empty if it was not."""
    told = ""
    for event in events:
        if event["kind"] in ("trip", "hung"):
            told = f"tripped: {event.get('reason')}"
        elif event.get("state") == "preflight":  # another attempt, which somebody has let go on
            told = ""
        elif event.get("state") == "stopping" and event.get("reason"):
            told = told or ("" if event.get("by_signal") else f"stopped: {event['reason']}")
    return told


class _NoConsole(Console):
    """Nobody sits here, also where the scheduler was started in a terminal."""

    @property
    def present(self) -> bool:
        """Never."""
        return False


@dataclass(frozen=True, slots=True)
class Reidentification:
    """The work of a bound schedule; see `reidentification`.

    Attributes:
        bound: The schedule and its experiments.
        registry: Where models are.
        measuring: How runs are made.
        adapt: Changes an experiment for an occasion.
        tell: Told the name of every stage that has something to do, when it begins.
    """

    bound: Bound
    registry: Registry
    measuring: Measuring
    adapt: Adapt
    tell: Callable[[str], object]

    def __call__(self, occasion: Occasion, folder: Path) -> Document:
        """Do what is due, or what is left of it; see `hil.maintenance.ledger.Work`."""
        due = Due(self.bound, self.registry, self.measuring, self.adapt, occasion, self.tell)
        return run_stages(due.stages(), folder)["summary"]


Done = Mapping[str, Document]
SKIPPED = "skipped"

_BEFORE_SUMMARY = (
    "begin", "probe", "drift", "campaign", "fit", "register", "check", "challenge",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Due:
    """The stages of one occasion.

    Attributes:
        bound: The schedule and its experiments.
        registry: Where models are.
        measuring: How runs are made.
        adapt: Changes an experiment for an occasion.
        occasion: What is due.
        tell: Told the name of every stage that has something to do, when it begins.
    """

    bound: Bound
    registry: Registry
    measuring: Measuring
    adapt: Adapt
    occasion: Occasion
    tell: Callable[[str], object] = lambda stage: None

    def stages(self) -> list[Stage]:
        """In order; every one needs those whose documents it looks at."""
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
            Stage("summary", self.summary, _BEFORE_SUMMARY),
        ]  # fmt: skip

    @property
    def key(self) -> str:
        """Names the occasion in runs and in the registry's log."""
        return f"{self.bound.spec.name}/{self.occasion.id}"

    def begin(self, done: Done) -> Document:
        """Who is champion now: what is compared with it must not depend on what comes of it."""
        registry, name = self.registry, self.bound.name
        champion = registry.aliases(name).champion if name in registry.names() else 0
        return {"begun": utc_now(), "champion": champion or None}

    def probe(self, done: Done) -> Document:
        """The short program."""
        if self.bound.probe is None:
            return {SKIPPED: "the schedule has no probe"}
        if done["begin"]["champion"] is None:
            return {SKIPPED: "there is no champion to compare with"}
        return {"run": self._measured(self.bound.probe, "probe")}

    def drift(self, done: Done) -> Document:
        """Whether the probe shows a change, and which."""
        if SKIPPED in done["probe"]:
            return done["probe"]
        self.tell("drift")
        bound = self.bound
        run, alarm = Path(done["probe"]["run"]), bound.spec.false_alarm
        champion = f"v{done['begin']['champion']}"
        told = assess(self.registry, bound.name, run, false_alarm=alarm, champion=champion)
        document = told.to_dict()
        del document["features"]
        return document

    def campaign(self, done: Done) -> Document:
        """The full program, if it is called for."""
        bound, changed = self.bound, bool(done["drift"].get("changed"))
        if self.occasion.job == "campaign":
            why = "it is due"
        elif done["begin"]["champion"] is None:
            why = "the first one"
        elif changed and bound.spec.campaign.on_drift:
            why = str(done["drift"]["text"])
        else:
            return {SKIPPED: "only told, as on_drift is false" if changed else "nothing changed"}
        return {"why": why, "run": self._measured(bound.campaign, "campaign")}

    def fit(self, done: Done) -> Document:
        """The model that the run has fitted."""
        if SKIPPED in done["campaign"]:
            return done["campaign"]
        self.tell("fit")
        run, name = Path(done["campaign"]["run"]), self.bound.fit.estimator
        found = [folder for folder in models_below(run) if _is_of(folder, name)]
        verdict = read_json(run / "verdict.json")
        if not found:
            told = [one["error"] for one in verdict["problems"] if one["estimator"] in (name, "")]
            raise FitError(
                f"{run} has no {name}: {'; '.join(told) or 'it was removed'}",
                hint=f"hil show {run}",
            )
        model = max(found, key=lambda folder: (folder / "evaluation.json").stat().st_mtime_ns)
        judged = read_json(model / "evaluation.json")
        if judged["protocol"] != HONEST:
            raise FitError(not_honest(name, judged["protocol"]), hint=f"hil show {run}")
        held_out = judged["held_out"]
        keys = ("what", "unit", "joint_names", "total")
        rows = [row for row in verdict["rows"] if row["estimator"] in (name, "")]
        return {
            "model": str(model),
            "held_out": {key: held_out[key] for key in keys},
            "criteria": rows,
        }

    def register(self, done: Done) -> Document:
        """The model as a version, to be compared with the champion."""
        if SKIPPED in done["fit"]:
            return done["fit"]
        self.tell("register")
        model, name = Path(done["fit"]["model"]), self.bound.name
        facts, registry = facts_of(model), self.registry
        version = registry.register(name, model, facts)
        if decided(registry, name, self.key, version.number) is None:
            registry.register(name, model, facts, challenger=True)
        return {"version": version.number, "digest": version.digest}

    def check(self, done: Done) -> Document:
        """The short program again: what both are compared on was taken before and after."""
        if SKIPPED in done["fit"]:
            return done["fit"]
        if self.bound.probe is None or done["begin"]["champion"] is None:
            return {SKIPPED: "there is no champion to compare with, or no probe"}
        return {"run": self._measured(self.bound.probe, "check")}

    def challenge(self, done: Done) -> Document:
        """Promoted, or kept out, by the registry's rules; once."""
        if SKIPPED in done["register"]:
            return done["register"]
        self.tell("challenge")
        decision = Decision(self.registry, self.bound.name, self.key, done)
        told = decision.made()
        return told | {"champion": self.registry.aliases(self.bound.name).champion or None}

    def summary(self, done: Done) -> Document:
        """What the ledger, notifications and people are told."""
        errors = errors_on(self.registry, self.bound.name, done)
        return summary(self.bound.name, done, errors)

    def _measured(self, experiment: Experiment, stage: str) -> str:
        self.tell(stage)
        adapted = self.adapt(experiment, self.occasion, stage)
        return str(self.measuring.measure(adapted, f"{self.key}/{stage}").resolve())


def _is_of(folder: Path, estimator: str) -> bool:
    return folder.name.rpartition("-")[0] == estimator


STATES = Path("schedules")
"""Where schedules keep their state, a folder each, unless somebody names another."""

BY_HAND = "by-hand"
"""Below the schedule's state: occasions that somebody asked for."""


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
    """Do once, now, what a schedule is about; goes on with what was cut off not too long ago.

    Args:
        schedule: Its file.
        station: In place of the one it names.
        runs: Where run directories are kept.
        registry: Where the champion is, and challengers go.
        state: Folder of the schedule; by default `schedules/NAME`.
        campaign: Run the full program whatever the probe says.
        observers: Receive progress events of the runs, each on its own thread.
        tell: Told what is begun, in a few words.

    Returns:
        `outcome` (`quiet`, `drift`, `promoted`, `kept`), `text`, `name`, `champion`, `before`,
        `challenger`, `drift`, `decision`, `errors`, `runs`, `folder`: see docs/reference/files.md.

    Raises:
        SpecError: With every problem of the schedule and the files it names.
        DataError: Another process does the same now, or the schedule is held.
        HilError: What keeps a stage from its end; the next call goes on there.
    """
    file, at = path_of(schedule), path_of(station) if station else None
    bound = bind_file(file, at)
    for experiment in bound.experiments:
        require_extras(experiment.spec)
    of_schedule = path_of(state) if state else STATES / bound.spec.name
    confirm = require_armed(bound.moves(file), of_schedule)
    if held := Ledger.read(of_schedule).standing.held:
        raise DataError(
            f"the schedule {bound.spec.name} is held: {held['why']}",
            hint=f"when the reason is gone: hil schedule release {file} --reason TEXT",
        )
    job: Job = "campaign" if campaign or bound.probe is None else "probe"
    home = of_schedule / BY_HAND
    report = tell or (lambda text: None)
    work = reidentification(
        bound.spec, registry=Registry(path_of(registry)), runs=path_of(runs), station=at,
        observers=observers, confirm=confirm, tell=lambda stage: report(f"stage: {stage}"),
    )  # fmt: skip
    with kept(home, bound.spec.name):
        occasion = _left(home, job, bound.spec.missed_within)
        if occasion is not None:
            report(f"going on with {home / occasion.id}")
        occasion = occasion or _new(home, job)
        return dict(work(occasion, home / occasion.id)) | {"folder": str(home / occasion.id)}


def _left(home: Path, job: Job, within: timedelta) -> Occasion | None:
    """The newest occasion of that kind, if it was cut off; days later the robot is another one."""
    for folder in sorted(home.glob(f"*-{job}"), reverse=True)[:1]:
        left = occasion_of(folder.name)
        if kept_document(folder, "summary") is None and left.due >= datetime.now(UTC) - within:
            return left
    return None


def _new(home: Path, job: Job) -> Occasion:
    """One of now; of a later second where that one is taken, or old results were told as new."""
    occasion = Occasion(datetime.now(UTC).replace(microsecond=0), job)
    while (home / occasion.id).exists():
        occasion = Occasion(occasion.due + timedelta(seconds=1), job)
    return occasion


def run_of(runs: Path, experiment: Experiment, occasion: str) -> Path | None:
    """The run of an occasion with this spec at this station; None if nothing has begun.

    Schedules of one name may share a folder of runs, and be due at the same time on two robots.
    """
    said = json.dumps(occasion, ensure_ascii=False).encode()
    wanted = {
        "occasion": occasion,
        "spec_hash": spec_hash(experiment.spec),
        "station": whole(experiment.station_source),
    }
    for path in reversed(run_folders(runs)):
        try:
            raw = (path / "start.json").read_bytes()
            start = json.loads(raw) if said in raw else {}
            station = (path / "station.yaml").read_text("utf-8")
        except (OSError, ValueError):
            continue
        if station == experiment.station_text and wanted.items() <= start.items():
            return path
    return None


def decided(registry: Registry, name: str, key: str, number: int) -> Entry | None:
    """What an occasion has decided already about a version, by the log.

    Args:
        registry: Where the version is.
        name: Whose.
        key: Of the occasion.
        number: The version's.
    """
    mine = (one for one in reversed(registry.log(name)) if one.event in ("promoted", "kept"))
    return next((one for one in mine if one.version == number and one.reason.startswith(key)), None)


@dataclass(frozen=True, slots=True)
class Decision:
    """About the model of an occasion.

    Attributes:
        registry: Where its version is.
        name: Whose.
        key: Of the occasion.
        done: Documents of the stages before.
    """

    registry: Registry
    name: str
    key: str
    done: Mapping[str, Document]

    @property
    def number(self) -> int:
        """Of the challenger."""
        return int(self.done["register"]["version"])

    @property
    def before(self) -> int:
        """Champion when the occasion began, 0 for none."""
        return int(self.done["begin"]["champion"] or 0)

    def made(self) -> Document:
        """`promoted`, `reason` and `evidence`; taken now if it was not before."""
        if self.number == self.before:
            return {"promoted": False, "reason": "it is the champion itself", "evidence": {}}
        about = (self.registry, self.name, self.key, self.number)
        if (entry := decided(*about)) is None:
            self._take()
            entry = decided(*about)
        if entry is None:
            return {"promoted": False, "reason": "it became champion meanwhile", "evidence": {}}
        said = entry.reason.removeprefix(self.key).lstrip(" :")
        promoted = entry.event == "promoted"
        return {"promoted": promoted, "reason": said, "evidence": dict(entry.evidence)}

    def _take(self) -> None:
        judged = self.done["fit"]["criteria"]
        now = self.registry.aliases(self.name).champion
        if missed := [row for row in judged if not row["passed"]]:
            row = missed[0]
            told = f"{row['metric']} of {row['what']} is {row['value']}, at most {row['max']:g}"
            words = f"{len(missed)} criteria of the campaign are missed: {told}"
            self._keep(words, criteria=missed)
        elif now not in (self.before, self.number):
            instead = f", instead of v{self.before}" if self.before else ""
            self._keep(f"v{now} has become champion meanwhile{instead}")
        elif self.before:
            self._challenge()
        else:
            words = "it meets its criteria" if judged else "there are no criteria"
            evidence = {"criteria": judged}
            self.registry.promote(
                self.name, self.number, reason=f"{self._why}: {words}", evidence=evidence,
                instead_of=0,
            )  # fmt: skip

    def _challenge(self) -> None:
        """The campaign's criteria speak of its own held-out motions, and are met there."""
        done = self.done
        taken = [done[stage].get("run") for stage in ("campaign", "probe", "check")]
        earlier: list[Path] = []
        if done["drift"].get("changed") is False:
            earlier = earlier_probes(self.registry, self.name, Path(done["probe"]["run"]))
        challenge(
            self.registry, self.name, f"v{self.number}", [Path(run) for run in taken if run],
            reason=self._why, earlier=earlier,
        )  # fmt: skip

    def _keep(self, words: str, **evidence: object) -> None:
        reason = f"{self._why}: {words}"
        self.registry.keep(self.name, self.number, reason=reason, evidence=evidence)

    @property
    def _why(self) -> str:
        return f"{self.key}: {self.done['campaign']['why']}"


MOST = 5


def earlier_probes(registry: Registry, name: str, run: Path) -> list[Path]:
    """The last probes before one, as far back as nothing has changed; at most `MOST`.

    Args:
        registry: Where the history of probes is.
        name: Whose.
        run: The probe of now, which says that nothing has changed.

    Returns:
        Those whose recordings are still there, newest first.

    Raises:
        RegistryError: The history is damaged.
    """
    # One probe has a line for each champion that it was compared with.
    told = {one.uid: one for one in sorted(probes_of(registry, name), key=lambda one: one.changed)}
    found: list[Path] = []
    for probe in sorted(told.values(), key=lambda one: one.at, reverse=True):
        if probe.changed or len(found) == MOST:
            break
        source = Path(probe.source)
        if source.resolve() != run.resolve() and _is_there(source):
            found.append(source)
    return found


def _is_there(source: Path) -> bool:
    """Recordings are pruned, and runs moved away."""
    folder = source / "recording"
    return source.is_file() or (folder.is_dir() and bool(recordings_in(folder)))


def summary(name: str, done: Done, errors: Document | None) -> Document:
    """The document of `Work`, from those of the stages before.

    Args:
        name: In the registry.
        done: By stage.
        errors: From `errors_on`.
    """
    drift = done["drift"] if "changed" in done["drift"] else None
    decision = done["challenge"] if "promoted" in done["challenge"] else None
    before, challenger = done["begin"]["champion"], done["register"].get("version")
    champion = decision["champion"] if decision else before
    runs = {stage: done[stage].get("run") for stage in ("probe", "campaign", "check")}
    return {
        "outcome": _outcome(drift, decision),
        "text": _text(drift, decision, challenger),
        "name": name,
        "begun": done["begin"]["begun"],
        "before": _label(before),
        "champion": _label(champion),
        "challenger": _label(challenger),
        "drift": drift,
        "decision": decision,
        "held_out": done["fit"].get("held_out"),
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


def errors_on(registry: Registry, name: str, done: Done) -> Document | None:
    """RMSE of the champion on probes, joint by joint: that of the beginning and that of the end.

    Returns:
        `unit`, `joint_names`, `before` (champion of the beginning on the first probe) and `after`
        (champion of the end on the last probe), (n,) each, against the filtered effort; None
        without a probe.

    Raises:
        DataError, RegistryError: A run or a version was removed or changed meanwhile.
    """
    first, last = done["probe"].get("run"), done["check"].get("run")
    if first is None:
        return None
    old = f"v{done['begin']['champion']}"
    new = f"v{done['challenge']['champion']}" if "champion" in done["challenge"] else old
    then = _on(registry, name, old, Path(first))
    now = then if last is None else _on(registry, name, new, Path(last))
    return {
        "unit": then.unit,
        "joint_names": list(then.joint_names),
        "before": then.total.rmse_filtered.tolist(),
        "after": now.total.rmse_filtered.tolist(),
    }


def _on(registry: Registry, name: str, label: str, run: Path) -> Evaluation:
    model = registry.load(name, label)
    return evaluate(model, usable_part(load_source(run), model))
