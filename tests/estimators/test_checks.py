"""What static and rigid fits refuse before they compute anything."""

from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import FitError
from hil.dynamics import RobotModel
from hil.estimators import estimator
from hil.estimators.checks import require_plausible
from tests.support.bad_networks import LAGRANGIAN, RESIDUAL
from tests.support.synthetic_motion import GAINS, dwelling, moving, nominal

FITS = [
    ("static-wls", {}),
    ("static-wls", {"form": "paper"}),
    ("static-linear", {"method": "wls"}),
    ("static-inverse", {}),
    ("static-mlp-lm", {"layers": (4, 3, 1), "epochs": 2}),
    ("rigid-wls", {}),
    ("rigid-hysteresis", {}),
    ("lagrangian", LAGRANGIAN),
    ("residual", RESIDUAL),
]


def data_for(name):
    return dwelling(60) if name.startswith("static") else moving(1, samples=100)


def fit(name, params, data):
    return estimator(name, **params).fit(data, nominal())


@pytest.mark.parametrize(("name", "params"), FITS)
def test_an_effort_that_is_zero_throughout_is_refused(name, params) -> None:
    data = data_for(name)
    silent = {column: 0.0 * data[column] for column in data.columns if "effort" in column}
    with pytest.raises(FitError, match="0 in every row and joint"):
        fit(name, params, data.with_columns(**silent))


@pytest.mark.parametrize("gain", [0.0, -9.0, np.nan, np.inf])
@pytest.mark.parametrize(("name", "params"), FITS)
def test_drive_gains_that_cannot_be_are_refused_by_joint(name, params, gain) -> None:
    gains = np.array([*GAINS[:2], gain, *GAINS[3:]])
    with pytest.raises(FitError, match="must be finite and above 0, but elbow_joint") as told:
        fit(name, params, replace(data_for(name), drive_gains=gains))
    assert "drive_gains_nm_a" in told.value.hint


def test_a_target_that_is_zero_for_one_joint_is_fitted() -> None:
    """A torque-measuring arm in simulation: nothing pulls at a vertical axis."""
    data = dwelling(60)
    silent = data.with_columns(effort=data["effort"] * [0.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    for form in ("shared", "paper"):
        predicted = fit("static-wls", {"form": form}, silent).predict(silent).effort
        assert predicted[:, 0] == pytest.approx(0.0, abs=1e-9)


def spoiled(data, value):
    effort = data["effort"].copy()
    effort[37, 3] = value
    changed = {name: effort for name in data.columns if "effort" in name}
    return data.with_columns(**changed)


@pytest.mark.parametrize(("name", "params"), FITS)
def test_one_sample_that_cannot_be_is_refused_by_series_and_joint(name, params) -> None:
    data = spoiled(data_for(name), -1e6)
    series = data.conditions[data.series_index()[37]].id
    with pytest.raises(FitError, match=rf"wrist_1_joint .* -1e\+06 A in series {series}, "):
        fit(name, params, data)


def test_without_gains_or_limits_only_what_nobody_builds_is_refused() -> None:
    data = replace(dwelling(60), drive_gains=None)
    with pytest.raises(FitError, match="cannot be"):
        fit("static-wls", {"form": "paper"}, spoiled(data, 1e6))
    unlimited = RobotModel.from_arm("ur5")
    unlimited.effort_max = np.zeros(6)
    require_plausible(spoiled(data, 1e3), unlimited)
    with pytest.raises(FitError, match="cannot be"):
        require_plausible(spoiled(data, 1.1e6), unlimited)


def test_a_joint_at_its_limit_and_efforts_in_another_unit_are_no_outliers() -> None:
    data = dwelling(60)
    require_plausible(spoiled(data, 3 * nominal().effort_max[3] / GAINS[3]), nominal())
    require_plausible(data.with_columns(effort=1e3 * data["effort"]), nominal())
