"""Drift detection by short probes: checks whether a robot still matches its model.

`REGISTRY/NAME/probes.jsonl` contains one line per probe and champion: the features of the probe
(`hil.models.drift_features`) and the changes detected by the charts. A line of `probes.jsonl` is
committed by its line break. A probe is compared only with probes of the same program under the same
champion, because the errors of a model differ between motions.

**The chart.** Each feature of a probe has a chart with the joint temperature T as a covariate. A
feature of an unchanged robot is a + b·(T − T̄) + noise, with the joint temperature T and its mean
T̄. The coefficient a of a feature is not zero because no model is exact. The coefficient b of a
feature is not zero because the model's friction does not follow the temperature exactly. The first
probes after a model became champion form the reference. Bayesian regression with priors for usual
robots estimates a, b and the noise from the reference. Without a reference, the limits of the
charts are wide, so no change is detected. The features of a new probe are compared with their
prediction for its temperature. To detect slow changes, an exponentially weighted mean of the new
and the earlier probes is compared with the prediction, too. Predictions of features are Student-t
distributed, because the noise is estimated as well. The estimation error of the reference, which
all probes share, is counted only one time in the mean of several probes. The false-alarm rate of an
unchanged robot is at most `false_alarm` for all features together. Each feature gets an equal share
of this rate, and each of its two tests gets half of that share (Bonferroni).

**The cause.** A single cause of a change affects the estimates of several features. Therefore the
cause that explains most of the deviations is named first, then the causes that explain the
remainder (`causes`).
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
    """Result of one probe under one champion.

    Attributes:
        uid: Identity of the probe's run or recording.
        at: Time of the probe measurement, ISO 8601.
        source: Path of the run or recording at the time of the assessment.
        program: Hash of the spec; empty for a recording. (A hash of the plan would depend on the
            initial pose of the arm.)
        champion: Version of the champion with which the probe was compared.
        false_alarm: Maximum false-alarm rate for an unchanged robot.
        features: Measured features.
        changed: Whether the charts detect a change of the robot.
        causes: Causes of the detected change; empty if no change is detected.
        p: Smallest p-value over all features and the two tests of each feature.
        reference: Number of probes that form the reference.
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
        """Result of the probe in one line."""
        if self.changed:
            return causes_text(self.causes)
        if self.reference < 2:
            probe = f"probe {self.reference + 1} of this program under this champion"
            return f"{probe}: nothing to compare with yet"
        return f"nothing has changed (smallest p {self.p:.2g}, {self.reference} probes to compare)"

    def to_dict(self) -> dict[str, Any]:
        """Return the documented output of `hil drift --json`, which is also a line of the file."""
        return {
            "uid": self.uid, "at": self.at, "source": self.source,
            "program": self.program, "champion": self.champion, "false_alarm": self.false_alarm,
            "changed": self.changed, "text": self.text, "p": self.p,
            "reference": self.reference, "causes": [cause.to_dict() for cause in self.causes],
            "features": self.features.to_dict(),
        }  # fmt: skip


def probes_of(registry: Registry, name: str) -> list[Probe]:
    """Return all probes of a model name, in the order of their assessment.

    Raises:
        RegistryError: A line of the file with the probes is damaged.
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
            hint="restore the file from a backup, or move it away to start new charts",
        ) from error


FALSE_ALARM = 0.01
"""Default false-alarm rate of one probe, for all features together."""


def assess(
    registry: Registry,
    name: str,
    source: Path,
    *,
    false_alarm: float = FALSE_ALARM,
    champion: str = "champion",
) -> Probe:
    """Check a probe against the champion and earlier probes, and add it to the history.

    A probe is assessed only one time per champion; further calls return the stored result.

    Args:
        registry: Registry that contains a champion of the name.
        name: Name of the robot's models.
        source: Run directory or recording of the probe.
        false_alarm: Maximum false-alarm rate of one probe, for all features together.
        champion: Version to compare the probe with, such as `v3`, if the champion may change during
            the call.

    Raises:
        DataError: The source cannot be read, or the champion was fitted to the source.
        RegistryError: The name has no champion, or the history of its probes is damaged.
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
    """Return the probes of one program and champion that show no change."""
    like = (champion, program)
    return [one for one in probes if (one.champion, one.program) == like and not one.changed]


def identity(source: Path) -> tuple[str, str, str]:
    """Return identity, time and program of a run; for a recording, its digest and two empty texts.

    Raises:
        DataError: The run or recording does not exist.
    """
    if (source / "start.json").is_file():
        start = read_json(source / "start.json")
        uid, at, program = (str(start.get(key, "")) for key in ("uid", "started", "spec_hash"))
        return uid, at, program
    if not source.is_file():
        raise DataError(f"{source} does not exist", hint="give a run directory or an MCAP file")
    return sha256_of(source), "", ""


REFERENCE = 5
"""Number of probes after a promotion that form the reference; the charts assess these probes,
too.
"""

FORGET = 0.3
"""Weight of the newest probe in the exponentially weighted mean."""

PRIORS = {"friction": (0.2, 0.01), "gain": (0.1, 0.005), "offset": (5.0, 0.2), "load": (0.2, 0.01)}
"""Prior standard deviations of the coefficients a (unit of the feature) and b [unit per kelvin].
The units of the features are shares for friction and gain, standard deviations of the champion's
residual for offsets, kg for the mass of a load, and a tenth of that in kg·m for its first moments.
Real friction changes by 0.2 to 1 % per kelvin, and models follow most of this change.
"""

NOISE_DOF = 4.0
"""Degrees of freedom of the prior of the noise, which is estimated from the blocks of the
probes.
"""

LEAST_NOISE = 1e-6
"""Minimum standard deviation of the noise, as a share of the prior of a; needed for simulations
without noise.
"""

LEVER_M = 0.1
"""Prior ratio of the first moment of a load to its mass [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """Values of the charts of all K features at the newest probe.

    Attributes:
        deviation: (K,) difference of the newest probe from the prediction at its temperature.
        std: (K,) standard deviation of `deviation` for an unchanged robot.
        p: (K,) p-value of the test of `deviation` for an unchanged robot.
        p_mean: (K,) p-value of the test of `mean`; equal to `p` as long as the mean contains only
            one probe.
        mean: (K,) weighted mean of the deviations since the reference.
        limit: (K,) deviation above which a single probe counts as changed.
        alarm: (K,) whether a change of the feature is detected.
        reference: Number of probes that form the reference.
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
    """Return the charts of consecutive probes of one program under one champion.

    Args:
        probes: Features of the probes, oldest first; a change must not have been detected in any
            probe except the last.
        sigma: (n,) standard deviation of the champion's residual, in effort units.
        false_alarm: Maximum false-alarm rate of one probe, for all features together.

    Raises:
        DataError: The probes belong to different robots, or there is no probe.
    """
    if not probes or any(one.names != probes[0].names for one in probes):
        raise DataError(
            "probes of different robots cannot be in one chart",
            hint="keep a separate history for each robot",
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
    """Return the probes without those that are bit-identical copies of another probe."""
    *before, newest = probes
    distinct: dict[bytes, Features] = {}
    for probe in before:
        distinct.setdefault(probe.values.tobytes(), probe)
    distinct.pop(newest.values.tobytes(), None)
    return [*distinct.values(), newest]


def _noise(probes: Sequence[Features]) -> FloatArray:
    """Return the noise standard deviation (K,) of one probe, from the scatter of its blocks.

    The error of a model along a motion is the same in every probe of that motion. The common part
    of blocks at the same place of the motion is therefore not noise. The common part of all blocks
    of one probe is not noise either.
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
    """Return deviation, its std, degrees of freedom, weighted mean and its std for one feature.

    Args:
        values: (P,) values of the feature in all probes, the newest last.
        warm: (P,) temperatures of the probes relative to their mean [K].
        prior: (2,) prior standard deviations of the coefficients a and b.
        noise: Noise standard deviation of one probe.
        count: Number of probes in the reference; the reference consists of the first probes.
    """
    X = np.column_stack([np.ones_like(warm), warm])
    known, y = X[:count], values[:count]
    noise = max(noise, LEAST_NOISE * float(prior[0]))
    # Conjugate prior of a regression (normal-inverse-gamma), in units of the noise.
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
    """Return the prior standard deviations of a and b (`PRIORS`), in the unit of the feature."""
    what = name.rsplit(" ", 1)[1]
    if name.startswith("load "):
        return np.array(PRIORS["load"]) * (1.0 if what == "mass" else LEVER_M)
    # All joints share one scale, because offsets do not depend on the current of a joint.
    return np.array(PRIORS[what]) * (float(np.median(sigma)) if what == "offset" else 1.0)


def _p(value: FloatArray, std: FloatArray, dof: FloatArray) -> FloatArray:
    probability: FloatArray = 2.0 * student_tail(np.abs(value) / std, dof)
    return probability


LEAST_KG = 0.05
"""Minimum change of a load's mass for which a position of the mass is reported [kg]; below this
change the position would be noise.
"""

MOST = 4
"""Maximum number of causes that are named; a robot with more changes does not match its model at
all.
"""


@dataclass(frozen=True, slots=True)
class Cause:
    """Detected change of a feature, as a cause of deviations.

    Attributes:
        name: Name of the changed feature; `load` for all features of the load.
        change: Change of the feature, in its unit; for a load, the change of its mass [kg].
        std: Standard deviation of the value `change`.
        unit: Unit of the value `change`; `1` for a share.
        text: Description of the change in words.
    """

    name: str
    change: float
    std: float
    unit: str
    text: str

    def to_dict(self) -> dict[str, Any]:
        """Return the cause as a JSON object."""
        return {
            "name": self.name, "change": self.change, "std": self.std, "unit": self.unit,
            "text": self.text,
        }  # fmt: skip


def causes(probe: Features, chart: Chart, false_alarm: float, effort_unit: str) -> list[Cause]:
    """Return the causes of a change: first the cause that explains most, then the further causes.

    Args:
        probe: Features of the newest probe.
        chart: Charts at the newest probe; without an alarm in the charts, the list of causes is
            empty.
        false_alarm: False-alarm rate with which the charts were computed.
        effort_unit: Unit of the joint effort and therefore of offsets.
    """
    if not chart.alarm.any():
        return []
    # The newest deviation estimates a jump, whereas the mean estimates a slow change.
    jumped = bool(np.any(np.abs(chart.deviation) > chart.limit))
    left, p = (chart.deviation, chart.p) if jumped else (chart.mean, chart.p_mean)
    # The normal quantile of p makes features of different noise comparable.
    size = -normal_quantile(np.maximum(p, 1e-300) / 2)
    scale = np.abs(left) / np.maximum(size, np.finfo(np.float64).tiny)
    # The effect of a cause on other features is uncertain by the error of the model.
    scale = np.maximum(scale, probe.std)
    limit = float(-normal_quantile(false_alarm / len(left) / 4))
    # Each joint feature is a separate cause; all load features together are one cause.
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
            """Return the remaining deviation if only this group has changed, as estimated."""
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
    # Effort is torque divided by gain: more effort for the same torque means a smaller gain.
    sense = ("up" if change > 0 else "down") if what == "friction" else "off"
    word = "friction" if what == "friction" else "effort for the same torque"
    text = f"{word} {sense} on {where}: {100 * change:+.1f} ± {100 * error:.1f} %"
    return Cause(probe.names[k], change, error, UNITS[what], text)


def _place(load: FloatArray) -> str:
    """Return the position of the added or removed mass as text; empty for a small change."""
    if abs(load[0]) < LEAST_KG:
        return ""
    return " at ({:.0f}, {:.0f}, {:.0f}) mm".format(*(1000.0 * load[1:] / load[0]))


def causes_text(named: Sequence[Cause]) -> str:
    """Return the causes of a change in one line."""
    return "; ".join(cause.text for cause in named) or "nothing has changed"


@dataclass(frozen=True, slots=True, eq=False)
class ChartedProbe:
    """Probe, with the charts that led to its result.

    Attributes:
        probe: Result of the probe.
        chart: Charts of the probe and of the earlier probes of the same program and champion.
    """

    probe: Probe
    chart: Chart

    @property
    def expected(self) -> FloatArray:
        """Features (K,) that an unchanged robot would have at the temperature of this probe."""
        return self.probe.features.values - self.chart.deviation

    @property
    def chance(self) -> float:
        """Upper bound of the probability that an unchanged robot deviates as much in any feature.

        A change is detected if the upper bound of the probability is below the false-alarm rate of
        the probe.
        """
        return min(1.0, 2.0 * len(self.probe.features.names) * self.probe.p)


def charted_probes(registry: Registry, name: str) -> list[ChartedProbe]:
    """Return all probes of a name with their charts, in the order of their assessment.

    Raises:
        RegistryError: The name does not exist, its history is damaged, or one of the champions is
            damaged.
        DataError: The files of a champion cannot be read.
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
    """Return the relative change of each joint's friction over a motion after a temperature change.

    Args:
        model: Model with a friction component.
        data: Motion for which friction is predicted at the two temperatures.
        before: (n,) joint temperatures before the change of temperature [°C].
        after: (n,) joint temperatures after the change of temperature [°C].

    Returns:
        (n,) change of the RMS of the friction, as a share of its RMS before; 0 for a model that
        does not depend on temperature.

    Raises:
        DataError: The model has no friction component.
    """

    def friction_rms(celsius: FloatArray) -> FloatArray:
        at = data.with_columns(temperature=np.broadcast_to(celsius, data["q"].shape).copy())
        prediction = model.predict(at)
        if "friction" not in prediction.components:
            raise DataError(
                f"{model.estimator} does not predict friction separately",
                hint="use a model of an estimator with a friction component, such as "
                "rigid-hysteresis",
            )
        friction = prediction.components["friction"][np.all(prediction.valid, axis=1)]
        return np.asarray(np.sqrt(np.mean(friction**2, axis=0)))

    cold, warm = friction_rms(before), friction_rms(after)
    return warm / np.maximum(cold, np.finfo(np.float64).tiny) - 1.0
