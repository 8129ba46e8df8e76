"""Friction of networks over velocity: a curve where it is one, the same that they predict."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.lagrangian_models import lagrangian
from tests.support.residual_models import model
from tests.support.synthetic_motion import moving

pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.lagrangian_data import smooth_sign
from hil.report import run_figures as figures
from hil.report.predictions import predict_with

CURVES = {
    "stribeck": ("coulomb", "static", "viscous", "offset"),
    "stribeck hard": ("coulomb", "static", "viscous", "offset"),
    "coulomb": ("coulomb", "viscous", "offset"),
    "paper": ("coulomb", "static", "viscous"),
}


@pytest.mark.parametrize("case", CURVES)
def test_the_curve_is_the_friction_that_is_predicted(case: str) -> None:
    fitted, data = lagrangian(case), moving(9)
    found, qd = fitted.predict(data), data["qd_f"]
    curve = fitted.friction_curve(qd)
    told = found.components["friction"] * fitted.torque_scale_
    assert curve.torque == pytest.approx(told, abs=1e-4)
    assert curve.terms == CURVES[case]
    assert np.isnan(curve.std_error).all()


@pytest.mark.parametrize(
    ("case", "width"), [("stribeck double", 0.01), ("coulomb", 0.0), ("paper double", 0.0)]
)
def test_what_it_has_beyond_its_dry_part_is_viscous(case: str, width: float) -> None:
    fitted = lagrangian(case)
    f_v, alpha = fitted.intrinsic_["f_v"], fitted.intrinsic_.get("alpha", np.ones(6))
    qd = np.array([[-0.8], [0.0], [0.005], [0.5]]) * np.ones(6)
    curve = fitted.friction_curve(qd)
    sign = smooth_sign(qd, width)
    assert curve.torque - curve.dry == pytest.approx(sign * f_v * np.abs(qd) ** alpha)
    assert np.all(f_v != 0.0)


@pytest.mark.parametrize("case", ["stribeck dahl", "coulomb dahl", "dissipative", "unconstrained"])
def test_memory_and_learned_friction_are_no_curve(case: str) -> None:
    assert lagrangian(case).friction_curve(np.zeros((3, 6))) is None


def test_it_is_drawn_as_a_curve_without_a_band() -> None:
    motion = predict_with(lagrangian("stribeck"), moving(9)).friction.in_motion
    names = [curve.name for curve in figures.moving(motion, 0)]
    assert names[1:] == ["without its viscous part", "friction of the model"]


def test_of_physics_whose_networks_were_all_dropped_it_is_that_of_the_physics() -> None:
    kept, qd = model(), np.linspace(-1.0, 1.0, 5)[:, None] * np.ones(6)
    assert kept.friction_curve(qd) is None
    dropped = type(kept)()
    dropped.__dict__.update(kept.__dict__)
    none = np.zeros_like(kept.correction_.kept)
    dropped.correction_ = replace(kept.correction_, kept=none)
    assert np.array_equal(dropped.friction_curve(qd).torque, kept.base_.friction_curve(qd).torque)
    assert predict_with(dropped, moving(11)).friction.in_motion.curve is not None
    drawn = predict_with(kept, moving(11)).friction.in_motion
    assert drawn.curve is None
    assert drawn.learned
