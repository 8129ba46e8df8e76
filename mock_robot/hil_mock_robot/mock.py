"""The embedded mock as the command line sees it (entry point group `hil.mocks`)."""

from __future__ import annotations

from pathlib import Path

from hil_mock_robot.draw import draw_truth
from hil_mock_robot.truth import Profile


class EmbeddedMock:
    """A robot inside the process that uses it; needs no server, no ports and no wall time."""

    name = "embedded"
    description = "any built-in arm, in this process, on a virtual clock (station: driver: mock)"

    def write_truth(
        self, path: Path | str, model: str = "ur5", seed: int = 0, profile: Profile = "full"
    ) -> Path:
        """Write every parameter of a mock robot to a JSON file, for scoring.

        Raises:
            SpecError: There is no such arm or profile.
            RecordingError: The file cannot be written.
        """
        return draw_truth(model, seed, profile).to_json(path)
