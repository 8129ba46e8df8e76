"""Features of a probe: the residual of the champion, expressed by possible changes of an arm.

    measured − predicted = Δfriction · friction + Δgain · effort + offset + load

Each joint has three features: the differences of its friction, drive gain and offset from the
model. The arm as a whole has the features of the load at the flange in addition to the declared
load. Each feature is estimated as if it were the only change of the arm (together with offsets
only). A simultaneous estimate of all features would hardly distinguish the features of a wrist,
whose effort is mostly friction. The motion determines how one change affects the estimates of the
other features (`response`). With `response`, `hil.models.drift.causes` separates the causes.
Standard deviations of features come from the jackknife over blocks of time, because neighbouring
residuals are correlated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from hil.core import BoolArray, DataError, FloatArray
from hil.data import Dataset
from hil.estimators import RobotEstimator
from hil.evaluation import filtered_effort

JOINT_FEATURES = ("friction", "gain", "offset")
LOAD_FEATURES = ("mass", "mass·x", "mass·y", "mass·z")
UNITS = {"friction": "1", "gain": "1", "mass": "kg"} | dict.fromkeys(LOAD_FEATURES[1:], "kg·m")
DRIFT_BLOCK_S = 5.0
FEWEST_DRIFT_BLOCKS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Features of one probe.

    Attributes:
        names: Names of the features, such as `elbow_joint friction` and `load mass`; joints first.
        values: (K,) values of the features: friction and gain as shares of their previous values
            (0.15 is 15 % more), offset in effort units, load in kg and kg·m.
        std: (K,) standard deviations of `values` due to the noise of this probe.
        temperature: (K,) mean temperature of the joint of each feature [°C], averaged over all
            joints for the load; NaN if not measured.
        rms: (n,) RMS of the residual, in effort units.
        samples: Number of samples used in the estimate.
        response: (K, K) estimates of all features that result from a change of a single feature by
            1.
        blocks: (B, K) feature values of each block of time (pseudo-values of the jackknife).
    """

    names: tuple[str, ...]
    values: FloatArray
    std: FloatArray
    temperature: FloatArray
    rms: FloatArray
    samples: int
    response: FloatArray
    blocks: FloatArray

    def to_dict(self) -> dict[str, Any]:
        """Return the features as a JSON object; NaN is written as null."""
        return {
            "names": list(self.names),
            "values": self.values.tolist(),
            "std": self.std.tolist(),
            "temperature_c": self.temperature.tolist(),
            "rms": self.rms.tolist(),
            "samples": self.samples,
            "response": self.response.tolist(),
            "blocks": self.blocks.tolist(),
        }

    @staticmethod
    def from_dict(document: dict[str, Any]) -> Features:
        """Return the features described by a JSON object that `to_dict` wrote.

        Raises:
            KeyError, TypeError, ValueError: A value of the JSON object is missing or invalid.
        """
        arrays = {
            key: np.array([np.nan if v is None else v for v in document[key]], dtype=np.float64)
            for key in ("values", "std", "temperature_c", "rms")
        }
        names = tuple(str(name) for name in document["names"])
        if any(len(arrays[key]) != len(names) for key in ("values", "std", "temperature_c")):
            raise ValueError(f"{len(names)} names, {len(arrays['values'])} values")
        response = np.array(document["response"], dtype=np.float64)
        if response.shape != (len(names), len(names)):
            raise ValueError(f"response of shape {response.shape} for {len(names)} names")
        blocks = np.array(document["blocks"], dtype=np.float64)
        if blocks.ndim != 2 or blocks.shape[1] != len(names):
            raise ValueError(f"blocks of shape {blocks.shape} for {len(names)} names")
        return Features(
            names, arrays["values"], arrays["std"], arrays["temperature_c"], arrays["rms"],
            int(document["samples"]), response, blocks,
        )  # fmt: skip


def feature_names(joint_names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the features, in the order of the arrays of `Features`."""
    joints = (f"{joint} {what}" for joint in joint_names for what in JOINT_FEATURES)
    return (*joints, *(f"load {what}" for what in LOAD_FEATURES))


def features_of(model: RobotEstimator, data: Dataset) -> Features:
    """Return the features of a probe, computed from its trajectories under a model.

    Args:
        model: Champion; its prediction must have a friction component.
        data: Dataset of whole series of some seconds each, in which all joints move.

    Raises:
        DataError: The data belong to a different robot or are too short, or the model has no
            friction component.
    """
    prediction = model.predict(data)
    if "friction" not in prediction.components:
        raise DataError(
            f"{model.estimator} does not predict friction separately",
            hint="use a champion of rigid-hysteresis, rigid-wls or another rigid estimator",
        )
    residual = filtered_effort(data) - prediction.effort
    valid = prediction.valid & np.isfinite(residual)
    weights = valid / np.maximum(model.sigma_, np.finfo(np.float64).tiny)
    X = _columns(model, data, prediction.effort, prediction.components["friction"])
    X *= weights[:, :, None]
    y = np.where(valid, residual, 0.0) * weights
    sums = [(_gram(X[rows]), _moment(X[rows], y[rows])) for rows in _blocks(data)]
    if len(sums) < FEWEST_DRIFT_BLOCKS:
        raise DataError(
            f"a probe of {len(sums)} blocks of {DRIFT_BLOCK_S:.0f} s is too short to detect a "
            f"change, {FEWEST_DRIFT_BLOCKS} blocks are required",
            hint="use trajectories of at least "
            f"{FEWEST_DRIFT_BLOCKS * DRIFT_BLOCK_S:.0f} s in total",
        )
    n = len(model.joint_names_)
    values, std, response, blocks = _estimated(sums, n)
    return Features(
        feature_names(model.joint_names_), values, std, _temperatures(data, n),
        _rms(residual, valid), int(np.sum(np.any(valid, axis=1))), response, blocks,
    )  # fmt: skip


def _columns(
    model: RobotEstimator, data: Dataset, effort: FloatArray, friction: FloatArray
) -> FloatArray:
    """Return the derivatives (N, n, K) of the residual with respect to every feature."""
    samples, n = effort.shape
    X = np.zeros((samples, n, len(JOINT_FEATURES) * n + len(LOAD_FEATURES)))
    for j in range(n):
        at = len(JOINT_FEATURES) * j
        X[:, j, at], X[:, j, at + 1], X[:, j, at + 2] = friction[:, j], effort[:, j], 1.0
    motion = [_smoothed(data, name) for name in ("q", "qd", "qdd")]
    load = model.robot_.payload_regressor(*motion).reshape(samples, n, -1)
    load = load[:, :, : len(LOAD_FEATURES)]
    X[:, :, -len(LOAD_FEATURES) :] = load / model.torque_scale_[None, :, None]
    return X


def _smoothed(data: Dataset, name: str) -> FloatArray:
    """Return the filtered column `name` of the data, or else the measured column, or else zeros."""
    for column in (f"{name}_f", name):
        if column in data.columns:
            return np.asarray(data[column])
    return np.zeros_like(data["q"])


def _gram(X: FloatArray) -> FloatArray:
    flat = X.reshape(-1, X.shape[-1])
    return flat.T @ flat


def _moment(X: FloatArray, y: FloatArray) -> FloatArray:
    return X.reshape(-1, X.shape[-1]).T @ y.reshape(-1)


def _blocks(data: Dataset) -> Iterator[slice]:
    """Yield the row numbers of blocks of about `DRIFT_BLOCK_S`, each within one series."""
    for _, rows in data.slices():
        if rows.stop - rows.start < 2:
            continue
        t = data["t"][rows]
        count = max(1, round(float(t[-1] - t[0]) / DRIFT_BLOCK_S))
        edges = np.linspace(rows.start, rows.stop, count + 1).round().astype(int)
        yield from (slice(a, b) for a, b in pairwise(edges))


def _estimated(
    sums: Sequence[tuple[FloatArray, FloatArray]], n: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return values, jackknife standard deviations, response and values per block of features."""
    gram, moment = (np.sum([one[k] for one in sums], axis=0) for k in (0, 1))
    values, response = _alone(gram, moment, n), _alone(gram, gram, n)
    count = len(sums)
    left = np.array([_alone(gram - g, moment - m, n) for g, m in sums])
    variance = (count - 1) / count * np.sum((left - left.mean(axis=0)) ** 2, axis=0)
    return values, np.sqrt(variance), response, count * values - (count - 1) * left


def _alone(gram: FloatArray, moment: FloatArray, n: int) -> FloatArray:
    """Return each feature (K, …), estimated as if it were the only change apart from offsets."""
    per = len(JOINT_FEATURES)
    out = np.zeros_like(moment)
    for j in range(n):
        friction, gain, offset = range(per * j, per * j + per)
        for feature, beside in ((friction, offset), (gain, offset), (offset, friction)):
            out[feature] = _solve(gram, moment, [feature, beside])[0]
    load = list(range(per * n, len(gram)))
    offsets = list(range(per - 1, per * n, per))
    out[load] = _solve(gram, moment, [*load, *offsets])[: len(load)]
    return out


def _solve(gram: FloatArray, moment: FloatArray, columns: Sequence[int]) -> FloatArray:
    """Solve the normal equations of selected columns, scaled to a unit diagonal."""
    part = gram[np.ix_(columns, columns)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(part), np.finfo(np.float64).tiny))
    right = (moment[columns].T * scale).T
    scaled = np.linalg.lstsq(part * scale[:, None] * scale, right)[0]
    solution: FloatArray = (scaled.T * scale).T
    return solution


def _temperatures(data: Dataset, n: int) -> FloatArray:
    if "temperature" not in data.columns:
        return np.full(len(JOINT_FEATURES) * n + len(LOAD_FEATURES), np.nan)
    joints = np.nanmean(data["temperature"], axis=0)
    whole = np.full(len(LOAD_FEATURES), np.mean(joints))
    return np.concatenate([np.repeat(joints, len(JOINT_FEATURES)), whole])


def _rms(residual: FloatArray, valid: BoolArray) -> FloatArray:
    squares: FloatArray = np.nanmean(np.where(valid, residual, np.nan) ** 2, axis=0)
    return np.sqrt(squares)
