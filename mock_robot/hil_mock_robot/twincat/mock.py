"""The PLC as the command line sees it (entry point group `hil.mocks`)."""

from __future__ import annotations

from collections.abc import Sequence

from hil.core import PluginError
from hil_mock_robot.mock import DrawnMock


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
            from hil_mock_robot.twincat.app import main
        except ModuleNotFoundError as error:
            raise PluginError(
                f"the mock PLC needs the module {error.name}", hint='pip install "hil[ads,mock]"'
            ) from error
        return main(arguments, prog="hil mock plc", seed=0)
