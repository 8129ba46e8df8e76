"""Exported files read back by what their users have, to be held against the model."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms.payload import Payload
from hil.core.typing import FloatArray
from hil.estimators.base import RobotEstimator, motion_of
from hil.export.agreement import load_row, scale_of
from hil.export.json_reader import friction_torque, rigid_torque, torque_per_effort
from tests.support.c_programs import Build

Motion = tuple[FloatArray, FloatArray, FloatArray]
Loads = Sequence[Payload]
Efforts = Callable[[Motion, Loads], FloatArray]
"""q, qd, qdd (N, n) and what is mounted at each sample → (N, n), from the start of the state."""


def streamed(model: RobotEstimator, motion: Motion, load: Payload) -> FloatArray:
    """(N, n) efforts of the model in Python, sample by sample."""
    stream = model.stream(load)
    return np.array([stream.step(*row) for row in zip(*motion, strict=True)])


def off_by(found: FloatArray, expected: FloatArray) -> float:
    """Largest difference (N, n) as a share of each joint's largest value; NaN is endlessly off."""
    off = np.abs(found - expected).max(axis=0) / scale_of(expected)
    return float(np.nan_to_num(off, nan=np.inf).max())


def c_efforts(out: Path, build_in: Path, model: RobotEstimator) -> Efforts:
    """A folder of C, compiled once; the self-test in it has passed."""
    build = Build(out, build_in, flags=("-O0",))  # test_c.py optimises
    assert build.self_test().startswith("largest difference")
    library = build.library(len(model.joint_names_))

    def efforts(motion: Motion, loads: Loads) -> FloatArray:
        library.reset()
        found, mounted = [], Payload()
        for *row, load in zip(*motion, loads, strict=True):
            if load != mounted:
                assert library.mount(load) == 0
                mounted = load
            found.append(library.step(*row))
        return np.array(found)

    return efforts


def traced_efforts(step: Callable[[list[FloatArray]], Any], state_size: int) -> Efforts:
    """A file of ONNX or PyTorch."""

    def efforts(motion: Motion, loads: Loads) -> FloatArray:
        state = [np.zeros((1, state_size))] * bool(state_size)
        found = []
        for *row, load in zip(*motion, loads, strict=True):
            effort, *state = step([*(one[None] for one in row), load_row(load), *state])
            found.append(effort[0])
        return np.array(found)

    return efforts


def json_efforts(document: dict[str, Any]) -> Efforts:
    """Return what computes efforts from an exported JSON file, without parts by networks."""

    def efforts(motion: Motion, loads: Loads) -> FloatArray:
        (load,) = set(loads)
        row = load_row(load)[0]
        through = rigid_torque(document, *motion, "gear", load=row)
        torque = rigid_torque(document, *motion, load=row)
        friction = friction_torque(document, motion[0], motion[1], through)
        return np.asarray((torque + friction) / torque_per_effort(document))

    return efforts


def parts_of(model: RobotEstimator, motion: Motion) -> dict[str, FloatArray]:
    """Parts of the model's torque (N, n) of a motion as it is, nothing mounted [N·m]."""
    t = np.arange(len(motion[0])) / 100.0
    parts = model.predict(motion_of(model, t, *motion)).components
    return {name: part * model.torque_scale_ for name, part in parts.items()}


def urdf_torques(path: Path, motion: Motion) -> FloatArray:
    """(N, n) gravity and inertia by plain Pinocchio; rotor inertias are taken from the file."""
    import pinocchio as pin

    arm = pin.buildModelFromUrdf(str(path))
    armature = np.zeros(arm.nv)
    for joint in ET.parse(path).getroot().iter("joint"):
        if (dynamics := joint.find("dynamics")) is not None:
            at = arm.joints[arm.getJointId(joint.get("name"))].idx_v
            armature[at] = float(dynamics.get("armature", "0"))
    arm.armature = armature
    data = arm.createData()
    return np.array([pin.rnea(arm, data, *row) for row in zip(*motion, strict=True)])


def facts_of(to: str, out: Path) -> dict[str, Any]:
    """Estimator, robot, joints and unit of efforts, as far as a file of that target has them."""
    if to == "c":
        header = (out / "hil.h").read_text("utf-8")
        estimator, robot = re.findall(r"/\* (\S+) of (.+)\. Written by hil", header)[0]
        (joints,) = re.findall(r"Joints: (.*?)\. ", header)
        unit = "A" if "fforts in A" in header else "N·m"
        return {"estimator": estimator, "robot": robot, "joints": joints.split(", "), "unit": unit}
    if to == "json":
        told = json.loads(out.read_text("utf-8"))
        return {
            "estimator": told["model"]["estimator"],
            "robot": told["robot"]["name"],
            "joints": [one["name"] for one in told["robot"]["joints"]],
            "unit": told["effort"]["unit"],
        }
    if to == "urdf":
        text = out.read_text("utf-8")
        joints = [
            one.get("name")
            for one in ET.fromstring(text).iter("joint")
            if one.get("type") != "fixed"
        ]
        found = re.search(r"<!-- identified: (\S+?)\.", text)
        return {"joints": joints} | ({"estimator": found[1]} if found else {})
    told = (torch_metadata if to == "torch" else onnx_metadata)(out)
    if to == "onnx-mlp":
        found = {name: told[name] for name in ("estimator", "robot")}
        return found | {"joints": json.loads(told["inputs"])}
    unit = told["effort_unit"].replace("*", "·")
    joints = json.loads(told["joint_names"])
    return {"estimator": told["estimator"], "joints": joints, "unit": unit}


def onnx_metadata(path: Path) -> dict[str, str]:
    """Return the `metadata_props` of an ONNX file."""
    import onnx

    return {one.key: one.value for one in onnx.load(path).metadata_props}


def torch_metadata(path: Path) -> dict[str, str]:
    """The extra file of a PyTorch program."""
    with zipfile.ZipFile(path) as archive:
        (name,) = (one for one in archive.namelist() if one.endswith("hil.json"))
        return dict(json.loads(archive.read(name)))
