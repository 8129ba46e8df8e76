"""The mocks as the command line sees them (entry point group `hil.mocks`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil.core import PluginError
from hil_mock_robot.plant.truth import Profile, draw_truth


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


class UrMock(DrawnMock):
    """A UR controller in a process of its own, with all the interfaces its clients use."""

    name = "ur"
    description = "a UR controller on loopback sockets (hil mock ur; station: driver: ur)"

    def serve(self, arguments: Sequence[str]) -> int:
        """Be that controller until SIGINT or SIGTERM; returns the exit code.

        Args:
            arguments: As of `python -m hil_mock_robot ur`.
        """
        from hil_mock_robot.ur.mock import main

        return main(arguments, prog="hil mock ur", seed=0)


class CanMock(DrawnMock):
    """An arm on CiA 402 drives on a CAN bus, in a process of its own."""

    name = "can"
    model = "lab6"
    description = "an arm on CiA 402 drives on a CAN bus (hil mock can; station: driver: cia402)"

    def serve(self, arguments: Sequence[str]) -> int:
        """Be those drives until SIGINT or SIGTERM; returns the exit code.

        Args:
            arguments: As of `python -m hil_mock_robot can`.

        Raises:
            PluginError: A package that it needs is not installed.
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
    """A TwinCAT PLC in a process of its own, for drivers that speak ADS."""

    name = "plc"
    model = "lab6"
    description = "a PLC that plays trajectories, by ADS on a loopback port (hil mock plc)"

    def serve(self, arguments: Sequence[str]) -> int:
        """Be that PLC until SIGINT or SIGTERM; returns the exit code.

        Args:
            arguments: As of `python -m hil_mock_robot plc`.

        Raises:
            PluginError: A package that it needs is not installed.
        """
        try:
            from hil_mock_robot.twincat.mock import main
        except ModuleNotFoundError as error:
            raise PluginError(
                f"the mock PLC needs the module {error.name}", hint='pip install "hil[ads,mock]"'
            ) from error
        return main(arguments, prog="hil mock plc", seed=0)
