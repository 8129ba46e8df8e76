"""The stages of an occasion: what each of them does, and looks for first.

    begin → probe → drift → campaign → fit → register → check → challenge → summary

A stage may be called again after a crash. Runs are looked for by the occasion in their start
document, versions by the model's digest, decisions by the occasion in the log's reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hil.core import FitError, read_json
from hil.estimators import HONEST, models_below
from hil.maintenance.pipeline.bound import Bound
from hil.maintenance.pipeline.deciding import Decision, decided
from hil.maintenance.pipeline.fitting_together import not_honest
from hil.maintenance.pipeline.measuring import Measuring
from hil.maintenance.pipeline.outcome import errors_on, summary
from hil.maintenance.pipeline.stages import Document, Stage
from hil.maintenance.schedule.occasion import Occasion
from hil.models import Registry, assess, facts_of
from hil.planning import Experiment
from hil.recording import utc_now
from hil.spec import spec_hash

Adapt = Callable[[Experiment, Occasion, str], Experiment]
"""The experiment as it is done at an occasion, for its stage `probe`, `campaign` or `check`."""

Done = Mapping[str, Document]
SKIPPED = "skipped"


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


_BEFORE_SUMMARY = (
    "begin", "probe", "drift", "campaign", "fit", "register", "check", "challenge",
)  # fmt: skip


def _is_of(folder: Path, estimator: str) -> bool:
    return folder.name.rpartition("-")[0] == estimator
