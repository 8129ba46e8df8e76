"""Plans that several tests of a file need, made once: the same arguments give the same plan."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hil.excitation import unwatched
from hil.planning import robots
from hil.planning.build import build_plan
from hil.planning.plan import Plan
from hil.spec import ExperimentSpec, StationRobot
from hil.spec.look_up import is_path
from hil.workflow import preview

_MADE: dict[tuple[str, ...], Plan] = {}


def planned_once(
    spec: ExperimentSpec, station_robot: StationRobot, *, watch: Any = unwatched, **given: Any
) -> Plan:
    """Return what `build_plan` gives; make it if no test has done so before."""
    if getattr(spec.excitation, "file", None) or is_path(station_robot.model):
        return build_plan(spec, station_robot, watch=watch, **given)  # files may change
    start = given.get("start_q")
    key = (
        spec.model_dump_json(),
        station_robot.model_dump_json(),
        "" if start is None else repr(np.asarray(start).tolist()),
        repr(given.get("rate_hz")),
        repr(given.get("part")),
    )
    if key not in _MADE:
        _MADE[key] = build_plan(spec, station_robot, watch=watch, **given)
    return _MADE[key]


def share_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands and functions take the plans that were made before in this process."""
    for module in (robots, preview):
        monkeypatch.setattr(module, "build_plan", planned_once)
