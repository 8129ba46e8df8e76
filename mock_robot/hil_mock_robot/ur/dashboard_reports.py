"""What the dashboard has written to a disk that there is none of: logs and reports.

Source: Universal Robots, "Dashboard Server"; the replies are those that UR's client library wants.
"""

from __future__ import annotations

import calendar
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil_mock_robot.ur.pendant import Pendant

REPORTS = ("CONTROLLER", "SOFTWARE", "SYSTEM")


def save_log(_pendant: Pendant, _: str) -> str:
    """Says it is done; nothing is written."""
    return "Log saved to disk"


def flight_report(pendant: Pendant, kind: str) -> str:
    """Counts up the number of the report; there is none."""
    if kind.upper() not in REPORTS:
        return f"Failed to execute: generate flight report {kind}".rstrip()
    pendant.reports += 1
    return f"Flight Report generated with id: {pendant.reports}"


def support_file(pendant: Pendant, folder: str) -> str:
    """Names the file that a controller would write."""
    if not folder:
        return "Failed to execute: generate support file"
    pendant.reports += 1
    name = f"ur_{pendant.machine.serial}_{_clock(pendant)}.zip"
    return f"Completed successfully: {folder.rstrip('/')}/{name}"


def _clock(pendant: Pendant) -> str:
    """The controller's own, from the date of its software on: two runs name the same file."""
    began = calendar.timegm(time.strptime(pendant.machine.series.date, "%b %d %Y"))
    return time.strftime("%Y-%m-%d_%H-%M-%S", time.gmtime(began + pendant.machine.now_s))
