"""Probes of a robot in the order they were taken, beside its models in the registry.

    REGISTRY/NAME/probes.jsonl

A line per probe and champion: what it says, what the charts said of it, and what was called
changed. A line counts from its line break on. Probes are judged against those of the same program
under the same champion: along another motion a model errs otherwise.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, RegistryError, read_json, sha256_of
from hil.estimators import RobotEstimator, plain
from hil.evaluation import require_unseen, usable_part
from hil.importers import load_source
from hil.models.drift.causes import Cause, causes, told
from hil.models.drift.chart import FALSE_ALARM, Charted, charted
from hil.models.drift.features import Features, features_of
from hil.models.log import append_line, read_lines
from hil.models.model_registry import Registry
from hil.models.pointers import leave_pointer
from hil.models.registry_lock import writing

PROBES_FILE = "probes.jsonl"


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """One probe under one champion.

    Attributes:
        uid: Identity of its run or recording.
        at: When it was taken, ISO 8601.
        source: Where it was then.
        program: Hash of its spec (a plan depends on where the arm stood); empty for a recording.
        champion: Version it was compared with.
        false_alarm: Probability, at most, with which a robot that has not changed is called so.
        features: What it says.
        changed: Whether the charts call it changed.
        causes: What has changed.
        p: Smallest probability of a feature's deviation, of both charts.
        reference: Probes it was compared with.
    """

    uid: str
    at: str
    source: str
    program: str
    champion: int
    false_alarm: float
    features: Features
    changed: bool
    causes: tuple[Cause, ...]
    p: float
    reference: int

    @property
    def text(self) -> str:
        """One line for people."""
        if self.changed:
            return told(self.causes)
        if self.reference < 2:
            probe = f"probe {self.reference + 1} of this program under this champion"
            return f"{probe}: nothing to compare with yet"
        return f"nothing has changed (smallest p {self.p:.2g}, {self.reference} probes to compare)"

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil drift --json`, and a line of the file."""
        return {
            "uid": self.uid, "at": self.at, "source": self.source,
            "program": self.program, "champion": self.champion, "false_alarm": self.false_alarm,
            "changed": self.changed, "text": self.text, "p": self.p,
            "reference": self.reference, "causes": [cause.to_dict() for cause in self.causes],
            "features": self.features.to_dict(),
        }  # fmt: skip


def probes_of(registry: Registry, name: str) -> list[Probe]:
    """All probes of a name, in the order in which they were judged.

    Raises:
        RegistryError: A line is damaged.
    """
    path = registry.root / name / PROBES_FILE
    return [_probe(path, number, line) for number, line in read_lines(path)]


def assess(
    registry: Registry,
    name: str,
    source: Path,
    *,
    false_alarm: float = FALSE_ALARM,
    champion: str = "champion",
) -> Probe:
    """Judge a probe against the champion and the probes before it, and keep it.

    The same probe under the same champion is judged once: what was said then is said again.

    Args:
        registry: With a champion of that name.
        name: The robot's.
        source: Run directory or recording of the probe.
        false_alarm: Of one probe, all features together, at most.
        champion: The version, such as `v3`, where another may have become champion meanwhile.

    Raises:
        DataError: The source cannot be read, or the champion was fitted to it.
        RegistryError: There is no champion, or the history is damaged.
    """
    version = registry.version(name, champion)
    model = registry.load(name, version.label)
    uid, at, program = identity(source)
    features = _features(model, source)
    with writing(registry.root / name):
        before = [one for one in probes_of(registry, name) if one.champion == version.number]
        known = next((one for one in before if one.uid == uid), None)
        if known is not None:
            return known
        quiet = quiet_like(before, version.number, program)
        chart = charted([*(one.features for one in quiet), features], model.sigma_, false_alarm)
        unit = "A" if model.effort_kind_ == "current" else "N·m"
        found = tuple(causes(features, chart, false_alarm, unit))
        probe = Probe(
            uid, at, str(source), program, version.number, false_alarm, features,
            bool(chart.alarm.any()), found, _least(chart), chart.reference,
        )  # fmt: skip
        leave_pointer(registry.root, [source])
        append_line(registry.root / name / PROBES_FILE, plain(probe.to_dict()))
    return probe


def quiet_like(probes: Iterable[Probe], champion: int, program: str) -> list[Probe]:
    """Those that a probe of this program is compared with under this champion."""
    like = (champion, program)
    return [one for one in probes if (one.champion, one.program) == like and not one.changed]


def identity(source: Path) -> tuple[str, str, str]:
    """Identity, time and program of a source: a run's own, or a recording's digest and nothing.

    Raises:
        DataError: There is no such source.
    """
    if (source / "start.json").is_file():
        start = read_json(source / "start.json")
        uid, at, program = (str(start.get(key, "")) for key in ("uid", "started", "spec_hash"))
        return uid, at, program
    if not source.is_file():
        raise DataError(f"{source} does not exist", hint="give a run directory or an MCAP file")
    return sha256_of(source), "", ""


def _features(model: RobotEstimator, source: Path) -> Features:
    data = usable_part(load_source(source), model)
    require_unseen(model, source, data)
    return features_of(model, data)


def _least(chart: Charted) -> float:
    return float(np.min(np.minimum(chart.p, chart.p_mean)))


def _probe(path: Path, number: int, line: bytes) -> Probe:
    try:
        told_then = json.loads(line)
        listed: Sequence[dict[str, Any]] = told_then["causes"]
        return Probe(
            str(told_then["uid"]), str(told_then["at"]), str(told_then["source"]),
            str(told_then["program"]), int(told_then["champion"]), float(told_then["false_alarm"]),
            Features.from_dict(told_then["features"]), bool(told_then["changed"]),
            tuple(Cause(**one) for one in listed), float(told_then["p"]),
            int(told_then["reference"]),
        )  # fmt: skip
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise RegistryError(
            f"{path}:{number}: damaged: {error}",
            hint="restore the file from a backup, or move it away: charts then begin anew",
        ) from error
