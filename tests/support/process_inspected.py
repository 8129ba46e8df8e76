"""A driver that looks at itself before it moves, for one in a process of its own."""

from __future__ import annotations

from collections.abc import Sequence

from hil.robot import Finding
from tests.support.process_drivers import Kinematic


class Inspected(Kinematic):
    """Opts into `hil.robot.HasChecks`."""

    def checks(self) -> Sequence[Finding]:
        return (Finding("oil", False, "low", 0.5, 1.0, "fill up"), Finding("lamp", True, "lit"))
