"""The UR controller as the command line sees it (entry point group `hil.mocks`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil_mock_robot.draw import draw_truth
from hil_mock_robot.truth import Profile


class UrMock:
    """A UR controller in a process of its own, with all the interfaces its clients use."""

    name = "ur"
    description = "a UR controller on loopback sockets (hil mock ur; station: driver: ur)"

    def write_truth(
        self, path: Path | str, model: str = "ur5", seed: int = 0, profile: Profile = "full"
    ) -> Path:
        """Write every parameter of a mock robot to a JSON file, for scoring.

        Raises:
            SpecError: There is no such arm or profile.
            RecordingError: The file cannot be written.
        """
        return draw_truth(model, seed, profile).to_json(path)

    def serve(self, arguments: Sequence[str]) -> int:
        """Be that controller until SIGINT or SIGTERM; returns the exit code.

        Args:
            arguments: As of `python -m hil_mock_robot ur`.
        """
        from hil_mock_robot.ur.app import main

        return main(arguments, prog="hil mock ur", seed=0)
