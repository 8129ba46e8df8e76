"""The run state machine: the only thing that moves a robot."""

from hil.engine.engine import Engine
from hil.engine.interlocks import Interlock, Trip
from hil.engine.observers import Event, Observer, Observers
from hil.engine.prompt import Prompt, Reply
from hil.engine.reading import Sink
from hil.engine.result import RunResult
from hil.engine.states import TRANSITIONS, Outcome, RunState

__all__ = [
    "TRANSITIONS",
    "Engine",
    "Event",
    "Interlock",
    "Observer",
    "Observers",
    "Outcome",
    "Prompt",
    "Reply",
    "RunResult",
    "RunState",
    "Sink",
    "Trip",
]
