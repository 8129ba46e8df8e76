"""Mocks, and the embedded one, as the command line sees them (entry point group `hil.mocks`)."""

from __future__ import annotations

from pathlib import Path

from hil_mock_robot.draw import draw_truth
from hil_mock_robot.truth import Profile


class DrawnMock:
    """What all mocks have for the command line.

    Attributes:
        model: Its usual arm.
    """

    model = "ur5"

    def write_truth(
        self, path: Path | str, model: str = "", seed: int = 0, profile: Profile = "full"
    ) -> Path:
        """Write every parameter of a mock robot to a JSON file, for scoring.

        Args:
            path: The file.
            model: Built-in arm; its usual one when empty.
            seed: Which individual.
            profile: Of the physics.

        Raises:
            SpecError: There is no such arm or profile.
            RecordingError: The file cannot be written.
        """
        return draw_truth(model or self.model, seed, profile).to_json(path)


class EmbeddedMock(DrawnMock):
    """A robot inside the process that uses it; needs no server, no ports and no wall time."""

    name = "embedded"
    description = "any built-in arm, in this process, on a virtual clock (station: driver: mock)"
