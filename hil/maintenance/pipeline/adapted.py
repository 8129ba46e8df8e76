"""An experiment on a robot with other driver options, such as a mock on another day."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from hil.planning import Experiment


def with_options(experiment: Experiment, options: Mapping[str, Any]) -> Experiment:
    """The same experiment with some of its robot's driver options changed.

    The station that is copied into the run directory says so, too: whoever goes on with the run
    has the same robot.

    Args:
        experiment: From `hil.planning.load`.
        options: Laid over those of the station.
    """
    name = experiment.spec.robot
    robot = experiment.robot.model_copy(update={"options": {**experiment.robot.options, **options}})
    station = experiment.station.model_copy(
        update={"robots": {**experiment.station.robots, name: robot}}
    )
    text = station.as_text(experiment.station_source)
    return replace(experiment, robot=robot, station=station, station_text=text)
