"""Mocks as plug-ins of the command line (entry point group `hil.mocks`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil.core import PluginError
from hil_mock_robot.plant.truth import Profile, draw_truth


class DrawnMock:
    """Base class of the mocks for the command line.

    Attributes:
        model: Default arm.
    """

    model = "ur5"

    def write_truth(
        self, path: Path | str, model: str = "", seed: int = 0, profile: Profile = "full"
    ) -> Path:
        """Write every true parameter of a mock robot to a JSON file, for scoring.

        Args:
            path: Path of the file.
            model: Built-in arm; empty for the default arm.
            seed: Seed for the random parameters of the arm.
            profile: Physics profile of the mock: `full` or `ideal`.

        Raises:
            SpecError: The arm or the profile does not exist.
            RecordingError: The file cannot be written.
        """
        return draw_truth(model or self.model, seed, profile).to_json(path)


class EmbeddedMock(DrawnMock):
    """Robot inside the process that uses it; needs no server, no ports and no wall time."""

    name = "embedded"
    description = "any built-in arm, in this process, on a virtual clock (station: driver: mock)"


class UrMock(DrawnMock):
    """UR controller in a separate process, with all interfaces of its clients."""

    name = "ur"
    description = "a UR controller on loopback sockets (hil mock ur; station: driver: ur)"

    def serve(self, arguments: Sequence[str]) -> int:
        """Run the controller until SIGINT or SIGTERM; return the exit code.

        Args:
            arguments: Command-line arguments as for `python -m hil_mock_robot ur`.
        """
        from hil_mock_robot.ur.mock import main

        return main(arguments, prog="hil mock ur", seed=0)


class CanMock(DrawnMock):
    """Arm with CiA 402 drives on a CAN bus, in a separate process."""

    name = "can"
    model = "lab6"
    description = "an arm on CiA 402 drives on a CAN bus (hil mock can; station: driver: cia402)"

    def serve(self, arguments: Sequence[str]) -> int:
        """Run the drives until SIGINT or SIGTERM; return the exit code.

        Args:
            arguments: Command-line arguments as for `python -m hil_mock_robot can`.

        Raises:
            PluginError: A required package is not installed.
        """
        try:
            from hil_mock_robot.cia402.mock import main
        except ModuleNotFoundError as error:
            raise PluginError(
                f"the mock drives need the module {error.name}",
                hint='pip install "hil[can,mock]"',
            ) from error
        return main(arguments, prog="hil mock can", seed=0)


class PlcMock(DrawnMock):
    """TwinCAT PLC in a separate process, for drivers that use ADS."""

    name = "plc"
    model = "lab6"
    description = "a PLC that plays trajectories, by ADS on a loopback port (hil mock plc)"

    def serve(self, arguments: Sequence[str]) -> int:
        """Run the PLC until SIGINT or SIGTERM; return the exit code.

        Args:
            arguments: Command-line arguments as for `python -m hil_mock_robot plc`.

        Raises:
            PluginError: A required package is not installed.
        """
        try:
            from hil_mock_robot.twincat.mock import main
        except ModuleNotFoundError as error:
            raise PluginError(
                f"the mock PLC needs the module {error.name}", hint='pip install "hil[ads,mock]"'
            ) from error
        return main(arguments, prog="hil mock plc", seed=0)
