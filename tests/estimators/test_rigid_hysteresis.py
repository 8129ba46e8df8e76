"""The default dynamic estimator on a UR5 whose friction remembers, simulated sample by sample."""

from __future__ import annotations

import json
from dataclasses import replace
from hashlib import sha256

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from hil.arms.payload import Payload
from hil.core.errors import DataError
from hil.data import Dataset
from hil.data.filters import filter_columns, prepare
from hil.dynamics import RobotModel
from hil.dynamics.inertial import is_consistent
from hil.estimators import estimator, load_model_file
from hil.estimators.friction_library import LOADED
from hil.estimators.friction_memory import carried_step, dahl_states
from hil.estimators.inertial_bounds import InertialBounds
from hil.estimators.payload import _filtered
from hil.estimators.rigid_hysteresis import BANDWIDTHS, MOTION_HZ, RigidHysteresis, filters_for
from tests.support.dynamics_arms import urdf, written
from tests.support.load_parts import undeclared
from tests.support.synthetic_memory import dahl_loop, remembering
from tests.support.synthetic_motion import GAINS, LOAD, dwelling, moving, nominal, plant, raw

NOISE_A = 0.02
GROUPS = ("core", "load", "speed p", "memory 30")


def made(**params):
    """One without choices, quickly."""
    fast = {"friction": GROUPS, "fit_shapes": False, "consistent": False}
    return estimator("rigid-hysteresis", **(fast | params))


def rms(model, test):
    return np.sqrt(np.mean((model.predict(test).effort - test["effort"]) ** 2, axis=0))


@pytest.fixture(scope="module")
def train():
    return remembering(1, 2, 3, noise_a=NOISE_A)


@pytest.fixture(scope="module")
def held_out():
    return remembering(9, noise_a=0.0)


@pytest.fixture(scope="module")
def fitted(train):
    return estimator("rigid-hysteresis").fit(train, nominal())


@pytest.fixture(scope="module")
def quick(train):
    return made(fit_shapes=True).fit(train, nominal())


@pytest.mark.thorough
def test_a_new_trajectory_is_predicted_near_the_noise(fitted, train, held_out) -> None:
    wls = rms(estimator("rigid-wls").fit(train, nominal()), held_out)
    ours = rms(fitted, held_out)
    assert np.all(ours < 0.2 * wls)
    assert np.mean(ours) < 1.5 * NOISE_A


@pytest.mark.thorough
def test_a_joint_at_rest_holds_what_friction_it_stopped_with(fitted, held_out) -> None:
    still = np.all(held_out["qd"] == 0.0, axis=1)
    assert 150 < still.sum() < 250
    error = (fitted.predict(held_out).effort - held_out["effort"])[still]
    assert np.mean(np.sqrt(np.mean(error**2, axis=0))) < 2.5 * NOISE_A


@pytest.mark.thorough
def test_links_can_exist_and_mass_matrices_are_positive_definite(fitted) -> None:
    bodies, rotors = np.split(fitted.inertial_, [60])
    assert np.all(is_consistent(bodies.reshape(6, 10)))
    assert rotors.shape == (6,)
    assert np.all(rotors >= 0.0)
    assert fitted._base.combine(fitted.inertial_) == pytest.approx(fitted.rigid_, abs=1e-6)
    still, robot = np.zeros((6, 6)), nominal()
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 6)):
        at = np.tile(q, (6, 1))
        M = robot.torque(fitted.inertial_, at, still, np.eye(6))
        M = M - robot.torque(fitted.inertial_, at, still, still)
        assert pytest.approx(M.T, abs=1e-9) == M
        assert np.linalg.eigvalsh(M)[0] > 0.0


def by_hand(model, data):
    """Effort of a model with `GROUPS` from formulas and a loop, nothing filtered."""
    q, qd, still = data["q"], data["qd"], np.zeros_like(data["q"])
    arrays = model.fitted_arrays()
    offset, viscous, coulomb, load, power, long = arrays["friction"].reshape(6, 6).T
    length, _, p, _ = arrays["shapes"]
    Y = model._base.regressor(nominal(), q, qd, still)
    gears = np.abs((Y @ arrays["gear_rigid"]).reshape(q.shape))
    friction = dahl_loop(q, length) * (coulomb + load * gears) + offset + viscous * qd
    friction += dahl_loop(q, 30.0 * length) * long + power * np.sign(qd) * np.abs(qd) ** p
    return ((Y @ arrays["rigid"]).reshape(q.shape) + friction) / GAINS


def streamed(model, data, load=None):
    stream, still = model.stream(load), np.zeros(6)
    return np.array(
        [stream.step(q, qd, still) for q, qd in zip(data["q"], data["qd"], strict=True)]
    )


@pytest.mark.thorough
def test_stream_is_the_model_sample_by_sample_without_filters(quick, held_out) -> None:
    assert streamed(quick, held_out) == pytest.approx(by_hand(quick, held_out), abs=2e-3)


@pytest.mark.thorough
def test_prediction_is_the_stream_through_the_filter_of_the_effort(quick, held_out) -> None:
    data, still = prepare(held_out, quick.filters_), np.zeros(held_out["q"].shape)
    parts = quick.predict(data.with_columns(qdd_f=still, qd_f=data["qd"])).components
    friction = streamed(quick, held_out) - parts["gravity"] - parts["inertia"]
    error = filter_columns(friction, data, quick.filters_) - parts["friction"]
    assert np.all(np.std(error, axis=0) < 0.03 * np.std(parts["friction"], axis=0))


@pytest.mark.thorough
def test_stream_remembers_the_way_and_time_does_not_wear_it(quick) -> None:
    q, still = np.zeros(6), np.zeros(6)

    def after(way, rest):
        stream = quick.stream()
        stream.step(q, still, still)
        stream.step(q + way, np.full(6, 1e-6), still)
        return [stream.step(q + way, still, still) for _ in range(rest)][-1]

    there = after(0.05, 1)
    assert np.array_equal(after(0.05, 200), there)
    assert np.all(there > after(-0.05, 1) + 0.05)


@pytest.mark.thorough
def test_stream_under_a_load_carries_it(quick) -> None:
    q, still = np.full(6, 0.7), np.zeros(6)
    more = quick.stream(LOAD).step(q, still, still) - quick.stream().step(q, still, still)
    loaded = plant().with_payload(LOAD).gravity(q[None]) - plant().gravity(q[None])
    assert more * GAINS == pytest.approx(loaded[0], abs=1e-9)


@pytest.mark.thorough
def test_a_declared_load_changes_friction_through_the_gears(quick) -> None:
    loaded = remembering(9, load=LOAD, noise_a=0.0)
    aware = quick.predict(loaded)
    bare = quick.predict(remembering(9, noise_a=0.0)).components["friction"]
    without = aware.effort - aware.components["friction"] + bare
    error, blind = (np.std(x - loaded["effort"], axis=0) for x in (aware.effort, without))
    assert np.all(error[1:3] < 0.9 * blind[1:3])


@pytest.mark.thorough
@pytest.mark.parametrize(
    "damage",
    [
        lambda facts, arrays: facts["friction"][2].__setitem__(1, "sorcery"),
        lambda facts, arrays: facts["friction"].pop(),
        lambda facts, arrays: facts["friction"][5].pop(),
        lambda facts, arrays: facts.pop("friction"),
        lambda facts, arrays: facts.pop("filters"),
        lambda facts, arrays: arrays.pop("gear_rigid"),
        lambda facts, arrays: arrays.update(rigid=arrays["rigid"][:-1]),
        lambda facts, arrays: arrays.update(friction=np.append(arrays["friction"], 0.0)),
        lambda facts, arrays: arrays.update(shapes=arrays["shapes"][:, :5]),
        lambda facts, arrays: arrays.update(shapes=arrays["shapes"][:3]),
        lambda facts, arrays: arrays.update(friction=arrays["friction"] * np.nan),
        lambda facts, arrays: arrays.update(rigid=arrays["rigid"] * np.inf),
    ],
)
def test_a_damaged_model_file_is_refused(quick, tmp_path, damage) -> None:
    folder = quick.save(tmp_path / "model")
    document = json.loads((folder / "model.json").read_text())
    arrays = load_file(folder / "model.safetensors")
    damage(document["fitted"], arrays)
    save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, folder / "model.safetensors")
    document["arrays_sha256"] = sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    (folder / "model.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"model\.json") as caught:
        load_model_file(folder)
    assert "fit the model again" in str(caught.value.hint)


# Robots, recordings and parameters that are not the usual


@pytest.fixture(scope="module")
def two():
    return remembering(1, 2, noise_a=0.0)


def test_the_core_need_not_be_named() -> None:
    assert estimator("rigid-hysteresis", friction=["load"]).friction == ("core", "load")
    assert estimator("rigid-hysteresis", friction=()).friction == ("core",)


@pytest.mark.thorough
def test_one_trajectory_is_noted_and_two_are_not(two) -> None:
    alone = made(friction="auto").fit(remembering(1), nominal())
    assert any("one trajectory only" in note for note in alone.notes_)
    assert made().fit(two, nominal()).notes_ == ()


@pytest.mark.thorough
def test_a_robot_of_a_urdf_has_no_ripple_unless_its_gear_ratio_is_given(two, tmp_path) -> None:
    robot = RobotModel.from_urdf(written(tmp_path, urdf("ur5")))
    plain = made(friction="auto").fit(two, robot)
    assert not any("ripple" in name for name in plain.parameter_names_)
    assert "ripple" not in plain.predict(two).components
    geared = made(friction=("load", "ripple 1"), gear_ratio=101.0).fit(two, robot)
    assert sum("ripple 1" in name for name in geared.parameter_names_) == 12
    assert "ripple" in geared.predict(two).components


@pytest.mark.thorough
def test_warm_joints_are_learnt_where_temperature_varied() -> None:
    ramp, other = (15.0, 45.0), (45.0, 15.0)
    warm = remembering(1, 2, celsius=ramp, noise_a=0.0)
    test = remembering(9, celsius=other, noise_a=0.0)
    groups = ("load", "memory 30", "temperature")
    model = made(friction=groups, fit_shapes=True).fit(warm, nominal())
    blind = made(friction=groups[:2], fit_shapes=True).fit(warm, nominal())
    assert np.all(rms(model, test)[[0, 2]] < 0.5 * rms(blind, test)[[0, 2]])


@pytest.mark.thorough
def test_temperature_with_gaps_is_left_alone(two) -> None:
    celsius = np.linspace(20.0, 40.0, len(two))[:, None] * np.ones(6)
    celsius[5, 3] = np.nan
    model = made(friction="auto").fit(two.with_columns(temperature=celsius), nominal())
    assert not any("temperature" in name for name in model.parameter_names_)
    assert np.all(np.isfinite(model.predict(two).effort))


def test_a_gap_in_the_temperature_that_is_predicted_with_stands_for_the_reference() -> None:
    warm = remembering(1, 2, celsius=(15.0, 45.0))
    model = made(friction=("temperature",)).fit(warm, nominal())
    gaps = warm.with_columns(temperature=np.full((len(warm), 6), np.nan))
    usual = warm.with_columns(temperature=np.full((len(warm), 6), 30.0))
    assert np.array_equal(model.predict(gaps).effort, model.predict(usual).effort)


@pytest.mark.thorough
def test_joints_that_transmit_next_to_nothing_have_no_load_columns() -> None:
    chosen = made(friction="auto").fit(remembering(1, 2, 3), nominal()).law_.chosen
    assert LOADED & set(chosen[1])
    assert LOADED & set(chosen[2])
    assert not LOADED & set(chosen[5])
    assert "memory 30" in chosen[5]


def test_dwells_are_predicted_with_gravity_and_offset(two) -> None:
    model = made().fit(two, nominal())
    parts = model.predict(dwelling(4)).components
    offsets = model.fitted_arrays()["friction"].reshape(6, 6)[:, 0] / model.torque_scale_
    assert parts["friction"] == pytest.approx(np.tile(offsets, (40, 1)), abs=1e-12)
    assert np.all(parts["inertia"] == 0.0)


@pytest.mark.parametrize("samples", [1, 5])
def test_a_series_too_short_for_the_filter_is_named(two, samples) -> None:
    short = remembering(9, samples=samples)
    for act in (
        lambda: made().fit(Dataset.concatenate([two, short]), nominal()),
        lambda: made().fit(two, nominal()).predict(short),
    ):
        with pytest.raises(DataError, match="t9"):
            act()


def test_filters_follow_the_motion_not_the_sample_rate() -> None:
    slow = raw(moving(1, samples=800))
    assert filters_for(slow).unit == "hz"
    assert filters_for(slow).velocity == filters_for(slow).acceleration == MOTION_HZ
    t = np.arange(800) / 100.0
    quick = slow.with_columns(qd=np.sin(2 * np.pi * 3.0 * t)[:, None] * np.ones(6))
    assert filters_for(quick).velocity == pytest.approx(BANDWIDTHS * 3.0, rel=0.2)
    assert filters_for(slow.with_columns(t=5.0 * t)).effort <= 0.75 * 10.0


# What labs bring: undeclared tools, noisy encoders, joints that warm up

FEW = ["load", "speed p"]
WARM_NM_A = 0.02
"""Current per kelvin and rad/s that the joints below need less when warm."""


@pytest.mark.thorough
def test_a_tool_that_was_not_declared_is_told_or_does_no_harm() -> None:
    train = [undeclared(remembering(i, load=LOAD)) for i in (1, 2, 3)]
    test = undeclared(remembering(9, load=LOAD))
    tight = RigidHysteresis(friction=FEW).fit(Dataset.concatenate(train), nominal())
    loose = RigidHysteresis(friction=FEW, consistent=False)
    loose.fit(Dataset.concatenate(train), nominal())
    error, least = (
        np.sqrt(np.mean((m.predict(test).effort - test["effort"]) ** 2)) for m in (tight, loose)
    )
    assert error < 1.2 * least or any("load" in note for note in tight.notes_)


@pytest.mark.thorough
def test_links_that_had_to_be_as_heavy_as_they_may_be_are_told() -> None:
    tool = Payload(15.0, (0.0, 0.0, 0.1))
    data = Dataset.concatenate([undeclared(remembering(i, load=tool)) for i in (1, 2)])
    model = RigidHysteresis(friction=FEW).fit(data, nominal())
    assert any("at their upper bound" in note for note in model.notes_)


def test_small_links_may_carry_a_tenth_of_the_arm() -> None:
    masses = nominal().parameters(rotor=False).reshape(6, 10)[:, 0]
    bounds = InertialBounds.nominal(nominal(), mass_factor=1.3)
    assert bounds.mass_max[-1] == pytest.approx(0.13 * masses.sum())
    assert bounds.mass_max[1] == pytest.approx(1.3 * masses[1])


def test_a_load_is_looked_for_through_the_filters_the_model_chose() -> None:
    model = RigidHysteresis(friction=FEW, consistent=False).fit(remembering(1, 2), nominal())
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
    return RigidHysteresis(friction=[*FEW, "temperature"], consistent=False).fit(
        Dataset.concatenate(parts), nominal()
    )


@pytest.mark.thorough
def test_without_temperatures_those_of_the_training_are_taken(warmed) -> None:
    test = warming(remembering(9), 41.0, 46.0)
    cold = replace(test, columns={k: v for k, v in test.columns.items() if k != "temperature"})
    known, assumed = warmed.predict(test).effort, warmed.predict(cold).effort
    at_30 = warmed.predict(test.with_columns(temperature=np.full_like(test["q"], 30.0))).effort
    assert np.max(np.abs(assumed - known)) < 0.4 * np.max(np.abs(at_30 - known))


@pytest.mark.thorough
def test_a_gap_in_the_temperatures_is_no_jump(warmed) -> None:
    test = warming(remembering(9), 41.0, 46.0)
    celsius = test["temperature"].copy()
    celsius[400:410] = np.nan
    gap = warmed.predict(test.with_columns(temperature=celsius)).effort
    assert np.max(np.abs(gap - warmed.predict(test).effort)) < 0.3
