"""External torques from momentum, on a UR5 whose efforts are known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from hil.control.collision_detection import GAP_S, MomentumObserver
from hil.core.errors import DataError, FitError, SpecError
from hil.estimators import estimator
from hil.export.identified_parameters import rigid_parameters
from tests.support import residual_models
from tests.support.synthetic_motion import GAINS, LOAD, dwelling, moving, nominal

PUSH = np.array([12.0, -20.0, 8.0, 3.0, -2.0, 1.0])
FIRST = 300
GAIN = 25.0


@pytest.fixture(scope="module")
def model():
    return estimator("rigid-wls").fit(moving(1, 2, 3), nominal())


def residuals(observer, data, push=None, gap=0.0):
    effort, t = data["effort"].copy(), data["t"].copy()
    t[FIRST:] += gap
    if push is not None:
        effort[FIRST:] -= push / GAINS  # what the drives need not give
    rows = zip(t, data["q"], data["qd"], effort, strict=True)
    return np.array([observer.update(*row).copy() for row in rows])


@pytest.mark.thorough
def test_without_contact_there_is_next_to_nothing(model) -> None:
    found = residuals(MomentumObserver(model), moving(9))
    assert np.abs(found).max() < 0.15  # of torques up to 100 N·m: steps of 10 ms


@pytest.mark.thorough
def test_a_push_comes_through_a_first_order_filter(model) -> None:
    data = moving(9)
    alone = residuals(MomentumObserver(model, gain=GAIN), data)
    found = residuals(MomentumObserver(model, gain=GAIN), data, PUSH) - alone
    since = data["t"] - data["t"][FIRST]
    expected = np.where(since >= 0, 1 - np.exp(-GAIN * (since + 0.005)), 0.0)
    np.testing.assert_allclose(found, expected[:, None] * PUSH, atol=0.02 * np.abs(PUSH).max())
    np.testing.assert_allclose(found[-1], PUSH, rtol=1e-3)


@pytest.mark.thorough
def test_a_load_is_seen_until_it_is_declared(model) -> None:
    data = moving(9, load=LOAD)
    unknown = residuals(MomentumObserver(model), data)
    known = residuals(MomentumObserver(model, LOAD), data)
    assert np.abs(unknown).max() > 8.0
    assert np.abs(known).max() < 0.2


@pytest.mark.thorough
def test_friction_with_memory_is_carried_along() -> None:
    """The stream's friction, whose load part hears a filtered acceleration."""
    data = moving(1, 2, 3)
    fast = {"friction": ("core", "load"), "fit_shapes": False, "consistent": False}
    model = estimator("rigid-hysteresis", **fast).fit(data, nominal())
    found = residuals(MomentumObserver(model), moving(9))
    assert np.sqrt(np.mean(found**2)) < 0.5


@pytest.mark.thorough
def test_after_a_pause_the_residual_starts_again(model) -> None:
    found = residuals(MomentumObserver(model), moving(9), PUSH, gap=2 * GAP_S)
    np.testing.assert_array_equal(found[FIRST], 0.0)
    np.testing.assert_allclose(found[-1], PUSH, atol=0.2)


def test_parameters_have_the_models_rigid_torques(model) -> None:
    data = moving(9)
    motion = (data["q"], data["qd"], data["qdd_f"])
    parts = model.predict(data).components
    expected = (parts["gravity"] + parts["inertia"]) * GAINS
    found = model.robot_.torque(rigid_parameters(model), *motion)
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.thorough
def test_a_residual_network_takes_part() -> None:
    """Its rigid body is that of its physics, whatever rate the network was trained at."""
    pytest.importorskip("torch")
    corrected = residual_models.model()
    assert np.any(corrected.correction_.kept)
    np.testing.assert_allclose(
        rigid_parameters(corrected), rigid_parameters(corrected.base_), atol=1e-9
    )
    data = moving(9, samples=340)
    alone = residuals(MomentumObserver(corrected), data)
    without = residuals(MomentumObserver(corrected.base_), data)
    assert np.abs(alone - without).max() > 0.05
    found = residuals(MomentumObserver(corrected), data, PUSH) - alone
    np.testing.assert_allclose(found[-1], PUSH, rtol=1e-3)


def test_a_model_of_rest_has_no_momentum() -> None:
    static = estimator("static-wls").fit(dwelling(60), nominal())
    with pytest.raises(FitError, match="inertia"):
        MomentumObserver(static)


def test_currents_without_gains_are_refused() -> None:
    bare = estimator("static-wls", form="paper").fit(
        replace(dwelling(60), drive_gains=None), nominal()
    )
    with pytest.raises(FitError, match="drive gains"):
        MomentumObserver(bare)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"q": np.full(6, np.nan)}, "position"),
        ({"qd": np.zeros(5)}, "velocity"),
        ({"effort": np.full(6, np.inf)}, "effort"),
        ({"t": 0.0}, "follows"),
        ({"t": np.nan}, "follows"),
    ],
)
def test_a_sample_that_cannot_be_is_an_error(model, change, problem) -> None:
    observer = MomentumObserver(model)
    still = {"q": np.zeros(6), "qd": np.zeros(6), "effort": np.zeros(6)}
    observer.update(0.0, **still)
    with pytest.raises(DataError, match=problem):
        observer.update(**({"t": 0.01} | still | change))


def test_a_gain_is_above_0(model) -> None:
    with pytest.raises(SpecError, match="gain"):
        MomentumObserver(model, gain=0.0)
