"""The run state machine: the only thing that moves a robot."""

from hil.engine.engine import Engine, RunResult, Sink
from hil.engine.interlocks import Interlock, Trip
from hil.engine.observers import Event, Observer, Observers
from hil.engine.states import TRANSITIONS, Outcome, RunState

__all__ = [
    "TRANSITIONS",
    "Engine",
    "Event",
    "Interlock",
    "Observer",
    "Observers",
    "Outcome",
    "RunResult",
    "RunState",
    "Sink",
    "Trip",
]
