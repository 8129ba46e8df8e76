"""What is known of an arm behind a PLC: from its description, then from the PLC."""

from __future__ import annotations

import numpy as np

from hil.arms import load_arm
from hil.core import RobotConnectionError
from hil.robot import Capabilities, Identity, Limits
from hil_drivers import arm
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.variables import CONTRACT, CURRENT, TORQUE

CYCLE_SHARE = 1e-6
EFFORTS = {TORQUE: "torque", CURRENT: "current"}


def capabilities_of(model: str, options: Options) -> Capabilities:
    """Return names, rate and the meaning of `effort`."""
    return arm.capabilities_of(model, options.rate_hz, options.effort, options.drive_gains_nm_a)


def limits_of(model: str, options: Options, info: np.void | None = None) -> Limits:
    """Return the maker's limits, none wider than what the PLC checks once it is connected.

    Args:
        model: Built-in arm.
        options: Of the station.
        info: `stInfo`.
    """
    reported = None if info is None else reported_limits(info)
    return arm.limits_of(model, reported, options.speed_share)


def reported_limits(info: np.void) -> arm.ReportedLimits:
    """Return the limits that the PLC checks, by its `stInfo`."""
    return arm.ReportedLimits(
        q_min=info["aQMin"],
        q_max=info["aQMax"],
        qd_max=info["aQdMax"],
        qdd_max=info["aQddMax"],
        payload_max_kg=float(info["fPayloadMax"]),
    )


def require_fit(where: str, info: np.void, model: str, options: Options) -> None:
    """Refuse a PLC that is not what the station says.

    Args:
        where: For messages.
        info: `stInfo`.
        model: Built-in arm.
        options: Of the station.

    Raises:
        RobotConnectionError: Model, axes, cycle or effort differ; all of them are listed.
    """
    described = load_arm(model)
    told, cycle = text(info["sModel"]), float(info["fCycleS"])
    problems = []
    if info["nAxes"] != described.n_joints:
        problems.append(f"it has {info['nAxes']} axes, the {model} has {described.n_joints}")
    if told and told != model:
        problems.append(f"it moves a {told}, the station says {model}")
    if not abs(cycle * options.rate_hz - 1) < CYCLE_SHARE:
        problems.append(f"its cycle is {cycle * 1e3:g} ms, rate_hz says {1e3 / options.rate_hz:g}")
    effort = EFFORTS.get(int(info["nEffort"]), f"effort {info['nEffort']}")
    if effort != options.effort:
        problems.append(f"it tells {effort}, option effort says {options.effort}")
    if not (info["aQMin"] < info["aQMax"]).all() or not (info["aQdMax"] > 0).all():
        problems.append("its joint limits are none")
    if problems:
        raise RobotConnectionError(
            f"{where}: {'; '.join(problems)}", hint="mend the station, or the PLC's GVL"
        )


def identity_of(info: np.void, options: Options, model: str, device: str) -> Identity:
    """Who the PLC says to be."""
    return Identity(
        model=text(info["sModel"]) or model,
        serial=text(info["sSerial"]),
        firmware=text(info["sProgram"]),
        driver="twincat",
        details={
            "ams": f"{options.ams_net_id}:{options.port}",
            "runtime": device,
            "contract": str(CONTRACT),
            "effort": options.effort,
            "cycle_s": f"{float(info['fCycleS']):g}",
            "ring_rows": str(int(info["nRingRows"])),
            "set_points": str(int(info["nSetPoints"])),
            "watchdog_s": f"{float(info['fWatchdogS']):g}",
            "stop_rad_s2": f"{float(info['fStopRadS2']):g}",
        },
    )


def text(raw: bytes) -> str:
    """A string of the PLC's."""
    return bytes(raw).split(b"\0")[0].decode("windows-1252")
