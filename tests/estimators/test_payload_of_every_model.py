"""A load adds RNEA(with) − RNEA(without) to every registered model, to some also friction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from hil.core import plugins
from hil.core.typing import FloatArray
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators import estimator
from hil.estimators.base import GROUP, RobotEstimator
from tests.support.synthetic_motion import LOAD, arriving, moving, nominal

QUICK = {"epochs": 1, "batch_size": 300, "device": "cpu"}
PARAMETERS: Mapping[str, dict[str, Any]] = {
    "lagrangian": {"network": {"hidden": [12, 9]}, "training": QUICK},
    "residual": {"base": {"estimator": "rigid-wls"}, "folds": 2, "training": {"epochs": 1}},
    "static-mlp-lm": {"epochs": 5},
    "static-inverse": {"form": "shared"},
}

ALSO: Mapping[str, set[str]] = {
    "rigid-hysteresis": {"friction"},
    "static-hysteresis": {"friction", "drive"},
}
"""Other parts of a prediction that a load may change; docs/reference/estimators.md names them."""

NAMES = plugins.names(GROUP)
ROUNDING = 1e-9


def at_rest(model: RobotEstimator) -> bool:
    return "dwell" in model.series_kinds[0]


@cache
def fitted(name: str) -> RobotEstimator:
    if name in {"lagrangian", "residual"}:
        pytest.importorskip("torch", reason="torch is not installed")
    made = estimator(name, **PARAMETERS.get(name, {}))
    recorded = arriving(100, seed=1, load_share=0.05) if at_rest(made) else moving(1, 2, 3, 4)
    return made.fit(recorded, nominal())


def new(model: RobotEstimator) -> Dataset:
    return arriving(10, seed=5) if at_rest(model) else moving(9)


def loaded(data: Dataset) -> Dataset:
    return replace(data, conditions=tuple(replace(c, payload=LOAD) for c in data.conditions))


def motion(model: RobotEstimator, data: Dataset) -> tuple[FloatArray, FloatArray, FloatArray]:
    q = data["q"]
    return (q, 0 * q, 0 * q) if at_rest(model) else (q, data["qd_f"], data["qdd_f"])


def added(model: RobotEstimator, data: Dataset) -> FloatArray:
    """RNEA(with) − RNEA(without) in units of the effort."""
    bare = RobotModel.from_arm("ur5")
    with_load = bare.with_payload(LOAD).inverse_dynamics(*motion(model, data))
    return (with_load - bare.inverse_dynamics(*motion(model, data))) / model.torque_scale_


@pytest.mark.thorough
@pytest.mark.parametrize("name", NAMES)
def test_a_declared_load_adds_its_rigid_torque_to_a_prediction(name: str) -> None:
    model = fitted(name)
    data = new(model)
    bare, under = model.predict(data), model.predict(loaded(data))
    parts = {part: under.components[part] - bare.components[part] for part in under.components}
    assert parts.pop("payload") == pytest.approx(added(model, data), abs=ROUNDING)
    changed = {part for part, change in parts.items() if np.max(np.abs(change)) > ROUNDING}
    assert changed <= ALSO.get(name, set())
    if not changed:
        assert under.effort - bare.effort == pytest.approx(added(model, data), abs=ROUNDING)


@pytest.mark.parametrize("name", NAMES)
def test_a_declared_load_adds_as_much_sample_by_sample(name: str) -> None:
    model = fitted(name)
    data = new(model)
    bare, under = model.stream(), model.stream(LOAD)
    # The first dwell, or as many samples of a motion as tell.
    several = int(data.offsets[1]) if at_rest(model) else 40
    rows = list(zip(*motion(model, data), strict=True))[:several]
    difference = np.array([under.step(*sample) - bare.step(*sample) for sample in rows])
    wanted = added(model, data)[: len(rows)]
    if name in ALSO:
        assert difference == pytest.approx(wanted, abs=0.1 * np.max(np.abs(wanted)))
    else:
        assert difference == pytest.approx(wanted, abs=ROUNDING)


@pytest.mark.parametrize("name", ALSO)
def test_what_grows_with_the_load_is_seen_to_grow(name: str) -> None:
    model = fitted(name)
    data = new(model)
    bare, under = model.predict(data), model.predict(loaded(data))
    beyond = under.effort - bare.effort - added(model, data)
    assert np.nanmax(np.abs(beyond)) > 1e-3
