"""The states of a run and the only transitions between them."""

from __future__ import annotations

from enum import StrEnum


class RunState(StrEnum):
    """Where a run is."""

    IDLE = "idle"
    PREFLIGHT = "preflight"
    ARMED = "armed"
    RUNNING = "running"
    PAUSED = "paused"
    STOPPING = "stopping"
    DONE = "done"


class Outcome(StrEnum):
    """How a run ended. One without stop document is `interrupted`: nobody could say."""

    COMPLETED = "completed"
    STOPPED = "stopped"
    TRIPPED = "tripped"
    FAILED = "failed"


TRANSITIONS: dict[RunState, frozenset[RunState]] = {
    RunState.IDLE: frozenset({RunState.PREFLIGHT, RunState.STOPPING}),
    RunState.PREFLIGHT: frozenset({RunState.ARMED, RunState.STOPPING}),
    RunState.ARMED: frozenset({RunState.RUNNING, RunState.STOPPING}),
    RunState.RUNNING: frozenset({RunState.PAUSED, RunState.STOPPING}),
    RunState.PAUSED: frozenset({RunState.RUNNING, RunState.STOPPING}),
    RunState.STOPPING: frozenset({RunState.DONE}),
    RunState.DONE: frozenset(),
}
"""Every state but the last two has an edge to STOPPING: a stop is possible from everywhere."""


class IllegalTransition(RuntimeError):
    """A bug in the engine: it tried to go where the table has no edge."""


class StateMachine:
    """Holds the current state and refuses transitions the table does not have."""

    def __init__(self) -> None:
        self.state = RunState.IDLE

    def to(self, new: RunState) -> None:
        """Go to `new`.

        Raises:
            IllegalTransition: There is no such edge.
        """
        if new not in TRANSITIONS[self.state]:
            raise IllegalTransition(f"no transition from {self.state} to {new}")
        self.state = new
