"""`hil bench networks`: its truth of a torque's parts, its verdicts, what it says of failures."""

import sys
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

from hil.cli.bench import measure
from hil.data.prediction import Prediction
from hil.dynamics import load_model
from hil.studies.inverse_fits import nothing
from hil_mock_robot.plant.truth import draw_truth
from tests.support.paths import ROOT

PERFECT = 1.7
"""Gains [N·m/A] of models that know everything."""


@pytest.fixture(scope="module")
def parts():
    """Modules of the benchmark by the ends of their names."""
    sys.path.insert(0, str(ROOT))
    names = ("component_truth", "networks_mock", "networks_told", "networks_ur10e", "mock_truth")
    yield SimpleNamespace(
        **{name: import_module(f"benchmarks.identification.{name}") for name in names}
    )
    sys.path.remove(str(ROOT))
    for name in [name for name in sys.modules if name.startswith("benchmarks")]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def quick():
    pytest.importorskip("torch", reason="torch is not installed")
    return measure("networks", quick=True, parts=("mock",))


class Knowing:
    """A model that knows the truth, but for what is changed."""

    torque_scale_ = np.full(2, PERFECT)

    def __init__(self, true, *, mass=1.0, shift=0.0, friction=0.0):
        self._true, self._mass, self._shift, self._friction = true, mass, shift, friction

    def predict(self, _):
        gravity = self._true.gravity + self._shift
        friction = self._true.friction - self._shift + self._friction
        told = {"gravity": gravity, "friction": friction, "ripple": 0.0 * friction}
        told = {name: np.repeat(values, 8, axis=0) / PERFECT for name, values in told.items()}
        return Prediction(told["gravity"], told["gravity"], told["gravity"] > 0, told)

    def mass_matrix(self, q):
        return self._mass * self._true.mass[: len(q)]


@pytest.fixture
def true(parts):
    random = np.random.default_rng(3)
    q, gravity, friction = random.standard_normal((3, 40, 2))
    mass = np.repeat(np.array([[[2.0, 0.3], [0.3, 1.0]]]), 40, axis=0)
    return parts.component_truth.Parts(q, mass, gravity, friction, np.full(2, PERFECT))


def test_who_knows_the_truth_has_no_error_in_any_part(parts, true) -> None:
    found = parts.component_truth.component_errors(Knowing(true), None, true)
    assert found.mass == pytest.approx(0.0, abs=1e-12)
    assert np.concatenate([found.gravity, found.friction]) == pytest.approx(0.0, abs=1e-12)


def test_a_constant_may_be_gravity_or_friction(parts, true) -> None:
    found = parts.component_truth.component_errors(Knowing(true, shift=5.0), None, true)
    assert np.concatenate([found.gravity, found.friction]) == pytest.approx(0.0, abs=1e-12)


def test_an_error_is_told_of_the_part_that_has_it(parts, true) -> None:
    off = np.tile([[0.5], [-0.5]], (20, 2))
    found = parts.component_truth.component_errors(
        Knowing(true, mass=1.1, friction=off), None, true
    )
    assert found.mass == pytest.approx(0.1)
    assert found.friction == pytest.approx(0.5)
    assert found.gravity == pytest.approx(0.0, abs=1e-12)


def test_wrong_gains_are_no_error_of_what_was_learned(parts, true) -> None:
    model = Knowing(true, mass=1.2)
    model.torque_scale_ = np.full(2, 1.2 * PERFECT)
    assert parts.component_truth.component_errors(model, None, true).mass == pytest.approx(0.0)


def test_true_parts_are_those_of_another_physics(parts) -> None:
    truth, robot = draw_truth("ur5", 7, "full"), load_model("ur5")
    motion = np.random.default_rng(1).uniform(-2.0, 2.0, (3, 1600, 6))
    current = np.zeros((1600, 6))
    test = dict(zip(("q_f", "qd_f", "qdd_f"), motion, strict=True))
    found = parts.component_truth.true_parts(truth, test, current)
    inertial, still = parts.mock_truth.true_parameters(truth), np.zeros((200, 6))
    q = motion[0][::8]
    assert found.gravity == pytest.approx(robot.torque(inertial, q, still, still), abs=1e-5)
    unit = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (200, 1))
    third = robot.torque(inertial, found.q, still, unit) - robot.torque(
        inertial, found.q, still, still
    )
    assert found.mass[:, :, 2] == pytest.approx(third, abs=1e-5)
    rigid = robot.torque(inertial, *(values[::8] for values in motion))
    assert found.friction == pytest.approx(-rigid, abs=1e-4)


def contest(parts, errors, oracle=0.1):
    told = {}
    for key, error in errors.items():
        one = nothing(6, "" if np.isfinite(error) else "it did not converge")
        one.filtered[:] = error
        told[key] = parts.networks_mock.Told(one)
    return parts.networks_mock.Contest(5, told, np.full(6, oracle), np.full(6, oracle))


def test_ours_is_judged_by_the_best_of_six_and_the_noise(parts) -> None:
    one = contest(parts, {"wls": 1.1, "delan": 9.0, "proposed": 0.5, "ours": 0.3})
    assert one.best == "wls"
    assert one.left("ours") == pytest.approx(0.3 / 1.1)
    assert one.gap_left("ours") == pytest.approx(0.2)


def test_the_worst_robot_decides_and_a_goal_that_is_met_is_1_or_less(parts) -> None:
    errors = {"wls": 1.0, "proposed": 1.0, "rc-grouped": 0.75, "ours": 0.45, "ours-residual": 0.3}
    both = [contest(parts, errors), contest(parts, errors | {"rc-grouped": 0.9})]
    ratios = parts.networks_told.told_of_robots(both).ratios
    assert ratios["worst_ours_error_to_goal"] == pytest.approx(1.0)
    assert ratios["worst_ours_residual_error_to_goal"] == pytest.approx(0.3 / 0.45)
    assert ratios["worst_rc_error_to_goal"] == pytest.approx(1.2)


def test_a_method_that_failed_is_told_and_wins_nothing(parts) -> None:
    one = contest(parts, {"wls": 1.0, "irls": float("nan"), "ours": 0.4})
    section = parts.networks_told.told_of_robots([one])
    assert one.best == "wls"
    assert list(section.skipped.values()) == ["it did not converge"]
    assert "worst_rc_error_to_goal" not in section.ratios


@pytest.mark.parametrize("failed", ["ours", "ours-residual", "proposed", "rc-grouped"])
def test_a_method_that_failed_on_one_robot_misses_its_goals(parts, failed) -> None:
    errors = {"wls": 1.0, "proposed": 1.0, "rc-grouped": 0.75, "ours": 0.4, "ours-residual": 0.3}
    both = [contest(parts, errors | {failed: float("nan")}), contest(parts, errors)]
    ratios = parts.networks_told.told_of_robots(both).ratios
    rc = failed in {"proposed", "rc-grouped"}
    missed = {"worst_rc_error_to_goal"} if rc else {
        f"worst_{failed.replace('-', '_')}_{goal}_to_goal" for goal in ("error", "gap_left")
    }  # fmt: skip
    assert {name for name, ratio in ratios.items() if ratio == np.inf} == missed
    assert len(ratios) == 5


def test_where_all_of_six_failed_no_goal_is_met(parts) -> None:
    one = contest(parts, {"wls": float("nan"), "ours": 0.3})
    ratios = parts.networks_told.told_of_robots([one]).ratios
    assert set(ratios.values()) == {np.inf}


def test_a_network_on_the_ur10e_is_its_mean_over_seeds_with_their_spread(parts) -> None:
    score = parts.networks_ur10e.Score
    noise = np.full(6, 0.09)
    found = [score(np.full(6, 0.11), np.full(6, x), noise, 2.0, "J1:dropped") for x in (0.05, 0.07)]
    section = parts.networks_told.told_of_ur10e({"ours-residual": found})
    assert section.figures["ur10e_ours_residual_filtered_a"] == pytest.approx(0.06)
    assert section.figures["ur10e_ours_residual_filtered_spread_a"] == pytest.approx(0.02 / 2**0.5)
    assert section.ratios["ur10e_ours_residual_filtered_to_goal"] == pytest.approx(0.07 / 0.06)
    assert [row[2] for row in section.tables[1].rows] == ["J1:dropped"] * 2


def test_without_torch_it_says_so(monkeypatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "torch is not installed" in measure("networks")["skipped"]["networks"]


@pytest.mark.thorough
def test_nothing_is_better_than_knowing_all_but_the_noise(quick) -> None:
    figures = quick["figures"]
    errors = {key: value for key, value in figures.items() if key.endswith("_rmse_nm")}
    assert {"seed1_wls_rmse_nm", "seed1_delan_coulomb_rmse_nm"} <= errors.keys()
    filtered = {key: value for key, value in errors.items() if "_raw_" not in key}
    assert min(filtered, key=filtered.__getitem__) == "seed1_oracle_rmse_nm"
    assert figures["seed1_ours_below"] > 0.5


@pytest.mark.thorough
def test_ours_knows_the_robot_by_its_parts(quick) -> None:
    assert quick["figures"]["seed1_ours_mass_error"] < 0.1
    assert quick["figures"]["seed1_ours_friction_nm"] < 0.5


@pytest.mark.thorough
def test_no_method_is_handed_the_truth(parts) -> None:
    data = parts.networks_mock.drawn(3, quick=True).case.learn
    assert not [name for name in data.columns if "true" in name]
