"""The embedded mock robot for tests: a connected robot in this process, on a virtual clock."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

from hil.core import FloatArray, plugins
from hil.robot import Robot
from hil.testing.starting import require_extras


class MockRobot(Robot, Protocol):
    """A robot that exists only here; beside the protocol it can be made to fail."""

    def fault(self, kind: str, **keys: Any) -> contextlib.ExitStack:
        """Let something go wrong now (docs/reference/mock.md); in a `with` until its end."""

    def clear(self) -> None:
        """What goes wrong is over and nothing is to come; a stop is over after `connect`."""

    def push(self, torque: Sequence[float] | FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""

    def wear(self, factor: Sequence[float] | FloatArray) -> None:
        """Scale all friction by `factor` (n,) from now on, 1 for as good as new."""


@contextlib.contextmanager
def mock_robot(
    model: str = "ur5", seed: int = 0, *, name: str = "mock", **options: Any
) -> Iterator[MockRobot]:
    """A connected mock robot; closed at the end.

    Args:
        model: A built-in arm.
        seed: Which individual.
        name: Its name, in messages.
        **options: Further ones of the mock (docs/reference/mock.md): `clock="wall"`,
            `profile="ideal"`, `faults=[{"kind": "refuse", "segment": 0}]`, …

    Raises:
        PluginError: The extra is missing.
        SpecError: There is no such arm or option.
    """
    require_extras("the mock robot", "mock")
    robot: MockRobot = plugins.load("hil.drivers", "mock")(name, model, seed=seed, **options)
    try:
        robot.connect()
        yield robot
    finally:
        robot.close()
