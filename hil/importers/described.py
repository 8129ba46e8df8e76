"""What a source says about its own samples: robot, loads, steps. Documents people may have edited.

Everything read here is looked at before it is used: a damaged document is one clear error, never
a number that is none deep inside a fit.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Collection, Iterator, Mapping
from typing import Any, Literal

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray, shown
from hil.data import SeriesKind
from hil.importers.series import Origin, StepNote
from hil.planning import DwellRule

_LISTS = ("joint_names", "drive_gains")


@contextlib.contextmanager
def reading(where: object) -> Iterator[None]:
    """Whatever does not fit inside, as a `DataError` that begins with `where`."""
    try:
        yield
    except KeyError as error:
        raise DataError(f"{where} lacks {error}") from error
    except (IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(f"{where} cannot be used: {shown(str(error), 200)}") from error


def mapping(value: Any, what: str) -> Mapping[str, Any]:
    """A JSON object. Raises `TypeError` for anything else."""
    if not isinstance(value, Mapping):
        raise TypeError(f"{what} is {shown(repr(type(value).__name__))}, not a mapping")
    return value


def number(value: Any, what: str) -> float:
    """A finite number. Raises `ValueError` for anything else."""
    if isinstance(value, bool | str) or not math.isfinite(found := float(value)):
        raise ValueError(f"{what} is {shown(repr(value))}, not a finite number")
    return found


def numbers(value: Any, what: str, length: int | None = None) -> tuple[float, ...]:
    """Finite numbers. Raises `ValueError` where there are others, or not `length` of them."""
    if not isinstance(value, list | tuple):
        raise ValueError(f"{what} is {shown(repr(value))}, not a list of numbers")
    found = tuple(number(item, what) for item in value)
    if length is not None and len(found) != length:
        raise ValueError(f"{what} has {len(found)} values, not {length}")
    return found


def vector(value: Any, what: str) -> tuple[float, float, float]:
    """Three finite numbers. Raises `ValueError` for anything else."""
    x, y, z = numbers(value, what, 3)
    return x, y, z


def robot_of_run(start: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a start document says about the robot; empty when nothing."""
    robot = start.get("robot")
    return robot if isinstance(robot, Mapping) else {}


def origin_of_run(start: Mapping[str, Any], source: str) -> Origin:
    """Whose samples a run holds. Raises `DataError` when its start document does not say."""
    with reading(f"{source}: what start.json says about the robot"):
        return _origin(mapping(start["robot"], "robot"), source)


def origin_of_import(robot: Mapping[str, str], source: str) -> Origin:
    """Whose samples an imported file holds; lists are JSON text there. Raises `DataError`."""
    with reading(f"{source}: what it says about the robot"):
        lists = {key: json.loads(robot[key]) for key in _LISTS if robot.get(key)}
        return _origin({**robot, **lists}, source)


def _origin(robot: Mapping[str, Any], source: str) -> Origin:
    model, names = robot["model"], robot["joint_names"]
    if not isinstance(model, str):
        raise TypeError(f"model is {shown(repr(model))}, not a name")
    if not (isinstance(names, list) and names and all(isinstance(one, str) for one in names)):
        raise TypeError(f"joint_names is {shown(repr(names))}, not a list of names")
    return Origin(
        source=source,
        robot=model,
        joint_names=tuple(names),
        effort_kind=_effort_kind(robot["effort_kind"]),
        drive_gains=_gains(robot.get("drive_gains"), len(names)),
        drive_gains_source=str(robot.get("drive_gains_source") or ""),
    )


def _effort_kind(kind: Any) -> Literal["current", "torque"]:
    if kind == "current":
        return "current"
    if kind == "torque":
        return "torque"
    raise ValueError(f"effort_kind is {shown(repr(kind))}, neither 'current' nor 'torque'")


def _gains(value: Any, n: int) -> FloatArray | None:
    return np.array(numbers(value, "drive_gains", n)) if value else None


def payload_of(raw: Mapping[str, Any]) -> Payload:
    """A load as documents hold it. Raises `KeyError`, `ValueError` or `TypeError`."""
    raw = mapping(raw, "the load")
    mass = number(raw["mass_kg"], "mass_kg")
    if mass < 0:
        raise ValueError(f"mass_kg is {mass:g}, less than nothing")
    ixx, iyy, izz, ixy, ixz, iyz = numbers(raw.get("inertia_kgm2", [0.0] * 6), "inertia_kgm2", 6)
    com = vector(raw.get("com_m", [0.0] * 3), "com_m")
    return Payload(mass, com, (ixx, iyy, izz, ixy, ixz, iyz))


def payload_of_import(record: Mapping[str, str] | None, where: str) -> Payload:
    """A load as a metadata record holds it, every value as JSON text. Raises `DataError`."""
    if not record:
        return Payload()
    with reading(where):
        return payload_of({key: json.loads(value) for key, value in record.items()})


def steps_of_plan(
    plan: Mapping[str, Any],
    where: object,
    unsettled: Collection[int],
    kinds: Collection[SeriesKind],
) -> dict[int, StepNote]:
    """What each step of a plan document measured, by its index.

    Raises:
        DataError: It is no plan.
    """
    with reading(f"{where} is no plan: it"):
        loads = [payload_of(load) for load in plan["loads"]]
        return {
            _index(step, "index"): _note(step, loads, unsettled)
            for step in plan["steps"]
            if mapping(step, "a step")["kind"] in kinds
        }


def _note(step: Mapping[str, Any], loads: list[Payload], unsettled: Collection[int]) -> StepNote:
    load = _index(step, "load", 0)
    if not 0 <= load < len(loads):
        raise ValueError(f"there is no load {load}")
    return StepNote(
        kind=step["kind"],
        trajectory=_index(step, "trajectory", -1),
        pose=_index(step, "pose", -1),
        approach=_index(step, "approach", 0),
        load=load,
        payload=loads[load],
        settled=step["index"] not in unsettled,
    )


def _index(step: Mapping[str, Any], key: str, default: int | None = None) -> int:
    value = step[key] if default is None else step.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) >= 2**31:
        raise ValueError(f"{key} is {shown(repr(value))}, not an index")
    return value


def dwell_rule_of(plan: Mapping[str, Any], where: object) -> DwellRule:
    """When a dwell of a plan document is over. Raises `DataError`."""
    with reading(f"{where} is no plan: dwell"):
        raw = dict(mapping(plan.get("dwell", {}), "it"))
        samples = _index(raw, "samples", DwellRule().samples)
        if samples < 1:
            raise ValueError(f"samples is {samples}")
        rest = {key: number(raw[key], key) for key in raw if key != "samples"}
        return DwellRule(samples=samples, **rest)
