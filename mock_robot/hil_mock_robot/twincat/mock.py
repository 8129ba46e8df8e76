"""The PLC as the command line sees it (entry point group `hil.mocks`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil_mock_robot.draw import draw_truth
from hil_mock_robot.truth import Profile


class PlcMock:
    """A TwinCAT PLC in a process of its own, for drivers that speak ADS."""

    name = "plc"
    model = "lab6"
    description = "a PLC that plays trajectories, by ADS on a loopback port (hil mock plc)"

    def write_truth(
        self, path: Path | str, model: str = "lab6", seed: int = 0, profile: Profile = "full"
    ) -> Path:
        """Write every parameter of a mock robot to a JSON file, for scoring.

        Raises:
            SpecError: There is no such arm or profile.
            RecordingError: The file cannot be written.
        """
        return draw_truth(model, seed, profile).to_json(path)

    def serve(self, arguments: Sequence[str]) -> int:
        """Be that PLC until SIGINT or SIGTERM; returns the exit code.

        Args:
            arguments: As of `python -m hil_mock_robot plc`.
        """
        from hil_mock_robot.twincat.app import main

        return main(arguments, prog="hil mock plc", seed=0)
