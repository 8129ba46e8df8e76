"""What is wrong with an arm, in the maker's words, and what to do about it.

Source: Universal Robots, user manuals (safety modes, robot modes) and RTDE guide.
"""

from __future__ import annotations

import math

import numpy as np

from hil.core import RobotFault, StructArray
from hil_drivers.ur.rows import (
    HARMLESS,
    PAUSED,
    PAUSING,
    PLAYING,
    RUNNING,
    STOPPED,
    STOPPING,
    integers,
)
from hil_drivers.ur.standing import STILL_RAD_S

SAFETY: dict[int, tuple[str, str]] = {
    3: (
        "a protective stop",
        "find out what the arm has touched or what overloaded it; 5 s after the stop, unlock it at "
        "the teach pendant, then connect again",
    ),
    4: (
        "recovery mode: a joint is outside its limits",
        "move it back inside by freedrive at the teach pendant",
    ),
    5: ("a safeguard stop", "close the safeguard (gate, scanner), reset it, then connect again"),
    6: (
        "an emergency stop of the system",
        "remove the cause, release the button, switch the arm on and release its brakes, at the "
        "teach pendant",
    ),
    7: (
        "an emergency stop",
        "remove the cause, release the button, switch the arm on and release its brakes, at the "
        "teach pendant",
    ),
    8: ("a violation of a safety limit", "restart the safety system at the teach pendant"),
    9: ("a fault of the safety system", "restart the controller; see its log"),
    10: ("the safety system asks for the joints' identities", "confirm them at the teach pendant"),
    11: ("an undefined safety mode", "see the teach pendant"),
    12: (
        "a safeguard stop in automatic mode",
        "close the safeguard, reset it, then connect again",
    ),
    13: ("the three-position switch", "hold it in its middle position, or leave manual mode"),
}
"""`safety_mode` → what it is, what to do. 1 is normal, 2 reduced."""

MODES: dict[int, tuple[str, str]] = {
    -1: ("no controller", "restart the controller"),
    0: ("disconnected", "switch the arm on at the teach pendant"),
    1: ("waiting for the safety settings to be confirmed", "confirm them at the teach pendant"),
    2: ("booting", "wait until it has started"),
    3: ("switched off", "switch the arm on and release its brakes, at the teach pendant"),
    4: ("switched on without servo", "release the brakes at the teach pendant"),
    5: ("idle, its brakes are on", "release the brakes at the teach pendant"),
    6: ("moved by hand", "end freedrive at the teach pendant"),
    8: ("updating its firmware", "wait until it has started"),
}
"""`robot_mode` → what it is, what to do. 7 is running."""

EMERGENCY = (6, 7)
"""Safety modes that switch the arm off: the remedy of the one is that of the other."""

RUNTIME = {0: "stopping", 1: "stopped", 2: "playing", 3: "pausing", 4: "paused", 5: "resuming"}
FULL_SPEED = 0.99
SLIDER = "target_speed_fraction"


def complaints(row: np.void) -> list[tuple[str, str]]:
    """What keeps an arm from moving, by one raw RTDE row; each with what to do, said once."""
    said = []
    safety, mode = _number(row, "safety_mode", 1), _number(row, "robot_mode", RUNNING)
    if safety not in HARMLESS:
        said.append(SAFETY.get(safety, (f"safety mode {safety}", "see the teach pendant")))
    if mode != RUNNING:
        what, remedy = MODES.get(mode, (f"in robot mode {mode}", "see the teach pendant"))
        said.append((f"the arm is {what}", "" if safety in EMERGENCY else remedy))
    return said


def slider_of(raw: StructArray | np.void) -> float:
    """Return the lowest position of the speed slider, 0 to 1, in raw rows; NaN if not sent."""
    return float(raw[SLIDER].min()) if SLIDER in (raw.dtype.names or ()) else math.nan


def speed_complaint(row: np.void) -> list[tuple[str, str]]:
    """A speed slider that is not at its end makes every motion another one than planned."""
    share = slider_of(row)
    if not share < FULL_SPEED:
        return []
    return [(f"the speed slider is at {share:.0%}", "set it to 100 % at the teach pendant")]


def occupied(row: np.void) -> list[tuple[str, str]]:
    """What somebody else does with an arm that we have not begun to move; each with what to do."""
    said = []
    state = _number(row, "runtime_state", STOPPED)
    if state == STOPPING:
        said.append(("a program is about to end", "wait until it has"))
    elif state != STOPPED:
        what = "a program is paused" if state in (PAUSING, PAUSED) else "a program is running"
        said.append((what, "stop it at the teach pendant, or whoever else drives the arm"))
    speed = float(np.abs(row["target_qd"]).max()) if _has(row, "target_qd") else 0.0
    if speed > STILL_RAD_S:
        said.append((f"the arm is moving at {speed:.3f} rad/s", "wait until it stands still"))
    return said


def first_fault(raw: StructArray, *, program: bool) -> RobotFault | None:
    """The first fault in a block, were it over at its end or not.

    Args:
        raw: (N,) raw RTDE rows.
        program: Whether our robot program ought to play.
    """
    safety, mode = integers(raw, "safety_mode", 1), integers(raw, "robot_mode", RUNNING)
    state = integers(raw, "runtime_state", PLAYING)
    unsafe = ~np.isin(safety, HARMLESS) | (mode != RUNNING)
    # What stops the program is a better reason than that it has stopped, if both are seen at once.
    for wrong in (unsafe, (state != PLAYING) & program):
        if wrong.any():
            at = int(wrong.argmax())
            return fault_of(raw[at], program=program)
    return None


def fault_of(row: np.void, *, program: bool) -> RobotFault | None:
    """Why an arm that ought to obey does not, by one raw RTDE row; None while it does.

    Args:
        row: Of `Receiver.take`.
        program: Whether our robot program ought to play.
    """
    at = f"at device time {float(row['timestamp']):.3f} s"
    if said := complaints(row):
        return RobotFault(f"{'; '.join(what for what, _ in said)} {at}", hint=remedies(said))
    state = _number(row, "runtime_state", PLAYING)
    if program and state != PLAYING:
        return RobotFault(
            f"the robot program is {RUNTIME.get(state, f'in state {state}')} {at}",
            hint="was it stopped at the teach pendant, or replaced by another? connect again",
        )
    return None


def remedies(said: list[tuple[str, str]]) -> str:
    """What to do about everything that was said, nothing twice."""
    return "; ".join(dict.fromkeys(do for _, do in said if do))


def _has(row: np.void, name: str) -> bool:
    return name in (row.dtype.names or ())


def _number(row: np.void, name: str, default: int) -> int:
    return int(row[name]) if _has(row, name) else default
