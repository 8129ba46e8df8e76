"""The UR controller as the command line sees it (entry point group `hil.mocks`)."""

from __future__ import annotations

from collections.abc import Sequence

from hil_mock_robot.mock import DrawnMock


class UrMock(DrawnMock):
    """A UR controller in a process of its own, with all the interfaces its clients use."""

    name = "ur"
    description = "a UR controller on loopback sockets (hil mock ur; station: driver: ur)"

    def serve(self, arguments: Sequence[str]) -> int:
        """Be that controller until SIGINT or SIGTERM; returns the exit code.

        Args:
            arguments: As of `python -m hil_mock_robot ur`.
        """
        from hil_mock_robot.ur.app import main

        return main(arguments, prog="hil mock ur", seed=0)
