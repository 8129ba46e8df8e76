"""The mock drives as the command line sees them (entry point group `hil.mocks`)."""

from __future__ import annotations

from collections.abc import Sequence

from hil.core import PluginError
from hil_mock_robot.mock import DrawnMock


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
            from hil_mock_robot.cia402.app import main
        except ModuleNotFoundError as error:
            raise PluginError(
                f"the mock drives need the module {error.name}",
                hint='pip install "hil[can,mock]"',
            ) from error
        return main(arguments, prog="hil mock can", seed=0)
