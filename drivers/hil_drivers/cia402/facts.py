"""What is known of an arm on CiA 402 drives: from its description, then from the drives."""

from __future__ import annotations

from collections.abc import Sequence

from hil.robot import Capabilities, Identity, Limits
from hil_drivers import arm
from hil_drivers.cia402.commissioning import Commissioned, LeftFault
from hil_drivers.cia402.options import Options

GAINS = "rated torque and current of the drives (6075h, 6076h) times gear, or the station's"


def capabilities_of(
    model: str, options: Options, drives: Commissioned | None = None
) -> Capabilities:
    """Return names, rate and the meaning of `effort`.

    Args:
        model: Built-in arm.
        options: Of the station.
        drives: Once they are commissioned: gains are then their own.
    """
    if drives is None:
        return arm.capabilities_of(model, options.rate_hz, options.effort)
    gains = drives.scaling.drive_gains
    return arm.capabilities_of(model, options.rate_hz, options.effort, gains, GAINS)


def limits_of(model: str, drives: Commissioned | None = None) -> Limits:
    """Return the maker's limits, narrowed by those of the drives once they are commissioned."""
    if drives is None:
        return arm.limits_of(model)
    reported = arm.ReportedLimits(
        q_min=drives.q_min, q_max=drives.q_max, effort_max=drives.max_torque
    )
    return arm.limits_of(model, reported)


def identity_of(model: str, drives: Commissioned, were_reset: Sequence[LeftFault]) -> Identity:
    """Which arm this is: its drives, by their own words (1018h), with all that was read of them."""
    details = dict(drives.details)
    if were_reset:
        details["faults_reset"] = "; ".join(map(str, were_reset))

    def all_of(name: str) -> str:
        return " ".join(f"{drive.objects.get(name, 0):x}" for drive in drives.drives)

    return Identity(
        model=model,
        serial=all_of("serial"),
        firmware=all_of("revision"),
        driver="cia402",
        details=details,
    )
