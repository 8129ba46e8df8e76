"""Making the driver, in its own process, from what its process was asked to open."""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib.metadata import EntryPoint
from typing import Any

from hil.core import plugins
from hil.robot.protocol import Robot

_GROUP = "hil.drivers"


def open_driver(how: Mapping[str, Any]) -> Robot:
    """The driver, not connected.

    Args:
        how: `driver` (name or `module:Class`), `name`, `model`, `options`; `gravity` for those
            who simulate, or None; `pythonpath` that `hil` was started with, or None.

    Raises:
        PluginError, SpecError, TypeError, ValueError: What `hil.planning.robots.open_robot` says.
    """
    _set_or_unset("PYTHONPATH", how["pythonpath"])
    target = how["driver"]
    point = EntryPoint(target, target, _GROUP) if ":" in target else plugins.find(_GROUP, target)
    robot: Robot = plugins.load_point(point)(how["name"], how["model"], **how["options"])
    if how["gravity"] is not None and hasattr(robot, "set_gravity"):
        robot.set_gravity(tuple(how["gravity"]))
    return robot


def _set_or_unset(variable: str, value: str | None) -> None:
    """Programs that the driver starts get the environment that `hil` was started with."""
    os.environ.pop(variable, None)
    if value is not None:
        os.environ[variable] = value
