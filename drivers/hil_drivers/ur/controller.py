"""Connection to one UR controller: state, checks and limits, without any motion command.

A controller offers its data on three ports: RTDE sends the state (`rtde.Receiver`), the dashboard
server reports model, serial number and control mode (`DashboardFacts`), and the primary interface
reports the joint limits (`primary`). `Controller` combines the data of the three ports: RTDE,
dashboard server and primary interface. The checks of a controller (`require_ready`,
`Controller.findings`, `reached`) report all problems at once, not only the first problem.
`require_ready` raises an error during the connection unless the connected arm is the arm of the
station and can be moved. `Controller.findings` yields the preflight findings of the driver.
`reached` checks the ports and the dashboard for `hil doctor`, without an RTDE session.
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
"""Maximum age [s], by the controller's clock, of the rows that are retained for reading before
the first segment and after a stop.

Planning can take minutes, and the rows received during planning are not needed. During a run,
all rows of the controller are retained.
"""

LEFT_OVER_S = 1.0
"""Time [s], in addition to the watchdog period, within which the robot program of a dead session
ends."""

INERTIA_SINCE = (5, 10)
"""First software version that accepts and reports the inertia of a payload."""

OLDEST = {3: (3, 11), 5: (5, 6)}
"""Map from major software version to the oldest version that reports the payload used by the
controller."""

PORTS = {DASHBOARD_PORT: "dashboard", PRIMARY_PORT: "primary interface", RTDE_PORT: "RTDE"}
REACH_S = 2.0


class Controller:
    """Identity, limits and rows of one controller; sends no motion command.

    Args:
        model: Model of the arm in the station file.
        options: Options of the arm from the station file.

    Attributes:
        host: IP address of the controller, resolved once, so that a stop needs no name server.
        receiver: Receiver of the controller's rows.
        facts: Data of the controller that the dashboard server reported.
        reported: Joint limits reported by the controller; None if the controller has not reported
            any limits.
        unreported: Reason why `reported` is None.
    """

    def __init__(self, model: str, options: Options) -> None:
        self._model, self._options = model, options
        self.host = options.address
        self.receiver = Receiver(self.host, options.frequency_hz)
        self.facts = DashboardFacts()
        self.reported: ReportedLimits | None = None
        self.unreported = "they were not requested"

    @property
    def identity(self) -> Identity:
        """Model and serial number of the arm, and software version of the controller."""
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
        """Manufacturer's joint limits, narrowed by the limits that the controller has reported."""
        return limits_of(self._model, self._options, self.reported)

    @property
    def row(self) -> Any:
        """Newest raw row.

        Raises:
            RobotTimeout: The controller has not sent a row yet.
        """
        newest = self.receiver.newest
        if newest is None:
            raise RobotTimeout("the controller has not sent any state yet", hint="connect again")
        return newest[0]

    @property
    def believed(self) -> Payload:
        """Payload that the controller reports."""
        row = self.row
        x, y, z = (float(value) for value in row["payload_cog"])
        inertia: Any = (0.0,) * 6
        if "payload_inertia" in (row.dtype.names or ()):
            inertia = tuple(float(value) for value in row["payload_inertia"])
        return Payload(float(row["payload"]), (x, y, z), inertia)

    def open(self) -> None:
        """Connect and check that the arm can be moved by this driver.

        Raises:
            RobotConnectionError: No controller answers, or the controller moves a different arm.
            RobotFault: The state of the arm does not permit a motion, or another client moves it.
            SpecError: The controller does not send the RTDE output of the configured torque source.
        """
        self._find()
        self.facts = once_listening(self.host, lambda: dashboard_facts(self.host))
        once_listening(self.host, self.receiver.open)
        self._require_arm()
        self.reported, self.unreported = None, ""
        try:
            self.reported = reported_limits(self.host)
        except HilError as error:  # reported as a finding, which blocks only a run
            self.unreported = error.message
        row = self._row_once_idle()
        require_ready(self.host, self._model, self.facts, self.receiver.version, row)

    def listen(self) -> None:
        """Connect to record the motions that another client commands.

        Raises:
            RobotConnectionError: No controller answers, or the controller moves a different arm.
            SpecError: The controller does not send the RTDE output of the configured torque source.
        """
        self._find()
        once_listening(self.host, self.receiver.open)
        with contextlib.suppress(RobotConnectionError):  # RTDE alone is sufficient for listening
            self.facts = dashboard_facts(self.host)
        self._require_arm()

    def forget_rows(self) -> None:
        """Drop rows from before the start of the program.

        From then on, only the rows of the last `KEPT_S` are retained.
        """
        until = time.monotonic() + READ_BACK_S
        while time.monotonic() < until:
            if program_state(self.receiver.take(READ_BACK_S))[-1] == PLAYING:
                break
        self.receiver.keep(KEPT_S)

    def findings(
        self, declared: Payload | None, *, moved_by_us: Callable[[], bool]
    ) -> Iterator[Finding]:
        """Yield the preflight findings of the driver.

        Args:
            declared: Payload declared since the robot was connected; None if no payload was
                declared.
            moved_by_us: Function that returns whether the process that armed the watchdog is alive.
        """
        # Read the row after the dashboard answers, which can take seconds.
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
            f"watchdog armed at {hz:g} Hz in the robot program of hil, which is {program}",
            hz,
            hint="connect again",
        )

    def close(self) -> None:
        """Close the connection; repeated calls have no effect."""
        self.receiver.close()

    def _find(self) -> None:
        self.receiver.close()
        self.host = ip_address_of(self._options.address)
        self.receiver = Receiver(self.host, self._options.frequency_hz)

    def _require_arm(self) -> None:
        """Raise if the connected arm is not the model that the station names.

        Samples of a different arm would be fitted to the wrong model.
        """
        require_source(self._options.torque_source, self.receiver.missing)
        if wrong := _wrong_arm(self._model, self.facts, self.receiver.version):
            raise _error(RobotConnectionError, self.host, wrong)

    def _row_once_idle(self) -> np.void:
        """Wait until no other program plays or a time limit has passed; return the newest row.

        The program of a dead session ends when its watchdog expires. The time limit of the wait is
        the watchdog period plus `LEFT_OVER_S`.
        """
        until = time.monotonic() + 1.0 / self._options.watchdog_hz + LEFT_OVER_S
        row: np.void = self.receiver.take(READ_BACK_S)[-1]
        while occupied(row) and time.monotonic() < until:
            row = self.receiver.take(READ_BACK_S)[-1]
        return row

    def _limits_finding(self) -> Finding:
        """Check whether the used joint limits are within the controller's limits.

        The result of the check is a preflight finding.
        """
        if self.reported is None:
            message = f"the controller's joint limits are not known: {self.unreported}"
            hint = "check that port 30001 is open in the controller's security settings"
            return Finding("joint-limits", False, message, hint=hint)
        published, used = limits_of(self._model, self._options), self.limits
        by = {
            "rad": float(
                max((used.q_min - published.q_min).max(), (published.q_max - used.q_max).max())
            ),
            "rad/s": float((published.qd_max - used.qd_max).max()),
            "rad/s²": float((published.qdd_max - used.qdd_max).max()),
        }
        narrower = ", ".join(f"{value:.3f} {unit}" for unit, value in by.items() if value > 0)
        message = "joint limits used are no wider than the controller's limits on port 30001, which"
        if narrower:
            message += f" are narrower than the manufacturer's by up to {narrower}"
        else:
            message += " are as wide as the manufacturer's"
        wider = self.reported.exceeded_by(used)
        return Finding("joint-limits", not wider.any(), message, narrower or "0 rad")


@dataclass(frozen=True, slots=True)
class DashboardFacts:
    """Data of the dashboard server that RTDE does not send; empty if the server did not answer.

    Attributes:
        polyscope: Version of the controller's software.
        serial: Serial number of the arm.
        model: Model of the arm, such as `UR5`.
        remote: `true` in remote control, `false` in local control, empty if the controller does not
            distinguish them.
    """

    polyscope: str = ""
    serial: str = ""
    model: str = ""
    remote: str = ""


def dashboard_facts(address: str) -> DashboardFacts:
    """Request software version, serial number, model and control mode from the dashboard server.

    Raises:
        RobotConnectionError: No dashboard server answers.
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
    """Raise an error that lists all reasons why the arm cannot be moved, if there are any.

    Args:
        address: Address of the controller.
        model: Model of the arm in the station file.
        facts: Data of the controller that the dashboard server reported.
        version: Software version of the controller, from RTDE.
        row: Newest raw row of RTDE outputs.

    Raises:
        RobotConnectionError: The controller moves a different arm, or its software is too old.
        RobotFault: The state of the arm does not permit a motion.
    """
    if wrong := [*_wrong_arm(model, facts, version), *_too_old(version)]:
        raise _error(RobotConnectionError, address, wrong)
    # `ur-rtde` would end any running program, or wait minutes for its end.
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
        wrong.append((f"this is a {series} controller, but a {model} has a different one", remedy))
    size, reported = re.sub(r"\D", "", model), re.sub(r"\D", "", facts.model)
    if reported and reported != size:
        wrong.append(
            (f"the controller moves a {facts.model}, but the station names {model}", remedy)
        )
    return wrong


def _too_old(version: tuple[int, ...]) -> list[tuple[str, str]]:
    oldest = OLDEST.get(version[0])
    if oldest is None:
        return [(f"software {version[0]}.x is not supported", "use CB3 3.x or e-Series 5.x")]
    if tuple(version[:2]) >= oldest:
        return []
    what = f"software {'.'.join(map(str, version[:3]))} does not report the payload"
    return [(what, f"update the software to {oldest[0]}.{oldest[1]} or later")]


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
        message = "this controller does not distinguish local and remote control"
        return Finding("remote-control", True, message, "not reported")
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
        f"software {installed}; all required data is reported from {needed} on",
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
    """Yield findings about the network ports of a controller, without uploading a program.

    Args:
        address: Address of the controller.
        within_s: Timeout for each connection and each answer [s].
    """
    silent = {port: why for port in PORTS if (why := _why_silent(address, port, within_s))}
    if silent:
        reasons = ", ".join(f"{port} ({PORTS[port]}): {why}" for port, why in silent.items())
        hint = mock_first(address, "ur")
        hint += "check that the controller is on, its address right and its services enabled"
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
    yield Finding("mode", mode == "RUNNING", f"robot mode {mode or 'not reported'}", hint=hint)
    hint = "see the teach pendant for the cause of the stop"
    normal = safety in ("NORMAL", "REDUCED")
    yield Finding("safety", normal, f"safety mode {safety or 'not reported'}", hint=hint)
    if remote:
        control = "remote" if "true" in remote else "local"
        hint = "switch it to remote control at the teach pendant"
        yield Finding("control", control == "remote", f"in {control} control", hint=hint)


def _why_silent(address: str, port: int, within_s: float) -> str:
    """Return the reason why a port does not answer; empty if the port answers."""
    try:
        peer_of(address, port, within_s)
    except OSError as error:
        return reason(error)
    return ""
