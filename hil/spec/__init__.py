"""YAML to typed, frozen specs."""

from hil.spec.experiment import ExperimentSpec
from hil.spec.hashing import spec_hash
from hil.spec.load import load_spec, load_station, resolve_robot, spec_from_text
from hil.spec.station import Station, StationRobot

__all__ = [
    "ExperimentSpec",
    "Station",
    "StationRobot",
    "load_spec",
    "load_station",
    "resolve_robot",
    "spec_from_text",
    "spec_hash",
]
