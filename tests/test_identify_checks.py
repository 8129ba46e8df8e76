"""What static and rigid fits refuse before they compute anything."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_motion import GAINS, dwelling, moving, nominal

from hil.errors import DataError, FitError
from hil.identify import estimator
from hil.identify.motor import current_of

FITS = [
    ("static-wls", {}),
    ("static-wls", {"form": "paper"}),
    ("static-linear", {"method": "wls"}),
    ("static-inverse", {}),
    ("static-mlp-lm", {"layers": (4, 3, 1), "epochs": 2}),
    ("rigid-wls", {}),
]


def data_for(name):
    return moving(1, samples=100) if name == "rigid-wls" else dwelling(60)


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


def test_eq_16_is_not_solved_without_a_gain() -> None:
    with pytest.raises(DataError, match="K₁ above 0"):
        current_of(np.zeros(2), np.array([10.0, 0.0]), 0.0)
