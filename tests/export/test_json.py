"""Models as JSON: every parameter with its unit, and nothing made up about its certainty."""

from __future__ import annotations

import copy
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core import json_document
from hil.core.errors import FitError
from hil.dynamics import base_parameters, load_model
from hil.estimators import estimator, save_model
from hil.estimators.friction_library import groups
from hil.export import json_check, json_friction, json_parameters, json_reader
from hil.export.agreement import LOAD
from hil.export.json_check import checked
from hil.export.json_export import document_of, robot_part
from hil.export.json_friction import adapted, library_term
from hil.export.json_parameters import Spread, of_base
from hil.export.json_reader import rigid_torque
from tests.support.dynamics_arms import motion
from tests.support.export_models import KINDS, SLIDING, fitted, sliding_arm
from tests.support.paths import DOCS
from tests.support.synthetic_motion import dwelling, nominal

PAGE = (DOCS / "reference" / "export-json.md").read_text("utf-8")
HOW_TO = (DOCS / "how-to" / "export-parameters.md").read_text("utf-8")
ELBOW = "elbow_joint.coulomb"
FREE = {"settings", "filters", "training", "combination", "constants", "layout"}
"""Keys whose contents are somebody else's: settings of estimators, names of columns."""


@cache
def told(kind: str) -> dict[str, Any]:
    """The document of a model; not to be changed."""
    return document_of(fitted(kind))


def keys_of(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield key
            yield from () if key in FREE else keys_of(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from keys_of(inner)


def entry(document: dict[str, Any], name: str) -> dict[str, Any]:
    (found,) = [one for one in document["parameters"] if one["name"] == name]
    return found


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_a_document_tells_every_parameter_with_unit_and_certainty_or_why_not(kind: str) -> None:
    document, model = told(kind), fitted(kind)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    for one in document["parameters"]:
        assert all(one[key] for key in ("unit", "meaning", "column")), one
        assert bool(one["reason"]) == (one["std"] is None or one["interval_95"] is None)
    physics = getattr(model, "base_", model)
    named = {one["name"]: one for one in document["parameters"] if one["group"] != "gear"}
    if hasattr(physics, "std_error_"):
        names, stds = physics.parameter_names_, physics.std_error_
        for name, value, std in zip(names, physics.coefficients_, stds, strict=True):
            assert named[name]["value"] == value
            assert named[name]["std"] == (std if np.isfinite(std) else None)
    if hasattr(physics, "parameter_names_"):
        assert set(physics.parameter_names_) <= named.keys()


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_every_key_of_a_document_is_on_the_page(kind: str) -> None:
    missing = {key for key in keys_of(told(kind)) if f"`{key}`" not in PAGE}
    assert missing == set()


def test_intervals_are_those_of_the_model() -> None:
    model, document = fitted("rigid-linear"), told("rigid-linear")
    found = [entry(document, name)["interval_95"] for name in model.parameter_names_]
    assert np.array_equal(found, model.interval(0.95))


def slow(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.thorough)


@pytest.mark.parametrize(
    ("kind", "names", "reason"),
    [
        ("rigid-wls", ["elbow_joint.coulomb"], "no degrees of freedom"),
        ("rigid-linear ridge", ["elbow_joint.coulomb"], "by a penalty or by noise in the columns"),
        slow("rigid-lmi", ["elbow_joint.coulomb"], "std is that of least squares without them"),
        slow("rigid-irls", ["elbow_joint.exponent"], "not fitted by least squares"),
        slow("static-linear lasso", ["joint3.phi1", "elbow_joint.offset"], "a penalty"),
        ("static-inverse", ["elbow_joint.square"], "excluded from the fit"),
    ],
)
def test_no_uncertainty_is_made_up(kind: str, names: list[str], reason: str) -> None:
    for name in names:
        one = entry(told(kind), name)
        assert one["interval_95"] is None
        assert reason in one["reason"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "where"),
    [
        ("rigid-wls", ("robot", "flange", "placement", 2, 3)),
        ("rigid-irls", ("parameters", 0, "combination", "Izz_1")),
        ("rigid-irls", ("links", "values", 2, "mass_kg")),
        ("static-wls paper", ("parameters", 2, "waves", 0, 0)),
        ("lagrangian coulomb", ("parameters", 0, "value")),
    ],
)
def test_a_document_that_says_something_else_is_not_written(kind: str, where: tuple) -> None:
    bent = copy.deepcopy(told(kind))
    *path, last = where
    inner: Any = bent
    for step in path:
        inner = inner[step]
    inner[last] = "sin" if inner[last] == "cos" else 1.01 * inner[last]
    with pytest.raises(FitError, match="differ from the model's"):
        checked(fitted(kind), bent)


@pytest.mark.parametrize("arm", ["ur5", "panda", "tx40@motors", "sliding"])
def test_torques_from_a_documents_numbers_are_those_of_any_arm(arm: str) -> None:
    robot = sliding_arm() if arm == "sliding" else load_model(arm)
    base, random = base_parameters(robot), np.random.default_rng(0)
    beta = random.normal(size=base.rank)
    entries = list(of_base(robot, base, beta, "rigid", Spread.none(base.rank)))
    written = {"robot": robot_part(robot), "parameters": entries}
    document, q = json.loads(json_document(written)), motion(30, robot.n)
    wanted = (base.regressor(robot, *q) @ beta).reshape(30, robot.n)
    assert rigid_torque(document, *q) == pytest.approx(wanted, abs=1e-11)
    load = np.array([LOAD.mass, *LOAD.com, *LOAD.inertia])
    added = rigid_torque(document, *q, load=load) - rigid_torque(document, *q)
    assert added == pytest.approx(robot.payload_effort(LOAD, *q), abs=1e-11)


def test_units_are_those_of_joints_that_slide_and_limits_that_are_none_are_null(tmp_path) -> None:
    text = SLIDING.read_text("utf-8").replace('"x" type="revolute"', '"x" type="continuous"')
    (tmp_path / "a.urdf").write_text(text, "utf-8")
    robot = sliding_arm(tmp_path / "a.urdf")
    base = base_parameters(robot)
    entries = of_base(robot, base, np.ones(base.rank), "rigid", Spread.none(base.rank))
    units = {one["column"]: one["unit"] for one in entries}
    assert {units[column] for column in ("Ia_2", "Ia_3")} == {"kg", "kg·m²"}
    assert adapted("N·m·s/rad", slides=True) == "N·s/m"
    joints = json.loads(json_document(robot_part(robot)))["joints"]
    assert [joint["position_max"] for joint in joints] == [None, 3.0, 1.0]
    assert [joint["type"] for joint in joints] == ["revolute", "prismatic", "revolute"]


@pytest.mark.thorough
def test_every_column_of_the_friction_library_has_a_unit() -> None:
    model = fitted("rigid-hysteresis")
    for name in groups(ripple=True, temperature=True):
        count = model.law_.count(name)
        if name != "core":
            for column in [name] if count == 1 else [f"{name}.{i + 1}" for i in range(count)]:
                assert library_term(column).unit, column


def test_currents_without_gains_have_no_torques() -> None:
    bare = replace(dwelling(60), drive_gains=None)
    document = document_of(estimator("static-linear").fit(bare, nominal()))
    assert document["effort"]["torque_per_effort"]["values"] is None
    assert entry(document, "joint2.phi1")["unit"] == "A"


def test_estimators_from_elsewhere_have_their_numbers_told_and_nothing_more(monkeypatch) -> None:
    class NotThis:
        pass

    for module in (json_parameters, json_friction, json_check):
        monkeypatch.setattr(module, "RigidLinear", NotThis)
    document = document_of(fitted("rigid-linear"))
    assert document["checked"].startswith("not compared: an estimator that is unknown")
    one, like = entry(document, ELBOW), entry(told("rigid-linear"), ELBOW)
    assert (one["group"], one["unit"]) == ("unknown", "")
    assert document["friction"]["law"] == "unknown"
    assert "noise" not in document["friction"]["formula"]
    assert [one[key] for key in ("value", "std", "interval_95")] == [
        like[key] for key in ("value", "std", "interval_95")
    ]


def test_the_command_writes_one_file_with_the_fingerprint_of_the_folder(tmp_path: Path) -> None:
    folder, out = save_model(fitted("rigid-wls"), tmp_path / "model"), tmp_path / "model.json"
    command = ["export", str(folder), "--to", "json", "-o", str(out), "--json"]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    assert json.loads(done.stdout)["files"] == ["model.json"]
    document = json.loads(out.read_text("utf-8"))
    assert document == told("rigid-wls")
    stored = json.loads((folder / "model.json").read_text("utf-8"))
    assert document["model"]["fingerprint_sha256"] == stored["arrays_sha256"]


@pytest.mark.thorough
def test_the_how_to_runs_as_it_stands_there_without_hil(tmp_path: Path) -> None:
    (tmp_path / "parameters.json").write_text(json.dumps(told("rigid-wls")), "utf-8")
    shutil.copy(json_reader.__file__, tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", HOW_TO, re.DOTALL)
    told_last = "\nimport sys; print(effort.tolist(), 'hil' in sys.modules)"
    script = "\n".join(blocks) + told_last
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    effort, _, knows_hil = done.stdout.splitlines()[-1].rpartition(" ")
    model = fitted("rigid-wls")
    assert json.loads(effort)[0] == pytest.approx(model.stream().step(*np.zeros((3, 6))))
    assert knows_hil == "False"


def test_the_page_shows_entries_as_documents_have_them() -> None:
    (shown,) = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    excerpt = json.loads(shown)
    document = told("rigid-linear")
    assert excerpt.keys() <= document.keys()
    for one in excerpt["parameters"]:
        like = next(p for p in document["parameters"] if p["name"] == one["name"])
        assert list(one) == list(like)
        fixed = ("joint", "group", "unit", "column", "meaning", "reason")
        assert {key: one[key] for key in fixed} == {key: like[key] for key in fixed}
