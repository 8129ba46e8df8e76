"""One controller as it is asked and listened to: is it the right arm, and may it be moved?

A controller says of itself by four ports: RTDE its state (`rtde.Receiver`), the dashboard server
its model, serial number and control mode (`DashboardFacts`), the primary interface its joint limits
(`primary`). `Controller` holds all of that; nothing here commands the arm. Three looks at it, each
naming every reason at once:

- `require_ready`, when it is connected, raises unless the arm is the station's and may be moved;
- `Controller.findings` are the driver's lines of a preflight;
- `reached` is asked from afar, by `hil doctor`, and does not connect to RTDE.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import HilError, RobotConnectionError, RobotFault, RobotTimeout
from hil.robot import Finding, Identity, Limits
from hil_drivers.arm import ReportedLimits, payload_finding
from hil_drivers.network import ip_address_of, mock_first, once_listening, peer_of, reason
from hil_drivers.ur.dashboard import DASHBOARD_PORT, Dashboard
from hil_drivers.ur.options import SERIES_HZ, Options, limits_of
from hil_drivers.ur.primary import PRIMARY_PORT, reported_limits
from hil_drivers.ur.rtde import RTDE_PORT, Receiver
from hil_drivers.ur.state import (
    HARMLESS,
    MODE_NAMES,
    MODES,
    PLAYING,
    RUNNING,
    RUNTIME,
    SAFETY,
    SAFETY_NAMES,
    complaints,
    occupied,
    program_state,
    remedies,
    require_source,
    speed_complaint,
)

READ_BACK_S = 2.0

KEPT_S = 5.0
"""How much waits to be read before a first segment and after a stop, by the controller's clock: a
plan may take minutes, and what the arm did meanwhile is of no use. Of a run all is kept [s]."""

LEFT_OVER_S = 1.0
"""How much longer than its watchdog the program of a session that has died may take to end [s]."""

INERTIA_SINCE = (5, 10)
"""Software that takes and reports the inertia of a load."""

OLDEST = {3: (3, 11), 5: (5, 6)}
"""Oldest software of a generation that reports the payload it computes with."""

PORTS = {DASHBOARD_PORT: "dashboard", PRIMARY_PORT: "primary interface", RTDE_PORT: "RTDE"}
REACH_S = 2.0


class Controller:
    """Facts and rows of a controller; commands nothing.

    Args:
        model: The arm of the station.
        options: Of the arm.

    Attributes:
        host: Its IP address, once it was resolved: stops do not wait for a name server.
        receiver: Its rows.
        facts: What its dashboard says.
        reported: Its joint limits; None if it has not said them, for the reason `unreported`.
    """

    def __init__(self, model: str, options: Options) -> None:
        self._model, self._options = model, options
        self.host = options.address
        self.receiver = Receiver(self.host, options.frequency_hz)
        self.facts = DashboardFacts()
        self.reported: ReportedLimits | None = None
        self.unreported = "they were not asked for"

    @property
    def identity(self) -> Identity:
        """Which arm it moves, by which software."""
        version, options = self.receiver.version, self._options
        takes = version[:2] >= INERTIA_SINCE
        details = {
            "address": options.address,
            "torque_source": options.torque_source,
            "moves": options.moves,
            "polyscope": self.facts.polyscope,
            "payload_inertia": "declared" if takes else "not declared: software before 5.10",
            "not_sent": ", ".join(self.receiver.missing),
        }
        return Identity(self._model, self.facts.serial, ".".join(map(str, version)), "ur", details)

    @property
    def limits(self) -> Limits:
        """The maker's limits, or the controller's own where those are stricter and known."""
        return limits_of(self._model, self._options, self.reported)

    @property
    def row(self) -> Any:
        """The newest raw row.

        Raises:
            RobotTimeout: There is none.
        """
        newest = self.receiver.newest
        if newest is None:
            raise RobotTimeout("the controller has not said anything yet", hint="connect again")
        return newest[0]

    @property
    def believed(self) -> Payload:
        """The load it believes in."""
        row = self.row
        x, y, z = (float(value) for value in row["payload_cog"])
        inertia: Any = (0.0,) * 6
        if "payload_inertia" in (row.dtype.names or ()):
            inertia = tuple(float(value) for value in row["payload_inertia"])
        return Payload(float(row["payload"]), (x, y, z), inertia)

    def open(self) -> None:
        """Connect, and make sure that its arm may be moved by us.

        Raises:
            RobotConnectionError: There is no controller, or it is another arm.
            RobotFault: The arm is not in a state in which it may be moved, or something moves it.
            SpecError: It does not send what shall be the effort.
        """
        self._find()
        self.facts = once_listening(self.host, lambda: dashboard_facts(self.host))
        once_listening(self.host, self.receiver.open)
        self._require_arm()
        self.reported, self.unreported = None, ""
        try:
            self.reported = reported_limits(self.host)
        except HilError as error:  # a finding: it keeps a run from beginning, not from connecting
            self.unreported = error.message
        row = self._row_once_idle()
        require_ready(self.host, self._model, self.facts, self.receiver.version, row)

    def listen(self) -> None:
        """Connect to record what another program does with the arm.

        Raises:
            RobotConnectionError: There is no controller, or it is another arm.
            SpecError: It does not send what shall be the effort.
        """
        self._find()
        once_listening(self.host, self.receiver.open)
        with contextlib.suppress(RobotConnectionError):  # RTDE alone will do for listening
            self.facts = dashboard_facts(self.host)
        self._require_arm()

    def forget_rows(self) -> None:
        """Drop rows from before the program played; from now on all are kept."""
        until = time.monotonic() + READ_BACK_S
        while time.monotonic() < until:
            if program_state(self.receiver.take(READ_BACK_S))[-1] == PLAYING:
                break
        self.receiver.keep(KEPT_S)

    def findings(
        self, declared: Payload | None, *, moved_by_us: Callable[[], bool]
    ) -> Iterator[Finding]:
        """Yield the driver's lines of a preflight.

        Args:
            declared: The load that was declared since the robot was connected.
            moved_by_us: Says whether the process that armed the watchdog is there.
        """
        # Asking the dashboard may take seconds: the row is the one after it.
        facts = dashboard_facts(self.host)
        row, version = self.row, self.receiver.version
        yield _mode_finding(int(row["robot_mode"]))
        yield _safety_finding(int(row["safety_mode"]))
        yield _control_finding(facts)
        yield _software_finding(version)
        yield _slider_finding(row)
        remark = "; this software takes no inertia" if version[:2] < INERTIA_SINCE else ""
        hint = "look for a message at the teach pendant"
        yield payload_finding(declared, self.believed, hint, remark)
        yield self._limits_finding()
        hz, runtime = self._options.watchdog_hz, int(row["runtime_state"])
        program = RUNTIME.get(runtime, str(runtime))
        yield Finding(
            "watchdog",
            moved_by_us() and runtime == PLAYING,
            f"watchdog armed at {hz:g} Hz in our program, which is {program}",
            hz,
            hint="connect again",
        )

    def close(self) -> None:
        """End the connection. Idempotent."""
        self.receiver.close()

    def _find(self) -> None:
        self.receiver.close()
        self.host = ip_address_of(self._options.address)
        self.receiver = Receiver(self.host, self._options.frequency_hz)

    def _require_arm(self) -> None:
        """Raise if it is not the station's arm: its samples would be fitted to another model."""
        require_source(self._options.torque_source, self.receiver.missing)
        if wrong := _wrong_arm(self._model, self.facts, self.receiver.version):
            raise _error(RobotConnectionError, self.host, wrong)

    def _row_once_idle(self) -> np.void:
        """The newest row; the program of a session that has died ends by its watchdog."""
        until = time.monotonic() + 1.0 / self._options.watchdog_hz + LEFT_OVER_S
        row: np.void = self.receiver.take(READ_BACK_S)[-1]
        while occupied(row) and time.monotonic() < until:
            row = self.receiver.take(READ_BACK_S)[-1]
        return row

    def _limits_finding(self) -> Finding:
        """Return whether the limits used are no wider than those of the controller."""
        if self.reported is None:
            message = f"the controller's joint limits are not known: {self.unreported}"
            hint = "see whether port 30001 is open in the controller's security settings"
            return Finding("joint-limits", False, message, hint=hint)
        maker, used = limits_of(self._model, self._options), self.limits
        by = {
            "rad": float(max((used.q_min - maker.q_min).max(), (maker.q_max - used.q_max).max())),
            "rad/s": float((maker.qd_max - used.qd_max).max()),
            "rad/s²": float((maker.qdd_max - used.qdd_max).max()),
        }
        narrower = ", ".join(f"{value:.3f} {unit}" for unit, value in by.items() if value > 0)
        message = "joint limits used are no wider than the controller's (told on port 30001), which"
        if narrower:
            message += f" are narrower than the maker's by up to {narrower}"
        else:
            message += " are as wide as the maker's"
        wider = self.reported.exceeded_by(used)
        return Finding("joint-limits", not wider.any(), message, narrower or "0 rad")


@dataclass(frozen=True, slots=True)
class DashboardFacts:
    """Facts that RTDE lacks; empty where the dashboard did not answer.

    Attributes:
        polyscope: Version of the controller's software.
        serial: Of the arm.
        model: Such as `UR5`.
        remote: `true`, `false`, or empty on controllers without that distinction.
    """

    polyscope: str = ""
    serial: str = ""
    model: str = ""
    remote: str = ""


def dashboard_facts(address: str) -> DashboardFacts:
    """Ask the dashboard server of a controller.

    Raises:
        RobotConnectionError: There is none.
    """
    with Dashboard(address) as dashboard:
        return DashboardFacts(
            polyscope=dashboard.ask("PolyscopeVersion"),
            serial=dashboard.ask("get serial number"),
            model=dashboard.ask("get robot model"),
            remote=dashboard.ask("is in remote control").lower(),
        )


def require_ready(
    address: str, model: str, facts: DashboardFacts, version: tuple[int, ...], row: np.void
) -> None:
    """Raise if this arm cannot be moved, with every reason at once.

    Args:
        address: Of the controller.
        model: The arm of the station.
        facts: By the dashboard.
        version: Of the controller, by RTDE.
        row: The newest raw row.

    Raises:
        RobotConnectionError: It is another arm, or its software is too old.
        RobotFault: It is not in a state in which it may move.
    """
    if wrong := [*_wrong_arm(model, facts, version), *_too_old(version)]:
        raise _error(RobotConnectionError, address, wrong)
    # `ur-rtde` would end whatever program there is, or wait for its end for minutes.
    not_ready = [*complaints(row), *occupied(row), *speed_complaint(row)]
    if "false" in facts.remote:
        not_ready.append(
            ("the arm is in local control", "switch it to remote control at the teach pendant")
        )
    if not_ready:
        raise _error(RobotFault, address, not_ready)


def _wrong_arm(
    model: str, facts: DashboardFacts, version: tuple[int, ...]
) -> list[tuple[str, str]]:
    wrong, remedy = [], "see address and model in the station file"
    if SERIES_HZ[model] != (125 if version[0] <= 3 else 500):
        series = "CB3" if version[0] <= 3 else "e-Series"
        wrong.append((f"it is a {series} controller, a {model} has another one", remedy))
    size, reported = re.sub(r"\D", "", model), re.sub(r"\D", "", facts.model)
    if reported and reported != size:
        wrong.append((f"it moves a {facts.model}, the station says {model}", remedy))
    return wrong


def _too_old(version: tuple[int, ...]) -> list[tuple[str, str]]:
    oldest = OLDEST.get(version[0])
    if oldest is None:
        return [(f"software {version[0]}.x is not supported", "CB3 3.x and e-Series 5.x are")]
    if tuple(version[:2]) >= oldest:
        return []
    what = f"its software {'.'.join(map(str, version[:3]))} does not tell the payload"
    return [(what, f"update it to {oldest[0]}.{oldest[1]} or later")]


def _error(kind: Any, address: str, reasons: list[tuple[str, str]]) -> Any:
    message = f"{address}: {'; '.join(what for what, _ in reasons)}"
    return kind(message, hint=remedies(reasons))


def _mode_finding(mode: int) -> Finding:
    name = MODE_NAMES.get(mode, str(mode))
    hint = MODES.get(mode, ("", "see the teach pendant"))[1]
    return Finding("mode", mode == RUNNING, f"robot mode {name}", name, "RUNNING", hint)


def _safety_finding(mode: int) -> Finding:
    name = SAFETY_NAMES.get(mode, str(mode))
    hint = SAFETY.get(mode, ("", "see the teach pendant"))[1]
    return Finding("safety", mode in HARMLESS, f"safety mode {name}", name, "NORMAL", hint)


def _control_finding(facts: DashboardFacts) -> Finding:
    if not facts.remote:
        message = "this controller makes no difference between local and remote control"
        return Finding("remote-control", True, message, "not told")
    remote = "true" in facts.remote
    message = f"the arm is in {'remote' if remote else 'local'} control"
    hint = "switch it to remote control at the teach pendant"
    return Finding("remote-control", remote, message, facts.remote, "true", hint)


def _software_finding(version: tuple[int, ...]) -> Finding:
    installed, oldest = ".".join(map(str, version)), OLDEST.get(version[0], (3, 11))
    needed = ".".join(map(str, oldest))
    return Finding(
        "software",
        version[0] in OLDEST and tuple(version[:2]) >= oldest,
        f"software {installed}; {needed} or later of this generation tells what is needed",
        installed,
        needed,
        "update the controller's software",
    )


def _slider_finding(row: np.void) -> Finding:
    share = float(row["target_speed_fraction"])
    complaints = speed_complaint(row)
    hint = complaints[0][1] if complaints else ""
    return Finding("speed-slider", not complaints, f"speed slider at {share:.0%}", share, 1.0, hint)


def reached(address: str, within_s: float = REACH_S) -> Iterator[Finding]:
    """Look from afar whether there is an arm that could be moved; no program is uploaded.

    Args:
        address: Of the controller.
        within_s: How long a connection, and each answer, may take [s].
    """
    silent = {port: why for port in PORTS if (why := _why_silent(address, port, within_s))}
    if silent:
        reasons = ", ".join(f"{port} ({PORTS[port]}): {why}" for port, why in silent.items())
        hint = mock_first(address, "ur")
        hint += "is the controller on, the address right, and are its services enabled?"
        yield Finding("ports", False, f"{address} does not answer on {reasons}", hint=hint)
    else:
        open_ = ", ".join(f"{port} ({name})" for port, name in PORTS.items())
        yield Finding("ports", True, f"{address} answers on {open_}")
    if DASHBOARD_PORT in silent:
        return
    try:
        with Dashboard(address, within_s) as dashboard:
            # `RUNNING` of `Robotmode: RUNNING`
            mode = dashboard.ask("robotmode").rpartition(":")[2].strip()
            safety = dashboard.ask("safetymode").rpartition(":")[2].strip()
            remote = dashboard.ask("is in remote control").lower()
    except RobotConnectionError as error:
        yield Finding("dashboard", False, error.message, hint=error.hint)
        return
    hint = "switch it on and release its brakes at the teach pendant"
    yield Finding("mode", mode == "RUNNING", f"robot mode {mode or 'not told'}", hint=hint)
    hint = "see the teach pendant for what has stopped it"
    normal = safety in ("NORMAL", "REDUCED")
    yield Finding("safety", normal, f"safety mode {safety or 'not told'}", hint=hint)
    if remote:
        control = "remote" if "true" in remote else "local"
        hint = "switch it to remote control at the teach pendant"
        yield Finding("control", control == "remote", f"in {control} control", hint=hint)


def _why_silent(address: str, port: int, within_s: float) -> str:
    """Return why a port does not answer; empty if it does."""
    try:
        peer_of(address, port, within_s)
    except OSError as error:
        return reason(error)
    return ""
