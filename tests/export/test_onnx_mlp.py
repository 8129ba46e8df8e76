"""Chains of fully connected layers as ONNX: what they say, what they are made of, what is none."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import FitError
from hil.estimators import estimator
from hil.export.onnx_mlp import chain_of, export_onnx_mlp, onnxruntime_says
from tests.support.export_readers import onnx_metadata
from tests.support.synthetic_motion import dwelling, moving, nominal

onnx = pytest.importorskip("onnx", reason="onnx is not installed")
pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")

KNOWN_TO_TF38X0 = {"Gemm", "Tanh", "Relu", "Softplus", "Sin"}

STATIC = {
    "usual": {"layers": [4, 8, 5, 1]},
    "all joints": {"layers": [6, 8, 1], "inputs": ["q"]},
    "paper's layers": {"layers": [4, 6, 8, 1], "activations": ["linear", "tanh", "linear"]},
    "bent output": {"layers": [4, 6, 1], "activations": ["tanh", "tanh"]},
}
TRUNK = {
    "usual": {},
    "raw q": {"features": "raw", "activation": "tanh"},
    "head": {"gravity": "head", "activation": "relu", "diagonal": "relu"},
    "epsilon of M": {"epsilon_of": "mass", "epsilon": 0.01, "scaled": False},
}


def static(epochs=5, **options):
    data = dwelling(60, stiction_nm=2.0)
    return estimator("static-mlp-lm", epochs=epochs, **options).fit(data, nominal())


def learned(**network):
    pytest.importorskip("torch", reason="torch is not installed")
    training = {"epochs": 1, "batch_size": 300, "device": "cpu"}
    made = estimator("lagrangian", network={"hidden": [12, 9], **network}, training=training)
    return made.fit(moving(1, 2, 3), nominal())


def poses(count=40):
    return np.random.default_rng(3).uniform(-2.5, 2.5, (count, 6))


@pytest.mark.parametrize("options", STATIC.values(), ids=STATIC)
def test_a_static_network_says_its_friction(options, tmp_path) -> None:
    model = static(**options)
    written = export_onnx_mlp(model, tmp_path / "friction.onnx")
    q = poses()
    rest = np.zeros_like(q)
    wanted = model._parts_and_friction(q, rest, rest)["friction"]
    found = onnxruntime_says(written.out.read_bytes())(q)
    assert np.ptp(wanted, axis=0).min() > 1e-3
    assert found == pytest.approx(wanted, abs=1e-4 * np.abs(wanted).max())
    assert written.effort_unit == "A"


@pytest.mark.thorough
@pytest.mark.parametrize("options", TRUNK.values(), ids=TRUNK)
def test_a_trunk_gives_the_mass_matrix_by_the_formula_in_its_notes(options, tmp_path) -> None:
    model = learned(**options)
    written = export_onnx_mlp(model, tmp_path / "trunk.onnx")
    facts, q = onnx_metadata(written.out), poses()
    found = dict(
        zip(json.loads(facts["outputs"]), onnxruntime_says(written.out.read_bytes())(q).T,
            strict=True)
    )  # fmt: skip
    (formula,) = [note for note in json.loads(facts["notes"]) if note.startswith("M(q)")]
    unit = np.array(formula.split("unit = (")[1].split(")")[0].split(","), dtype=float)
    least = float(formula.split("unit_i·(")[1].split(" + ")[-1].split(")")[0])
    added = float(formula.split("Lᵀ + ")[1].split("·")[0]) if "identity" in formula else 0.0
    rectified = "max(d, 0)" in formula
    factor = np.zeros((len(q), 6, 6))
    for i in range(6):
        d = found[f"d{i + 1}"]
        bent = np.maximum(d, 0.0) if rectified else np.log1p(np.exp(d))
        factor[:, i, i] = unit[i] * (bent + least)
        for j in range(i):
            factor[:, i, j] = found[f"L{i + 1},{j + 1}"]
    mass = factor @ factor.swapaxes(1, 2) + added * np.eye(6)
    wanted = model.mass_matrix(q)
    assert mass == pytest.approx(wanted, abs=1e-4 * np.abs(wanted).max())


def test_the_slope_of_the_potential_is_the_torque_of_gravity(tmp_path) -> None:
    model = learned()
    from hil.networks.lagrangian import torques

    written = export_onnx_mlp(model, tmp_path / "trunk.onnx")
    at = json.loads(onnx_metadata(written.out)["outputs"]).index("V")
    says, q, step = onnxruntime_says(written.out.read_bytes()), poses(5), 1e-2
    rest = np.zeros_like(q)
    torque = torques(model._network(), q, rest, rest, rest)["gravity"]
    for joint in range(6):
        ahead, behind = q.copy(), q.copy()
        ahead[:, joint] += step
        behind[:, joint] -= step
        slope = (says(ahead)[:, at] - says(behind)[:, at]) / (2 * step)
        assert slope == pytest.approx(torque[:, joint], abs=2e-3 * np.abs(torque).max())


@pytest.mark.parametrize("make", [static, learned])
def test_the_graph_is_a_chain_of_what_such_runtimes_know(make, tmp_path) -> None:
    written = export_onnx_mlp(make(), tmp_path / "m.onnx")
    model = onnx.load(written.out)
    constants = {one.name for one in model.graph.initializer}
    at = model.graph.input[0].name
    for node in model.graph.node:
        assert node.op_type in KNOWN_TO_TF38X0
        assert [name for name in node.input if name not in constants] == [at]
        (at,) = node.output
    assert [at] == [one.name for one in model.graph.output]
    assert all(one.data_type == onnx.TensorProto.FLOAT for one in model.graph.initializer)
    assert model.opset_import[0].version == 13
    facts = onnx_metadata(written.out)
    names, units = json.loads(facts["outputs"]), json.loads(facts["output_units"])
    assert len(names) == len(units) == model.graph.output[0].type.tensor_type.shape.dim[1].dim_value
    assert json.loads(facts["inputs"]) == list(written.joint_names)


def test_the_file_tells_units_joint_by_joint_and_no_path(tmp_path, monkeypatch) -> None:
    model = static(layers=[4, 4, 1])
    geometry = model.robot_.joint_geometry()
    slides = replace(geometry, turns=np.arange(6) != 1)
    monkeypatch.setattr(model.robot_, "joint_geometry", lambda: slides)
    monkeypatch.setattr(model.robot_, "name", "/home/me/arms/arm.urdf")
    monkeypatch.setattr(model, "effort_kind_", "torque")
    facts = onnx_metadata(export_onnx_mlp(model, tmp_path / "m.onnx").out)
    assert json.loads(facts["input_units"]) == ["rad", "m"] + ["rad"] * 4
    assert json.loads(facts["output_units"]) == ["N·m", "N"] + ["N·m"] * 4
    assert facts["robot"] == "arm.urdf"


def test_inputs_beyond_positions_are_refused() -> None:
    model = static(layers=[5, 4, 1], inputs=["q2", "q3", "q4", "q5", "approach"])
    with pytest.raises(FitError, match="not all of which are positions"):
        chain_of(model)


def test_layers_that_multiply_are_refused() -> None:
    with pytest.raises(FitError, match="silu layers"):
        chain_of(learned(activation="silu"))
