"""Static models beside their JSON document: gravity, load, drive and friction at rest."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.data import POINTS, STEP_S
from hil.estimators import (
    StaticFriction,
    StaticInverse,
    StaticModel,
    dwells_of,
    estimator,
    has_current,
)
from hil.export.golden import LOAD, RATE_HZ, SAMPLES, motion
from hil.export.json_columns import Document, friction_torque, rest_states
from hil.export.json_read import of_joints, paper_gravity, rigid_torque, torque_per_effort

CELSIUS = 40.0
LOAD_ROW = np.array([LOAD.mass, *LOAD.com, *LOAD.inertia])

Compared = tuple[str, FloatArray, Callable[[Document], FloatArray]]


def at_rest(model: StaticModel) -> Iterator[Compared]:
    """What the model says at rest, and how the document says it, bare and with a load."""
    q = motion(model.robot_, SAMPLES, RATE_HZ)[0]
    for what, load in (("", None), (" with a load", LOAD)):
        if load is not None and not model.knows_gains:
            continue
        if isinstance(model, StaticInverse):
            yield _inverse(model, q, load, what)
        else:
            yield _linear(model, q, load, what)
    if isinstance(model, StaticFriction):
        yield "levels of dry friction", model.dry_friction()[None], _levels
        yield "levels as told", model.dry_friction()[None], lambda d: _array(d, "level_nm")


def _linear(model: StaticModel, q: FloatArray, load: Payload | None, what: str) -> Compared:
    paths, current = _paths(q), np.cos(3.0 * q) * model.sigma_
    data = dwells_of(model, q, load, effort=current, temperature=np.full_like(q, CELSIUS))
    if isinstance(model, StaticFriction):
        both = np.stack([paths, np.gradient(paths, STEP_S, axis=1)], axis=2)
        told = _uncorrected(model).predict(replace(data, arrivals=both))
    else:
        # As every static model does: without networks, which are not in the document.
        told = StaticModel.predict(model, data)

    def ours(document: Document) -> FloatArray:
        lengths = document["friction"]["constants"].get("lengths_rad", [])
        known = {"i": current, "T": np.full_like(q, CELSIUS), **rest_states(paths, lengths)}
        torque, through = _gravity(document, q, load), _gravity(document, q, load, "gear")
        own = friction_torque(document, q, np.zeros_like(q), through, known)
        return (torque + own) / torque_per_effort(document)

    return f"efforts at rest{what}", told.effort, ours


def _inverse(model: StaticInverse, q: FloatArray, load: Payload | None, what: str) -> Compared:
    """Eq. 16 with the model's currents gives the document's gravity, where there are such."""
    effort = StaticModel.predict(model, dwells_of(model, q, load)).effort
    k1, k2, k0 = model.constants_
    held = (k2 * np.abs(effort) + k1) * effort + k0
    there = has_current(held, k1, k2, k0)

    def ours(document: Document) -> FloatArray:
        k1, offset = torque_per_effort(document), of_joints(document, "offset")
        k2 = of_joints(document, "square")
        torque = (k2 * np.abs(effort) + k1) * effort - offset
        return np.asarray((torque - _gravity(document, q, load)) * there + held)

    return f"gravity of the currents by eq. 16{what}", held, ours


def _gravity(
    document: Document, q: FloatArray, load: Payload | None, group: str = "gravity"
) -> FloatArray:
    """(N, n) torque of the arm at rest and of what is mounted [N·m]."""
    still = np.zeros_like(q)
    mounted = None if load is None else LOAD_ROW
    if any("waves" in one for one in document["parameters"]):
        return paper_gravity(document, q) + rigid_torque(document, q, still, still, "", mounted)
    return rigid_torque(document, q, still, still, group, mounted)


def _paths(q: FloatArray) -> FloatArray:
    """(N, K, n) ways into poses from both sides: parabolas, which smoothing leaves as they are."""
    s = np.linspace(1.0, 0.0, POINTS)[None, :, None]
    return np.asarray(1e-3 * np.sign(np.sin(5.0 * q))[:, None] * s * (1.4 * s - 0.4))


def _uncorrected(model: StaticFriction) -> StaticFriction:
    """The same without a correction that was learnt."""
    plain = estimator(model.estimator, **model.get_params())
    assert isinstance(plain, StaticFriction)
    plain.robot_ = model.robot_
    plain.restore(model.fitted_arrays(), model.fitted_facts() | {"correction_penalty": []})
    return plain


def _levels(document: Document) -> FloatArray:
    """(1, n) from the parameters of Dahl's states."""
    names = [joint["name"] for joint in document["robot"]["joints"]]
    sums = np.zeros((1, len(names)))
    for one in document["parameters"]:
        if re.fullmatch("d|z[0-9]+", one["column"]):
            sums[0, names.index(one["joint"])] += one["value"]
    return np.abs(sums)


def _array(document: Document, key: str) -> FloatArray:
    return np.array([document["friction"][key]])
