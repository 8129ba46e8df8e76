"""Columns of JSON documents are formulas, and every number of a document counts."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from hil.core.errors import FitError
from hil.estimators import estimator
from hil.estimators.friction_library import column_names, groups
from hil.export import json_check
from hil.export.agreement import golden_of
from hil.export.json_check import comparisons, differences
from hil.export.json_export import document_of
from hil.export.json_friction import FORMS, NETWORK, library_term
from hil.export.json_reader import (
    CONSTANTS,
    column,
    friction_torque,
    rigid_torque,
    symbols_of,
    torque_per_effort,
)
from tests.support.export_models import KINDS, fitted
from tests.support.synthetic_motion import dwelling, nominal

SAMPLES = 60
HIDDEN = {
    "load_limit_nm": "no pose of the check bears more than twice the largest load in training",
    "power_width_rad_s": "counts only at exponents other than 1",
}
"""Constants that need not show though columns name them, and why."""
SYMBOLS = {key: name for name, key in CONSTANTS.items()} | {
    "usual_celsius": "T",
    "lengths_rad": "z1",
}


def test_columns_are_computed_as_they_are_written() -> None:
    known = {"v": np.array([-0.5, 2.0]), "vs": 0.5, "p": 0.25, "z": np.array([0.3, -1.0])}
    v, z = known["v"], known["z"]
    for text, wanted in {
        "1": 1.0,
        "z·exp(−|v|/(0.3·vs))": z * np.exp(-np.abs(v) / 0.15),
        "sign(v)·|v|^p": np.sign(v) * np.abs(v) ** 0.25,
        "v·(v² + vs²)^((p − 1)/2)": v * (v**2 + 0.25) ** -0.375,
        "max(|v|, 1)·|z|": np.maximum(np.abs(v), 1.0) * np.abs(z),
        "−v + 2·z": 2 * z - v,
    }.items():
        assert column(text, known) == pytest.approx(wanted), text


@pytest.mark.parametrize("wrong", ["v v", "v ? 2", "exp(v))"])
def test_columns_that_cannot_be_read_are_refused(wrong: str) -> None:
    with pytest.raises(ValueError, match="column"):
        column(wrong, {"v": 1.0})


@pytest.mark.thorough
def test_every_column_that_there_may_be_can_be_read() -> None:
    law = fitted("rigid-hysteresis").law_
    names = [
        c for g in groups(ripple=True, temperature=True) for c in column_names(g, law.count(g))
    ]
    terms = [library_term(name) for name in names]
    terms += [term for form in (*FORMS.values(), *NETWORK.values()) for term in form.values()]
    for term in terms:
        assert np.isfinite(column(term.column, dict.fromkeys(symbols_of(term.column), 0.5)))


@pytest.mark.thorough
def test_memory_stays_where_positions_go_against_the_velocity() -> None:
    """Noise of encoders, which golden vectors do not have, must not wear states away."""
    model, document = fitted("rigid-diffnea memory"), told("rigid-diffnea memory")[0]
    t = np.arange(300) / 250.0
    q = 0.5 * np.sin(t[:, None] * np.arange(1, 7) * 0.7)
    qd, noise = np.gradient(q, t, axis=0), np.random.default_rng(0).normal(size=q.shape)
    q, qdd = q + 2e-5 * noise, np.gradient(qd, t, axis=0)
    qd[200:] = 0.0
    stream = model.stream()
    theirs = np.array([stream.step(*row) for row in zip(q, qd, qdd, strict=True)])
    through = rigid_torque(document, q, qd, qdd, "gear")
    torque = rigid_torque(document, q, qd, qdd) + friction_torque(document, q, qd, through)
    assert torque / torque_per_effort(document) == pytest.approx(theirs, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "apart", [pytest.param(3, marks=pytest.mark.thorough), pytest.param(1, marks=pytest.mark.proof)]
)
def test_every_number_that_is_bent_is_noticed(kind: str, apart: int, monkeypatch) -> None:
    """Of each third joint and link, beginning with another one for the next kind; or of all."""
    model = fitted(kind)
    monkeypatch.setattr(json_check, "golden_of", lambda one: golden_of(one, SAMPLES))
    monkeypatch.setattr(json_check, "SAMPLES", SAMPLES)
    document = told(kind)[0]
    physics = getattr(model, "base_", model)
    compared = comparisons(physics, document)
    differences(physics, document, compared)
    joints = [joint["name"] for joint in document["robot"]["joints"]]
    first = [*KINDS].index(kind) % apart
    chosen = joints[first::apart]
    unnoticed = []
    for where in numbers(document):
        if where[0] == "parameters" and document["parameters"][where[1]]["joint"] not in chosen:
            continue
        if where[:2] == ("links", "values") and where[2] % apart != first:
            continue
        bent = copy.deepcopy(document)
        *path, last = where
        inner: Any = bent
        for step in path:
            inner = inner[step]
        inner[last] = 1.5 * inner[last] + 1.0
        try:
            differences(physics, bent, compared)
        except FitError:
            continue
        unnoticed.append(
            (where, document["parameters"][where[1]]["name"] if where[0] == "parameters" else "")
        )
    assert unnoticed == []


def numbers(document: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    """Where the numbers are that torques follow from."""
    columns = [
        symbols_of(one["column"]) for one in document["parameters"] if one["group"] != "shape"
    ]
    named = set().union(*columns)
    for k, one in enumerate(document["parameters"]):
        own = [
            symbols_of(other["column"]) for other in document["parameters"]
            if other["joint"] == one["joint"] and other["group"] != "shape"
        ]  # fmt: skip
        # Dahl's states z, z10, … have x0 for their length.
        seen = set().union(*own) | {"x0" for names in own if any(n[0] == "z" for n in names)}
        if _flat(document, one):
            continue
        if one["group"] != "shape" or one["column"] in seen:
            yield "parameters", k, "value"
    for j in range(len(document["robot"]["joints"])):
        if document["effort"]["torque_per_effort"]["values"] is not None:
            yield "effort", "torque_per_effort", "values", j
    for key, value in document["friction"]["constants"].items():
        if key in HIDDEN or SYMBOLS.get(key, "s") not in named:
            continue
        if value is not None:
            yield from _inside(("friction", "constants", key), value)
    if document["friction"]["level_nm"]:
        yield from _inside(("friction", "level_nm"), document["friction"]["level_nm"])
    if document["links"]["values"]:
        yield from _inside(("links", "values"), document["links"]["values"])
    yield "robot", "gravity_m_s2", 2
    yield "robot", "flange", "placement", 0, 3


def _flat(document: dict[str, Any], one: dict[str, Any]) -> bool:
    """A network hardly trained has next to no peak, whose shape single precision does not show."""
    values = {other["name"]: other["value"] for other in document["parameters"]}
    static, coulomb = (values.get(f"{one['joint']}.{word}", 1.0) for word in ("f_s", "f_c"))
    shape = one["name"].endswith((".v_s", ".delta_s"))
    return shape and abs(static - coulomb) < 1e-4 * coulomb


def _inside(where: tuple[Any, ...], value: Any) -> Iterator[tuple[Any, ...]]:
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _inside((*where, key), inner)
    elif isinstance(value, float):
        yield where


def test_gains_of_one_that_somebody_measured_are_gains() -> None:
    ones = replace(dwelling(60), drive_gains=np.ones(6), drive_gains_source="a bench")
    document = document_of(estimator("static-linear").fit(ones, nominal()))
    assert document["effort"]["torque_per_effort"]["values"] == [1.0] * 6
    assert {one["unit"] for one in document["parameters"]} == {"N·m"}


@cache
def told(kind: str) -> tuple[dict[str, Any]]:
    return (json.loads(json.dumps(document_of(fitted(kind)))),)
