"""What labs bring: tools nobody declared, noisy encoders, joints that warm up."""

from dataclasses import replace

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.data import Dataset
from hil.data.filters import prepare
from hil.estimators.consistent import InertialBounds
from hil.estimators.friction_memory import carried_step, dahl_states
from hil.estimators.payload import _filtered
from hil.estimators.rigid_hysteresis import RigidHysteresis
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import LOAD, nominal

GROUPS = ["load", "speed p"]
WARM_NM_A = 0.02
"""Current per kelvin and rad/s that the joints below need less when warm."""


def bare(data: Dataset) -> Dataset:
    """The same recording, with nobody having said that a load was mounted."""
    conditions = tuple(replace(c, payload=Payload()) for c in data.conditions)
    return replace(data, conditions=conditions)


@pytest.mark.thorough
def test_a_tool_that_was_not_declared_is_told_or_does_no_harm() -> None:
    train = [bare(remembering(i, load=LOAD)) for i in (1, 2, 3)]
    test = bare(remembering(9, load=LOAD))
    tight = RigidHysteresis(friction=GROUPS).fit(Dataset.concatenate(train), nominal())
    loose = RigidHysteresis(friction=GROUPS, consistent=False)
    loose.fit(Dataset.concatenate(train), nominal())
    error, least = (
        np.sqrt(np.mean((m.predict(test).effort - test["effort"]) ** 2)) for m in (tight, loose)
    )
    assert error < 1.2 * least or any("load" in note for note in tight.notes_)


def test_links_that_had_to_be_as_heavy_as_they_may_be_are_told() -> None:
    tool = Payload(15.0, (0.0, 0.0, 0.1))
    data = Dataset.concatenate([bare(remembering(i, load=tool)) for i in (1, 2)])
    model = RigidHysteresis(friction=GROUPS).fit(data, nominal())
    assert any("as heavy as they may be" in note for note in model.notes_)


def test_small_links_may_carry_a_tenth_of_the_arm() -> None:
    masses = nominal().parameters(rotor=False).reshape(6, 10)[:, 0]
    bounds = InertialBounds.nominal(nominal(), mass_factor=1.3)
    assert bounds.mass_max[-1] == pytest.approx(0.13 * masses.sum())
    assert bounds.mass_max[1] == pytest.approx(1.3 * masses[1])


def test_a_load_is_looked_for_through_the_filters_the_model_chose() -> None:
    model = RigidHysteresis(friction=GROUPS, consistent=False).fit(remembering(1, 2), nominal())
    test = remembering(9)
    seen = _filtered(model, test)["qd_f"]
    assert np.array_equal(seen, prepare(test, model.filters_)["qd_f"])
    assert not np.array_equal(seen, prepare(test)["qd_f"])


def test_noise_of_an_encoder_does_not_wear_a_streams_memory_away() -> None:
    rng = np.random.default_rng(0)
    way = np.concatenate([np.linspace(0, 0.2, 400), np.full(400, 0.2)])[:, None]
    qd = np.concatenate([np.full(400, 0.5), np.zeros(400)])[:, None]
    clean = dahl_states(np.diff(way, axis=0, prepend=way[:1]), np.array([3e-4]))
    noisy, last, steps = way + 2e-5 * rng.standard_normal(way.shape), None, []
    for q, v in zip(noisy, qd, strict=True):
        steps.append(carried_step(q, last, v))
        last = q
    carried = dahl_states(np.array(steps), np.array([3e-4]))
    assert carried[-1] == pytest.approx(clean[-1], abs=1e-3)
    naive = dahl_states(np.diff(noisy, axis=0, prepend=noisy[:1]), np.array([3e-4]))
    assert abs(naive[-1] - clean[-1]) > 0.3


def warming(data: Dataset, low: float, high: float) -> Dataset:
    celsius = np.linspace(low, high, len(data))[:, None] * np.ones(6)
    effort = data["effort"] - WARM_NM_A * (celsius - 30.0) * data["qd"]
    return data.with_columns(temperature=celsius, effort=effort)


@pytest.fixture(scope="module")
def warmed():
    parts = [warming(remembering(i), 35.0 + 3 * i, 40.0 + 3 * i) for i in (1, 2, 3)]
    return RigidHysteresis(friction=[*GROUPS, "temperature"], consistent=False).fit(
        Dataset.concatenate(parts), nominal()
    )


def test_without_temperatures_those_of_the_training_are_taken(warmed) -> None:
    test = warming(remembering(9), 41.0, 46.0)
    cold = replace(test, columns={k: v for k, v in test.columns.items() if k != "temperature"})
    known, assumed = warmed.predict(test).effort, warmed.predict(cold).effort
    at_30 = warmed.predict(test.with_columns(temperature=np.full_like(test["q"], 30.0))).effort
    assert np.max(np.abs(assumed - known)) < 0.4 * np.max(np.abs(at_30 - known))


def test_a_gap_in_the_temperatures_is_no_jump(warmed) -> None:
    test = warming(remembering(9), 41.0, 46.0)
    celsius = test["temperature"].copy()
    celsius[400:410] = np.nan
    gap = warmed.predict(test.with_columns(temperature=celsius)).effort
    assert np.max(np.abs(gap - warmed.predict(test).effort)) < 0.3
