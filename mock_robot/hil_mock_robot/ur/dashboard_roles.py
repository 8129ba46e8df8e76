"""Who may do what at the pendant, as the dashboard sets it: roles (CB3), operational modes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil_mock_robot.ur.pendant import Pendant

ROLES = ("PROGRAMMER", "OPERATOR", "NONE", "LOCKED", "RESTRICTED")


def set_role(pendant: Pendant, role: str) -> str:
    """Of the user."""
    if role.upper() not in ROLES:
        return f"Failed setting user role: {role}"
    pendant.role = role.upper()
    return f"Setting user role: {role}"


def set_operational(pendant: Pendant, mode: str) -> str:
    """Take control of the operational mode."""
    if mode.upper() not in ("MANUAL", "AUTOMATIC"):
        return f"could not understand: set operational mode {mode}"
    pendant.operational = mode.upper()
    return f"Operational mode {pendant.operational} is set"


def clear_operational(pendant: Pendant, _: str) -> str:
    """Give control of the operational mode back; it stays what it is."""
    now = pendant.operational
    return f"No longer controlling the operational mode. Current operational mode: '{now}'."
