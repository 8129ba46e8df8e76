"""Drift: whether a robot is still the one its model was fitted to, judged by short probes.

`REGISTRY/NAME/probes.jsonl` has a line per probe and champion: the features of the probe
(`hil.models.drift_features`), and what the charts called changed. A line counts from its line break
on. A probe is judged against those of the same program under the same champion: along another
motion a model has other errors.

**The chart**, one per feature, has the joint's temperature as a covariate. A feature of an
unchanged robot is a + b·(T − T̄) + noise: a is not zero since no model is exact, b since the model's
friction does not follow the temperature exactly. Bayesian regression estimates a, b and the noise
from the first probes after a model became champion (the reference), with priors of what is usual;
without a reference the limits are wide, and nothing is called a change. A new probe is compared
with the prediction for its temperature: by itself, and in an exponentially weighted mean with the
probes before it, to find slow changes. Predictions are Student-t, as the noise is estimated too,
and the error of the reference, which all probes share, is counted once. An unchanged robot is
called changed with a probability of `false_alarm` at most, all features together: each feature gets
its share of it, half of that for either chart (Bonferroni).

**The cause.** One cause moves the estimates of others too, so the one that explains most is named
first, then what is left without it (`causes`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import (
    BoolArray,
    DataError,
    FloatArray,
    RegistryError,
    read_json,
    sha256_of,
)
from hil.data import Dataset
from hil.estimators import RobotEstimator, normal_quantile, student_quantile, student_tail
from hil.evaluation import require_unseen, usable_part
from hil.importers import load_source
from hil.models.drift_features import UNITS, Features, features_of
from hil.models.log import append_line, read_lines, writing
from hil.models.model_registry import Registry
from hil.models.registries_file import note_registry

PROBES_FILE = "probes.jsonl"


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """One probe under one champion.

    Attributes:
        uid: Identity of its run or recording.
        at: When it was taken, ISO 8601.
        source: Where its run or recording was then.
        program: Hash of its spec (a plan depends on where the arm stood); empty for a recording.
        champion: Version it was compared with.
        false_alarm: Probability, at most, with which an unchanged robot is called changed.
        features: What it measured.
        changed: Whether the charts call the robot changed.
        causes: What has changed.
        p: Smallest probability of a feature's deviation, of both charts.
        reference: Number of probes it was compared with.
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
        """The result in one line."""
        if self.changed:
            return causes_text(self.causes)
        if self.reference < 2:
            probe = f"probe {self.reference + 1} of this program under this champion"
            return f"{probe}: nothing to compare with yet"
        return f"nothing has changed (smallest p {self.p:.2g}, {self.reference} probes to compare)"

    def to_dict(self) -> dict[str, Any]:
        """Return the contract of `hil drift --json`, which is a line of the file."""
        return {
            "uid": self.uid, "at": self.at, "source": self.source,
            "program": self.program, "champion": self.champion, "false_alarm": self.false_alarm,
            "changed": self.changed, "text": self.text, "p": self.p,
            "reference": self.reference, "causes": [cause.to_dict() for cause in self.causes],
            "features": self.features.to_dict(),
        }  # fmt: skip


def probes_of(registry: Registry, name: str) -> list[Probe]:
    """Return all probes of a name, in the order in which they were judged.

    Raises:
        RegistryError: A line is damaged.
    """
    path = registry.root / name / PROBES_FILE
    return [_probe(path, number, line) for number, line in read_lines(path)]


def _probe(path: Path, number: int, line: bytes) -> Probe:
    try:
        document = json.loads(line)
        listed: Sequence[dict[str, Any]] = document["causes"]
        return Probe(
            str(document["uid"]), str(document["at"]), str(document["source"]),
            str(document["program"]), int(document["champion"]), float(document["false_alarm"]),
            Features.from_dict(document["features"]), bool(document["changed"]),
            tuple(Cause(**one) for one in listed), float(document["p"]),
            int(document["reference"]),
        )  # fmt: skip
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise RegistryError(
            f"{path}:{number}: damaged: {error}",
            hint="restore the file from a backup, or move it away: charts then begin anew",
        ) from error


FALSE_ALARM = 0.01
"""Default rate of false alarms of one probe, all features together."""


def assess(
    registry: Registry,
    name: str,
    source: Path,
    *,
    false_alarm: float = FALSE_ALARM,
    champion: str = "champion",
) -> Probe:
    """Judge a probe against the champion and the probes before it, and add it to the history.

    The same probe under the same champion is judged once: the first result is returned again.

    Args:
        registry: With a champion of that name.
        name: Name of the robot's models.
        source: Run directory or recording of the probe.
        false_alarm: Rate of false alarms of one probe, all features together, at most.
        champion: The version, such as `v3`, if another may have become champion meanwhile.

    Raises:
        DataError: The source cannot be read, or the champion was fitted to it.
        RegistryError: There is no champion, or the history is damaged.
    """
    version = registry.version(name, champion)
    model = registry.load(name, version.label)
    uid, at, program = identity(source)
    data = usable_part(load_source(source), model)
    require_unseen(model, source, data)
    features = features_of(model, data)
    with writing(registry.root / name):
        before = [one for one in probes_of(registry, name) if one.champion == version.number]
        known = next((one for one in before if one.uid == uid), None)
        if known is not None:
            return known
        quiet = quiet_like(before, version.number, program)
        chart = chart_of([*(one.features for one in quiet), features], model.sigma_, false_alarm)
        unit = "A" if model.effort_kind_ == "current" else "N·m"
        probe = Probe(
            uid, at, str(source), program, version.number, false_alarm, features,
            bool(chart.alarm.any()), tuple(causes(features, chart, false_alarm, unit)),
            float(np.min(np.minimum(chart.p, chart.p_mean))), chart.reference,
        )  # fmt: skip
        note_registry(registry.root, [source])
        append_line(registry.root / name / PROBES_FILE, probe.to_dict())
    return probe


def quiet_like(probes: Iterable[Probe], champion: int, program: str) -> list[Probe]:
    """Return the unchanged probes of a program under a champion, which judge further ones."""
    like = (champion, program)
    return [one for one in probes if (one.champion, one.program) == like and not one.changed]


def identity(source: Path) -> tuple[str, str, str]:
    """Return identity, time and program of a run; of a recording its digest and two empty texts.

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


REFERENCE = 5
"""Number of probes after a promotion that later ones are compared with; they are judged too."""

FORGET = 0.3
"""Weight of the newest probe in the weighted mean."""

PRIORS = {"friction": (0.2, 0.01), "gain": (0.1, 0.005), "offset": (5.0, 0.2), "load": (0.2, 0.01)}
"""Standard deviations of a and of b [1/K]: shares of friction and effort; offsets in standard
deviations of the champion's residual; a load in kg, and in kg·m a tenth of that. Real friction
changes by 0.2 to 1 % per kelvin, and models follow most of it."""

NOISE_DOF = 4.0
"""Degrees of freedom of the noise's prior, which comes from the blocks of the probes."""

LEAST_NOISE = 1e-6
"""Smallest noise, as a share of the prior of a: a simulation without noise has none."""

LEVER_M = 0.1
"""Prior of a load's first moment per mass [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """The charts of all K features, at the newest probe.

    Attributes:
        deviation: (K,) difference of the newest probe from the prediction at its temperature.
        std: (K,) standard deviation of `deviation` without a change.
        p: (K,) probability of a deviation as large, without a change.
        p_mean: (K,) the same of `mean`; equal to `p` while no other probe is in it.
        mean: (K,) weighted mean of the deviations since the reference.
        limit: (K,) deviation above which a single probe is called changed.
        alarm: (K,) whether the feature is called changed.
        reference: Number of probes in the reference.
    """

    deviation: FloatArray
    std: FloatArray
    p: FloatArray
    p_mean: FloatArray
    mean: FloatArray
    limit: FloatArray
    alarm: BoolArray
    reference: int


def chart_of(
    probes: Sequence[Features], sigma: FloatArray, false_alarm: float = FALSE_ALARM
) -> Chart:
    """Return the charts of probes that were taken one after the other under one champion.

    Args:
        probes: Oldest first; only the last may have been called changed.
        sigma: (n,) standard deviation of the champion's residual, in effort units.
        false_alarm: Rate of false alarms of one probe, all features together, at most.

    Raises:
        DataError: They are of different robots, or there is none.
    """
    if not probes or any(one.names != probes[0].names for one in probes):
        raise DataError(
            "probes of different robots cannot be charted together",
            hint="keep the history of each robot by itself",
        )
    probes = _distinct(probes)
    count = min(REFERENCE, len(probes) - 1)
    values = np.array([one.values for one in probes])
    celsius = np.array([one.temperature for one in probes])
    centre = np.nan_to_num(np.nanmean(celsius, axis=0)) if np.isfinite(celsius).any() else 0.0
    warm = np.nan_to_num(celsius - centre)
    noise = _noise(probes[: max(count, 1)]) + np.finfo(np.float64).tiny
    rows = [
        _feature(values[:, k], warm[:, k], _prior(name, sigma), float(noise[k]), count)
        for k, name in enumerate(probes[0].names)
    ]
    share = false_alarm / len(rows) / 2
    deviation, std, dof, mean, mean_std = np.array(rows).T
    p, p_mean = _p(deviation, std, dof), _p(mean, mean_std, dof)
    limit = std * -student_quantile(share / 2, dof)
    alarm = (p < share) | (p_mean < share)
    return Chart(deviation, std, p, p_mean, mean, limit, alarm, count)


def _distinct(probes: Sequence[Features]) -> Sequence[Features]:
    """Return the probes without copies of a measurement, which are equal to the last bit."""
    *before, newest = probes
    distinct: dict[bytes, Features] = {}
    for probe in before:
        distinct.setdefault(probe.values.tobytes(), probe)
    distinct.pop(newest.values.tobytes(), None)
    return [*distinct.values(), newest]


def _noise(probes: Sequence[Features]) -> FloatArray:
    """Return the (K,) standard deviation of one probe, from the scatter of its blocks.

    A model's error along a motion is the same in every probe that drives it. What the blocks at the
    same place have in common is therefore no noise, nor is what the blocks of a probe have.
    """
    shapes = {one.blocks.shape for one in probes}
    if len(probes) < 2 or len(shapes) > 1:
        return np.asarray(np.sqrt(np.mean([one.std**2 for one in probes], axis=0)))
    blocks = np.array([one.blocks for one in probes])
    count, per, _ = blocks.shape
    rest = blocks - blocks.mean(axis=0) - blocks.mean(axis=1, keepdims=True)
    rest += blocks.mean(axis=(0, 1))
    variance = np.sum(rest**2, axis=(0, 1)) / ((count - 1) * (per - 1)) / per
    return np.asarray(np.sqrt(variance))


def _feature(
    values: FloatArray, warm: FloatArray, prior: FloatArray, noise: float, count: int
) -> tuple[float, ...]:
    """Return deviation, its std, degrees of freedom, weighted mean and its std, of one feature.

    Values and temperatures (P,) are of all probes, the newest last; the first `count` are the
    reference.
    """
    X = np.column_stack([np.ones_like(warm), warm])
    known, y = X[:count], values[:count]
    noise = max(noise, LEAST_NOISE * float(prior[0]))
    # In units of the noise: normal-inverse-gamma, the conjugate prior of a regression.
    precision = np.diag((noise / prior) ** 2)
    spread = np.linalg.inv(precision + known.T @ known)
    centre = spread @ (known.T @ y)
    dof = NOISE_DOF + count
    rest = float(y @ y - centre @ np.linalg.solve(spread, centre)) if count else 0.0
    variance = (NOISE_DOF * noise**2 + max(rest, 0.0)) / dof
    since = slice(count, None)
    away = values[since] - X[since] @ centre
    new = X[-1]
    std = float(np.sqrt(variance * (1.0 + new @ spread @ new)))
    weights = FORGET * (1.0 - FORGET) ** np.arange(len(away))[::-1]
    weights /= np.sum(weights)
    pooled = weights @ X[since]
    mean_std = float(np.sqrt(variance * (weights @ weights + pooled @ spread @ pooled)))
    return float(away[-1]), std, dof, float(weights @ away), mean_std


def _prior(name: str, sigma: FloatArray) -> FloatArray:
    """Return the standard deviations of a and b, in the feature's unit."""
    what = name.rsplit(" ", 1)[1]
    if name.startswith("load "):
        return np.array(PRIORS["load"]) * (1.0 if what == "mass" else LEVER_M)
    # One scale for all joints: an offset does not depend on how much current a joint needs.
    return np.array(PRIORS[what]) * (float(np.median(sigma)) if what == "offset" else 1.0)


def _p(value: FloatArray, std: FloatArray, dof: FloatArray) -> FloatArray:
    probability: FloatArray = 2.0 * student_tail(np.abs(value) / std, dof)
    return probability


LEAST_KG = 0.05
"""Smallest change of a load's mass whose place is told: below this it would be noise."""

MOST = 4
"""Causes named at most: a robot with more changes is another robot."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Something that has changed.

    Attributes:
        name: Feature; `load` for all of the load.
        change: Change of the feature, in its unit; of the load the change of its mass.
        std: Standard deviation of `change`.
        unit: `1` for a share.
        text: The change in words.
    """

    name: str
    change: float
    std: float
    unit: str
    text: str

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "name": self.name, "change": self.change, "std": self.std, "unit": self.unit,
            "text": self.text,
        }  # fmt: skip


def causes(probe: Features, chart: Chart, false_alarm: float, effort_unit: str) -> list[Cause]:
    """Return what has changed: the cause that explains most first, then what is left without it.

    Args:
        probe: The newest probe.
        chart: Its charts; without an alarm there are no causes.
        false_alarm: Rate of false alarms of the charts.
        effort_unit: Unit of offsets.
    """
    if not chart.alarm.any():
        return []
    # A jump is as large as the newest deviation; a slow change shows in the mean.
    jumped = bool(np.any(np.abs(chart.deviation) > chart.limit))
    left, p = (chart.deviation, chart.p) if jumped else (chart.mean, chart.p_mean)
    # The normal deviation of the same probability: features of different noise are compared by it.
    size = -normal_quantile(np.maximum(p, 1e-300) / 2)
    scale = np.abs(left) / np.maximum(size, np.finfo(np.float64).tiny)
    # What a cause does to other features is known as well as the model fits along the motion.
    scale = np.maximum(scale, probe.std)
    limit = float(-normal_quantile(false_alarm / len(left) / 4))
    # A feature of a joint is a cause by itself, all features of the load are one.
    load = [k for k, name in enumerate(probe.names) if name.startswith("load ")]
    groups = [*([k] for k in range(len(left)) if k not in load), load]
    named: list[Cause] = []
    while len(named) < MOST:
        over = np.abs(left) > limit * scale
        if not named:
            over |= chart.alarm
        if not over.any():
            break

        def rest(group: list[int], left: FloatArray = left) -> float:
            """Return what is left if this group alone has changed by what it shows."""
            return float(np.sum(((left - probe.response[:, group] @ left[group]) / scale) ** 2))

        group = min((one for one in groups if over[one].any()), key=rest)
        named.append(_cause(probe, group, left, chart.std, effort_unit))
        left = left - probe.response[:, group] @ left[group]
    return named


def _cause(
    probe: Features, group: Sequence[int], left: FloatArray, std: FloatArray, effort_unit: str
) -> Cause:
    k = group[0]
    change, error = float(left[k]), float(std[k])
    where, what = probe.names[k].rsplit(" ", 1)
    if where == "load":
        text = f"load at the flange: {change:+.2f} ± {error:.2f} kg{_place(left[list(group)])}"
        return Cause("load", change, error, UNITS[what], text)
    if what == "offset":
        text = f"offset on {where}: {change:+.3g} ± {error:.2g} {effort_unit}"
        return Cause(probe.names[k], change, error, effort_unit, text)
    # Effort is torque divided by gain: more effort for the same torque is less gain.
    sense = ("up" if change > 0 else "down") if what == "friction" else "off"
    word = "friction" if what == "friction" else "effort for the same torque"
    text = f"{word} {sense} on {where}: {100 * change:+.1f} ± {100 * error:.1f} %"
    return Cause(probe.names[k], change, error, UNITS[what], text)


def _place(load: FloatArray) -> str:
    """Return where mass was added or removed; empty if it hardly changed."""
    if abs(load[0]) < LEAST_KG:
        return ""
    return " at ({:.0f}, {:.0f}, {:.0f}) mm".format(*(1000.0 * load[1:] / load[0]))


def causes_text(named: Sequence[Cause]) -> str:
    """Return the causes in one line."""
    return "; ".join(cause.text for cause in named) or "nothing has changed"


@dataclass(frozen=True, slots=True, eq=False)
class ChartedProbe:
    """A probe, and its charts.

    Attributes:
        probe: As it was judged.
        chart: Of it and of the probes of its program before it under the same champion.
    """

    probe: Probe
    chart: Chart

    @property
    def expected(self) -> FloatArray:
        """(K,) features of an unchanged robot at this probe's temperature."""
        return self.probe.features.values - self.chart.deviation

    @property
    def chance(self) -> float:
        """Bound of the probability that any feature of an unchanged robot deviates as much.

        Below the probe's false alarm rate the probe is called changed.
        """
        return min(1.0, 2.0 * len(self.probe.features.names) * self.probe.p)


def charted_probes(registry: Registry, name: str) -> list[ChartedProbe]:
    """Return all probes of a name with their charts, in the order in which they were judged.

    Raises:
        RegistryError: There is no such name, or its history or one of the champions is damaged.
        DataError: A champion cannot be read.
    """
    probes = probes_of(registry, name)
    sigma = {
        number: registry.load(name, f"v{number}").sigma_
        for number in {probe.champion for probe in probes}
    }
    charted: list[ChartedProbe] = []
    for probe in probes:
        quiet = quiet_like((one.probe for one in charted), probe.champion, probe.program)
        features = [*(one.features for one in quiet), probe.features]
        chart = chart_of(features, sigma[probe.champion], probe.false_alarm)
        charted.append(ChartedProbe(probe, chart))
    return charted


def friction_change(
    model: RobotEstimator, data: Dataset, before: FloatArray, after: FloatArray
) -> FloatArray:
    """Return the change of each joint's friction over the same motion at another temperature.

    Args:
        model: Has a friction part.
        data: The motion.
        before: (n,) joint temperatures [°C].
        after: (n,) the same later.

    Returns:
        (n,) change of the friction's RMS as a share of what it was; 0 for a model that knows
        nothing of temperature.

    Raises:
        DataError: The model does not say which part of its prediction is friction.
    """

    def friction_rms(celsius: FloatArray) -> FloatArray:
        at = data.with_columns(temperature=np.broadcast_to(celsius, data["q"].shape).copy())
        prediction = model.predict(at)
        if "friction" not in prediction.components:
            raise DataError(
                f"{model.estimator} does not say which part of its prediction is friction",
                hint="take a model whose estimator tells friction apart, such as rigid-hysteresis",
            )
        friction = prediction.components["friction"][np.all(prediction.valid, axis=1)]
        return np.asarray(np.sqrt(np.mean(friction**2, axis=0)))

    cold, warm = friction_rms(before), friction_rms(after)
    return warm / np.maximum(cold, np.finfo(np.float64).tiny) - 1.0
