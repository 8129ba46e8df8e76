"""Gravity and a friction network per joint, on dwells of a UR5 whose friction is known exactly."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import DataError, FitError, SpecError
from hil.data.splits import split
from hil.estimators.static_model import PAPER_PROTOCOL, StaticWls
from hil.networks.lm import ConstantInputWarning
from hil.networks.static_network import StaticMlpLm
from tests.support.synthetic_motion import GAINS, dwelling, nominal

POSITIONS = ["q2", "q3", "q4", "q5"]
STICTION_NM = 2.0


def dwells(seed=0, poses=80, **options):
    return dwelling(poses, seed=seed, stiction_nm=STICTION_NM, **options)


def with_friction_of_position(data):
    """A smooth friction that gravity cannot explain."""
    extra = 0.1 * np.sin(3 * data["q"][:, 1:2]) * np.ones(6)
    return data.with_columns(effort=data["effort"] + extra)


def small(**options):
    return StaticMlpLm(**{"layers": (4, 8, 1), "epochs": 60, "patience": 15} | options)


def sided(**options):
    return small(layers=(5, 6, 1), inputs=[*POSITIONS, "approach"], **options)


def error(model, data):
    return np.sqrt(np.mean((model.predict(data).effort - data["effort"]) ** 2, axis=0))


def test_friction_that_depends_on_position_is_learnt() -> None:
    train = with_friction_of_position(dwelling(150, noise_a=0.002))
    test = with_friction_of_position(dwelling(100, seed=5, noise_a=0.002))
    model = small(layers=(1, 8, 1), inputs=["q2"]).fit(train, nominal())
    gravity_only = StaticWls().fit(train, nominal())
    assert np.all(error(model, test) < 0.25 * error(gravity_only, test))


def test_stuck_friction_is_learnt_from_the_approach_and_not_without_it() -> None:
    train, test = dwells(both=True), dwells(seed=5)
    stuck = STICTION_NM / GAINS
    assert np.all(error(sided().fit(train, nominal()), test) < 0.1 * stuck)
    assert np.all(error(small().fit(train, nominal()), test) > 0.8 * stuck)


def test_parts_add_up_to_the_effort() -> None:
    data = dwells()
    prediction = sided().fit(data, nominal()).predict(data)
    assert list(prediction.components) == ["gravity", "offset", "payload", "friction"]
    assert sum(prediction.components.values()) == pytest.approx(prediction.effort)


def test_networks_stop_by_whole_poses_that_they_have_not_seen() -> None:
    data = dwells(both=True)
    model = small(validation_percent=25.0, seed=3).fit(data, nominal())
    held_out = split(data, "pose", 0.25, 3).test
    assert model.sigma_ == pytest.approx(error(model, held_out))
    assert all(result.stopped == "patience" for result in model.results_)


def test_without_validation_the_network_remembers_the_poses() -> None:
    train, test = dwells(poses=40), dwells(seed=5)
    model = small(layers=(4, 12, 12, 1), validation_percent=0, epochs=150).fit(train, nominal())
    assert np.all(error(model, train) < 0.3 * error(model, test))
    assert model.sigma_ == pytest.approx(error(model, train))


def test_averaging_gives_nearly_the_same_network() -> None:
    train, test = dwells(), dwells(seed=5)
    averaged, plain = (
        sided(averaging=a, validation_percent=0, epochs=8).fit(train, nominal()).predict(test)
        for a in (True, False)
    )
    assert averaged.effort == pytest.approx(plain.effort, abs=1e-6)


def test_an_input_that_varies_within_a_dwell_needs_all_rows() -> None:
    data = dwells()
    data = data.with_columns(qd=1e-3 * np.random.default_rng(0).normal(size=data["q"].shape))
    options = {"layers": (2, 4, 1), "inputs": ["q2", "qd2"], "epochs": 5, "validation_percent": 0}
    with pytest.raises(FitError, match="input 2 of 2 is not constant") as told:
        small(**options).fit(data, nominal())
    assert "averaging: false" in told.value.hint
    model = small(averaging=False, **options).fit(data, nominal())
    assert model.sigma_ == pytest.approx(error(model, data))


def test_a_joint_may_see_a_column_of_its_own() -> None:
    def sided_by_joint(seed):
        data = dwelling(150, seed=seed)
        side = np.random.default_rng(seed).choice([-1.0, 1.0], (150, 6))[data.series_index()]
        return data.with_columns(side=side, effort=data["effort"] + 0.2 * side)

    test = sided_by_joint(5)
    own = small(layers=(1, 3, 1), inputs=["own:side"]).fit(sided_by_joint(0), nominal())
    everybodys = small(layers=(6, 3, 1), inputs=["side"]).fit(sided_by_joint(0), nominal())
    for model in (own, everybodys):
        assert np.all(error(model, test) < 0.2 * 0.2)


def test_model_file_tells_how_each_network_was_trained(tmp_path) -> None:
    sided().fit(dwells(), nominal()).save(tmp_path / "model")
    told = json.loads((tmp_path / "model" / "model.json").read_text())["fitted"]["networks"]
    assert [network["joint"] for network in told] == list(dwells().joint_names)
    assert all(network["epochs"] >= network["best_epoch"] > 0 for network in told)


def test_a_callback_is_told_every_epoch_of_every_joint() -> None:
    model, told = small(epochs=5, validation_percent=0), []
    model.callback = told.append
    model.fit(dwells(), nominal())
    assert {(epoch.network, epoch.epoch) for epoch in told} == {
        (joint, k) for joint in range(6) for k in range(6)
    }


def test_rows_in_motion_are_not_valid() -> None:
    data = dwells()
    model = small(epochs=5).fit(data, nominal())
    moving = replace(
        data.with_columns(qd=np.full_like(data["q"], 0.5)),
        conditions=tuple(replace(c, kind="move") for c in data.conditions),
    )
    assert model.predict(data).valid.all()
    assert not model.predict(moving).valid.any()


def test_layers_that_are_set_later_are_those_that_are_trained() -> None:
    model = StaticMlpLm(layers=(4, 20, 20, 10, 1))
    assert model.set_params(layers=(4, 6, 1))._mlp.layers == (4, 6, 1)


def test_paper_protocol_is_said_wherever_the_model_shows() -> None:
    model = small(form="paper", current_term=True, epochs=5).fit(dwells(), nominal())
    assert model.protocol == PAPER_PROTOCOL
    with pytest.raises(FitError, match="streamed"):
        model.stream()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"layers": (5, 8, 1)}, "begins with 5"),
        ({"inputs": ["q2", "q3", "q4", "q9"]}, "no joint 9"),
        ({"inputs": ["q2", "q3", "q4", "humidity"]}, "humidity"),
        ({"inputs": ["q2", "q3", "q4", "own:t"]}, "one value per joint"),
    ],
)
def test_inputs_that_are_not_there_are_refused(options, told) -> None:
    with pytest.raises((FitError, DataError), match=told):
        small(**options).fit(dwells(), nominal())


def test_a_single_pose_cannot_be_held_out() -> None:
    data = dwells()
    one_pose = replace(data, conditions=tuple(replace(c, pose=0) for c in data.conditions))
    with pytest.raises(FitError, match="held out"):
        small().fit(one_pose, nominal())


def test_an_approach_that_is_always_the_same_is_warned_of() -> None:
    data = dwells()
    same = replace(data, conditions=tuple(replace(c, approach=1) for c in data.conditions))
    with pytest.warns(ConstantInputWarning, match="input 5"):
        sided(epochs=3).fit(same, nominal())


@pytest.mark.parametrize(
    "name", ["effort", "effort3", "effort_f", "own:effort", "own:effort_f", "effort_target2"]
)
def test_the_effort_is_no_input_in_any_of_its_forms(name) -> None:
    with pytest.raises(SpecError, match="or is computed from it"):
        StaticMlpLm(layers=(2, 3, 1), inputs=["q2", name])


def test_motion_and_temperature_are_inputs() -> None:
    names = ["q2", "qd3", "q_target", "qdd_target", "own:temperature", "approach", "side"]
    assert StaticMlpLm(inputs=names).inputs == names
