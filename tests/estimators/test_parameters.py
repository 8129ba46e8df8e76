"""Parameters of estimators: how classes declare them, and how slips are answered."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hil.core.errors import PluginError, SpecError
from hil.estimators import estimator
from hil.estimators.parameters import Parametrised, number, parameter, settings
from hil.estimators.rigid_linear import RigidWls
from hil.estimators.static_model import StaticWls
from hil.networks.lagrangian_settings import NetworkSettings
from hil.networks.training import TrainingSettings
from tests.support.every_estimator import kind_of

# Declarations


class Own(Parametrised):
    """Has a constructor of its own."""

    def __init__(self, *, width: float = 1.0) -> None:
        self.width = width


def test_parameters_beside_a_constructor_are_refused_when_the_class_is_made() -> None:
    told = r"Both declares gain, bias .* constructor .*Both\.__init__ ignores: remove .* keywords"
    with pytest.raises(TypeError, match=told):

        class Both(Parametrised):
            gain: float = parameter(2.0, number, doc="Of the loop.")
            bias: float = parameter(0.0, number, doc="Of the sensor.")

            def __init__(self, *, width: float = 1.0) -> None:
                self.width = width


def test_parameters_beside_an_inherited_constructor_are_refused_too() -> None:
    with pytest.raises(TypeError, match=r"Wider declares gain .* constructor Own\.__init__"):

        class Wider(Own):
            gain: float = parameter(2.0, number, doc="Of the loop.")


def test_parameters_of_a_mixin_beside_a_constructor_are_refused_too() -> None:
    class Gain:
        gain: float = parameter(2.0, number, doc="Of the loop.")

    with pytest.raises(TypeError, match=r"Mixed declares gain .* constructor .*Mixed\.__init__"):

        class Mixed(Gain, Parametrised):
            def __init__(self, *, width: float = 1.0) -> None:
                self.width = width


def test_a_constructor_of_its_own_may_fix_parameters_of_a_base() -> None:
    class Declared(Parametrised):
        gain: float = parameter(2.0, number, doc="Of the loop.")

    class Fixed(Declared):
        def __init__(self, *, width: float = 1.0) -> None:
            super().__init__(gain=5.0)
            self.width = width

    assert (Fixed().gain, Fixed(width=3.0).get_params()) == (5.0, {"width": 3.0})


# Estimators by name


def test_estimators_are_found_by_name_with_their_parameters() -> None:
    made = estimator("rigid-wls", sign_width=0.005)
    assert isinstance(made, RigidWls)
    assert made.get_params()["sign_width"] == 0.005


def test_an_unknown_estimator_comes_with_a_guess() -> None:
    with pytest.raises(PluginError, match="rigid-wsl") as caught:
        estimator("rigid-wsl")
    assert "'rigid-wls'" in caught.value.hint


def test_parameters_can_be_changed_one_by_one() -> None:
    assert StaticWls().set_params(form="paper").form == "paper"
    model = kind_of("lagrangian")().set_params(protocol="paper", friction="coulomb")
    assert (model.get_params()["protocol"], model.friction) == ("paper", "coulomb")
    with pytest.raises(SpecError):
        model.set_params(friction="none", protocol="other")
    assert model.friction == "coulomb"


def test_the_papers_filters_are_a_word_in_a_spec() -> None:
    assert estimator("rigid-wls", filters="paper").get_params()["filters"].effort == 50.0


# Values; test_conformance.py refuses what no parameter can be, for every estimator.

IMPOSSIBLE = [
    ("rigid-wls", {"sign_width": -0.1}, "sign_width is -0.1, but must be a number at least 0"),
    ("rigid-wls", {"sign_width": float("nan")}, "sign_width is nan"),
    ("rigid-wls", {"sign_width": "abc"}, "sign_width is 'abc', but must be a number"),
    ("rigid-wls", {"sign_width": True}, "sign_width is True"),
    ("rigid-wls", {"sign_width": [0.1]}, r"sign_width is \[0.1\]"),
    ("rigid-wls", {"weighted": "abc"}, "weighted is 'abc', but must be true or false"),
    ("rigid-wls", {"filters": {"velocity": -1}}, r"filters\.velocity: .*greater than 0"),
    ("rigid-wls", {"filters": {"speed": 1}}, "filters has no parameter 'speed'"),
    ("rigid-wls", {"filters": 3}, "filters: "),
    ("rigid-linear", {"method": "lasso"}, "method is 'lasso'"),
    ("rigid-linear", {"alpha": 0.1}, "alpha belongs to method ridge"),
    ("rigid-linear", {"covariance": "white"}, "covariance is 'white'"),
    ("rigid-diffnea", {"friction": "stribek"}, "friction is 'stribek'"),
    ("rigid-hysteresis", {"friction": ["nonsense"]}, "nonsense"),
    ("rigid-hysteresis", {"friction": "stribek"}, "stribek"),
    ("rigid-hysteresis", {"friction": ["load", 3]}, "3"),
    ("rigid-hysteresis", {"gear_ratio": 0.0}, "gear_ratio"),
    ("static-wls", {"current_term": True}, "form: paper"),
    ("static-wls", {"form": "papper"}, "form"),
    ("static-wls", {"rest_speed": 0.0}, "rest_speed"),
    ("static-linear", {"l1_ratio": 1.5}, "l1_ratio"),
    ("static-linear", {"standardise": 1}, "standardise"),
    ("static-linear", {"form": "shared", "current_term": True}, "current_term"),
    ("static-linear", {"form": "shared", "method": "lasso"}, "method"),
    ("static-hysteresis", {"lengths_rad": []}, "lengths_rad"),
    ("static-hysteresis", {"lengths_rad": "1e-4"}, "lengths_rad"),
    ("static-hysteresis", {"lengths_rad": [0.0]}, "lengths_rad"),
    ("static-hysteresis", {"gear_ratio": -1.0}, "gear_ratio"),
    ("static-mlp-lm", {"layers": [4, 8, 2]}, "layers"),
    ("static-mlp-lm", {"activations": ["relu", "linear"]}, "activations"),
    ("static-mlp-lm", {"inputs": "q2"}, "list of names"),
    ("static-mlp-lm", {"inputs": ["q2", "q2", "q3", "q4"]}, "twice"),
    ("static-mlp-lm", {"epochs": 0}, "epochs"),
    ("static-mlp-lm", {"validation_percent": 100}, "below 100"),
    ("static-mlp-lm", {"patience": 0}, "patience"),
    ("static-mlp-lm", {"precision": "half"}, "precision"),
    ("static-mlp-lm", {"form": "shared", "current_term": True}, "current_term"),
    ("static-mlp-lm", {"jobs": 0}, "jobs"),
    ("lagrangian", {"friction": "stribek"}, "friction is 'stribek'"),
    ("lagrangian", {"network": {"hiden": [3]}}, "network has no parameter 'hiden'"),
    ("lagrangian", {"training": {"epochs": 0}}, "training.epochs"),
    ("lagrangian", {"protocol": "theirs"}, "protocol is 'theirs'"),
    ("lagrangian", {"loops": 0}, "loops is 0"),
    ("lagrangian", {"validation_share": 2}, "validation_share is 2"),
    ("lagrangian", {"protocol": "paper", "direction": "dahl"}, "protocol is 'paper'.* hard sign"),
    ("lagrangian", {"friction_settings": {"unt": 0.2}}, "friction_settings: .* no parameter 'unt'"),
    ("lagrangian", {"friction_settings": {"unit": 0}}, "friction_settings: unit is 0"),
    (
        "lagrangian",
        {"friction_settings": {"speed_bounds": [0.1, 0.2]}},
        "settings: start_speed is 0.08",
    ),
    ("lagrangian", {"friction_settings": {"speed_bounds": [0.1]}}, "the lowest and the highest"),
    ("residual", {"network": {"dilations": []}}, "a list of at least one number"),
    ("lagrangian", {"friction_settings": ["offset"]}, r"friction_settings is \['offset'\]"),
    (
        "lagrangian",
        {"friction_settings": {"sign": "hard"}, "direction": "dahl"},
        "settings has a hard sign",
    ),
]
"""Of estimator, parameters, and what the answer says."""

WITHOUT_END = {
    "lagrangian": [
        {"seed": 10**30}, {"loops": 10**9}, {"network": 0}, {"network": []}, {"training": ""},
        {"network": {"hidden": [True]}}, {"network": {"scaled": 0}},
        {"network": {"hidden": [5000]}},
        {"training": {"epochs": True}}, {"training": {"epochs": "5"}},
        {"training": {"epochs": 2.5}},
        {"training": {"batch_size": 10**30}}, {"training": {"threads": 10**9}},
        {"training": {"seed": 10**30}}, {"training": {"loops": 10**9}},
    ],
    "residual": [
        *({"network": one} for one in (
            {"dilations": [10**9]}, {"dilations": [1, 2.5]}, {"kernel": 10**6}, {"crop": 10**9},
            {"channels": 10**9}, {"latency_s": 1e9}, {"every": 10**9},
        )),
        *({"base": base} for base in (
            "", [], {}, {"sign_width": 1}, {"estimator": 3}, "rigid-wls",
        )),
    ],
}  # fmt: skip
"""What no training could take."""


def innermost(params: dict[str, Any]) -> str:
    """The key that is wrong."""
    ((key, value),) = params.items()
    return innermost(value) if isinstance(value, dict) and value and key == "network" else key


ENDLESS = [(name, one, innermost(one)) for name, some in WITHOUT_END.items() for one in some]


@pytest.mark.parametrize(("name", "params", "message"), IMPOSSIBLE + ENDLESS)
def test_values_that_cannot_be_are_refused_at_once(
    name: str, params: dict[str, Any], message: str
) -> None:
    with pytest.raises(SpecError, match=message):
        kind_of(name)(**params)
    made = kind_of(name)()
    before = made.get_params()
    with pytest.raises(SpecError, match=message):
        made.set_params(**params)
    assert made.get_params() == before


@pytest.mark.parametrize(
    ("name", "given", "where", "meant"),
    [
        ("lagrangian", {"training": {"epoch": 5}}, "training", "epochs"),
        ("residual", {"training": {"epoch": 5}}, "training", "epochs"),
        ("lagrangian", {"network": {"hiden": [8]}}, "network", "hidden"),
        ("lagrangian", {"filters": {"ordr": 5}}, "filters", "order"),
    ],
)
def test_a_slip_inside_settings_is_answered_with_what_was_meant_and_what_there_is(
    name: str, given: dict[str, Any], where: str, meant: str
) -> None:
    (slip,) = given[where]
    told = f"^{name}: {where} has no parameter '{slip}' \\(it has .*\\b{meant}\\b"
    with pytest.raises(SpecError, match=told) as caught:
        estimator(name, **given)
    assert caught.value.hint == f"did you mean '{meant}'?"


def test_a_misspelt_group_is_guessed() -> None:
    with pytest.raises(SpecError) as caught:
        estimator("rigid-hysteresis", friction="stribek")
    assert "stribeck" in str(caught.value.hint)


@pytest.mark.parametrize(("coverage", "hint"), [(90, "0.9,"), (2.5, "0.025,"), (1, "0.5 is half")])
def test_a_share_in_percent_is_answered_with_the_share(coverage: float, hint: str) -> None:
    with pytest.raises(SpecError, match="coverage") as caught:
        estimator("residual", coverage=coverage)
    assert caught.value.hint.startswith(hint)


@pytest.mark.parametrize(("name", "near"), [("lagrangian", "friction"), ("residual", "residual")])
def test_rates_of_groups_that_there_are_not_are_refused_before_a_robot_moves(
    name: str, near: str
) -> None:
    wrong = near[:-2] + near[-1]
    with pytest.raises(SpecError, match=f"training.group_rates has '{wrong}'") as caught:
        estimator(name, training={"group_rates": {wrong: 2.0}})
    assert f"'{near}'" in caught.value.hint
    estimator(name, training={"group_rates": {near: 2.0}})


@pytest.mark.parametrize("sixty", [60.0, np.int64(60), np.float32(60), np.uint8(60)])
def test_a_whole_number_of_any_kind_is_one(sixty: Any) -> None:
    """What files and sweeps have for 60."""
    found = settings("training", {"epochs": sixty, "patience": sixty}, TrainingSettings)
    assert (repr(found.epochs), repr(found.patience)) == ("60", "60")
    assert repr(settings("network", {"hidden": [sixty]}, NetworkSettings).hidden) == "(60,)"
    for name in ("lagrangian", "residual"):
        kind_of(name)(training={"epochs": sixty, "batch_size": sixty})


@pytest.mark.parametrize("value", [True, np.True_, "5", b"5", 2.5, np.float64(2.5), np.nan, None])
def test_what_is_no_whole_number_is_not_taken_for_one(value: Any) -> None:
    for name in ("lagrangian", "residual"):
        with pytest.raises(SpecError, match=r"^training\.epochs"):
            kind_of(name)(training={"epochs": value})
    with pytest.raises(SpecError, match=r"^network\.hidden"):
        kind_of("lagrangian")(network={"hidden": [value]})
