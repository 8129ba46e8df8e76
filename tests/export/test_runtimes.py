"""ONNX and PyTorch of arms and conditions that most models do not have."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.arms.payload import Payload  # noqa: E402
from hil.estimators import estimator, friction_library  # noqa: E402
from hil.export.agreement import Golden, largest_difference, load_row, scale_of  # noqa: E402
from hil.export.torch_export import export_torch  # noqa: E402
from hil.export.torch_modules import module_of  # noqa: E402
from tests.support.export_arms import ARMS, fitted_arm  # noqa: E402
from tests.support.synthetic_memory import remembering, stopping  # noqa: E402
from tests.support.synthetic_motion import nominal  # noqa: E402

SLIDES = ["rad", "m", "rad"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("arms")


def needs_onnx() -> None:
    for name in ("onnx", "onnxruntime", "onnxscript"):
        pytest.importorskip(name, reason=f"{name} is not installed")


@pytest.mark.thorough
@pytest.mark.parametrize("arm", ARMS)
def test_torch_says_what_the_model_of_any_arm_says(arm, folder, tmp_path) -> None:
    told = export_torch(fitted_arm(arm, folder), tmp_path / "a.pt2")
    assert float(told.checked.split()[4]) < 1e-12
    assert told.notes == (
        ("joints that slide: r; positions in m, efforts in N",) * (arm == "sliding")
    )


@pytest.mark.thorough
@pytest.mark.parametrize("arm", ARMS)
def test_onnx_says_what_the_model_of_any_arm_says(arm, folder, tmp_path) -> None:
    needs_onnx()
    from hil.export.onnx_export import export_onnx

    told = export_onnx(fitted_arm(arm, folder), tmp_path / "a.onnx")
    assert float(told.checked.split()[4]) < 1e-12


def test_units_are_told_joint_by_joint(folder) -> None:
    said = json.loads(module_of(fitted_arm("sliding", folder)).metadata()["units"])
    assert said["q"] == SLIDES
    assert said["qdd"] == [f"{one}/s2" for one in SLIDES]
    assert said["effort"] == ["N*m", "N", "N*m"]
    assert len(said["load"]) == 10
    turning = json.loads(module_of(fitted_arm("panda", folder)).metadata()["units"])
    assert turning["q"] == ["rad"] * 7


@pytest.mark.thorough
def test_other_names_than_pt2_are_warned_of(folder, tmp_path) -> None:
    told = export_torch(fitted_arm("panda", folder), tmp_path / "a.bin")
    assert told.notes == ("torch.export.load warns of other names than *.pt2",)


@pytest.mark.thorough
def test_joints_follow_their_temperature_as_predict_says(monkeypatch) -> None:
    params = {"consistent": False, "friction": ["core", "load", "temperature"]}
    data = remembering(1, 2, 3, celsius=(20.0, 45.0))
    model = estimator("rigid-hysteresis", **params).fit(data, nominal())
    traced = module_of(model)
    assert ("warmer_k", 6) in traced.state
    t, q, qd, qdd = stopping(5, 300)
    # Where `predict` sums velocities up, a program takes differences of positions.
    q = q[:1] + np.vstack([np.zeros(6), np.cumsum(0.5 * (qd[1:] + qd[:-1]), axis=0) * t[1]])
    celsius = np.linspace(20.0, 45.0, 300)[:, None] + np.arange(6.0)
    asked = remembering(5, celsius=(20.0, 45.0), samples=300)
    columns = {**asked.columns, "temperature": celsius, "q_f": q, "qd_f": qd, "qdd_f": qdd}
    asked = replace(asked, columns={**columns, "effort_f": asked["effort"]})
    monkeypatch.setattr(friction_library, "smoothed", lambda torque, *_, **__: torque)
    wanted = model.predict(asked).effort
    assert found(traced, (q, qd, qdd), celsius - model.law_.celsius) == pytest.approx(
        wanted,
        abs=1e-3,  # at reversals a program sees the way back a sample later
    )
    usual = found(traced, (q, qd, qdd), np.zeros_like(q))
    assert np.abs(usual - wanted).max() > 0.02


def found(traced, rows, warmer):
    """Efforts of a stream whose joints are so much warmer than in the training [K]."""
    start = 0
    for name, size in traced.state:
        if name == "warmer_k":
            break
        start += size
    state = torch.zeros(1, traced.state_size, dtype=torch.float64)
    load, efforts = torch.tensor(load_row(Payload())), []
    for *sample, warm in zip(*rows, warmer, strict=True):
        state[0, start : start + len(warm)] = torch.tensor(warm)
        effort, state = traced.module(*(torch.tensor(one[None]) for one in sample), load, state)
        efforts.append(effort[0].numpy())
    return np.array(efforts)


def test_a_joint_that_needs_nothing_does_not_make_rounding_a_fault() -> None:
    zeros, some = np.zeros((3, 1)), np.full((3, 1), 5.0)
    golden = Golden(zeros, zeros, zeros, np.hstack([zeros, some]), np.hstack([zeros, 2 * some]))

    def step(inputs):
        loaded = inputs[3][0, 0] > 0
        return [np.array([[1e-16, 5.0 * (1 + loaded)]])]

    assert largest_difference(step, golden, 0) < 1e-9
    assert scale_of(golden.bare, golden.loaded) == pytest.approx([1e-3, 10.0])


def test_what_is_no_number_is_endlessly_off() -> None:
    zeros = np.zeros((3, 1))
    golden = Golden(zeros, zeros, zeros, zeros + 1.0, zeros + 1.0)
    assert largest_difference(lambda _: [np.full((1, 1), np.nan)], golden, 0) == np.inf
