"""Faults of the mock UR controller, one class each (docs/reference/mock-ur-faults.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hil_mock_robot.server.faults import REQUIRED, Fault, Faults, choice, count, number, seconds
from hil_mock_robot.ur.machine import Event, Machine
from hil_mock_robot.ur.motion import Motion, StopJoints, StopL
from hil_mock_robot.ur.rtde import Ownership

DASHBOARD = 29999
OWNERS = "inputs"
"""Value of `only` that selects the connections whose clients own RTDE inputs."""


@dataclass(slots=True, eq=False)
class Target:
    """Parts of the mock on which faults act; `Loop` applies the attributes to the ports.

    Attributes:
        machine: Simulated controller.
        owners: Owners of the RTDE inputs.
        unplugged: Whether no data pass on any port, in either direction.
        mute: Ports whose clients are neither read nor answered.
        dark: Whether the controller is rebooting, so that its ports are closed and its time stands
            still.
    """

    machine: Machine
    owners: Ownership = field(default_factory=Ownership)
    unplugged: bool = False
    mute: frozenset[int] = frozenset()
    dark: bool = False


class UrFault(Fault[Target], counted=("motion", "program"), example="{kind: silence, at_s: 2.0}"):
    """Fault of the controller, its arm or its interfaces."""

    motion: int | None = count(None)
    program: int | None = count(None)


# Faults of connections and RTDE packages


class Cut(UrFault, kind="cut", lasts=True):
    """Disconnection of all RTDE clients; with a duration, new clients are disconnected too.

    With `only: inputs`, the fault disconnects the clients that own RTDE inputs, and only once.
    """

    for_s: float = 0.0
    only: str = choice(
        "", lambda given: given == OWNERS, f"{OWNERS}, or omit it to cut all connections"
    )

    def begin(self, mock: Target) -> None:
        if self.only != OWNERS:
            mock.machine.line.hang_up(stays=self.for_s > 0)
            return
        for owner in mock.owners.clients:
            owner.hang_up()

    def end(self, mock: Target) -> None:
        if self.only != OWNERS:
            mock.machine.line.cut = False


class Unplugged(UrFault, kind="unplugged", lasts=True):
    """Loss of all data on every port."""

    def begin(self, mock: Target) -> None:
        mock.unplugged = True

    def end(self, mock: Target) -> None:
        mock.unplugged = False


class _OnLine(UrFault):
    """Fault that affects all RTDE packages during its duration; applied by `Line`."""

    by_s = 0.0

    def begin(self, mock: Target) -> None:
        mock.machine.line.suffer(self.kind, self.by_s)

    def end(self, mock: Target) -> None:
        mock.machine.line.recover(self.kind, self.by_s)


class Silence(_OnLine, kind="silence", lasts=True):
    """Loss of all RTDE packages, including replies."""


class Jitter(_OnLine, kind="jitter", lasts=True):
    """Random delay of each package up to `by_s`; the order of packages is kept."""

    by_s: float = seconds(REQUIRED, most=60.0)


class Late(_OnLine, kind="late", lasts=True):
    """Constant delay of each package by `by_s`."""

    by_s: float = seconds(REQUIRED, most=60.0)


class Freeze(_OnLine, kind="freeze", lasts=True):
    """Repetition of the last data package."""


class _OfPackages(UrFault):
    """Fault of the next data packages of each connected client."""

    packages: int = count()
    by_bytes = 0

    def begin(self, mock: Target) -> None:
        mock.machine.line.owe(self.kind, self.packages, self.by_bytes)


class Drop(_OfPackages, kind="drop"):
    """Loss of the next data packages."""


class Duplicate(_OfPackages, kind="duplicate"):
    """Duplication of the next data packages."""


class WrongLength(_OfPackages, kind="wrong_length"):
    """Wrong length of the next data packages: too short or too long."""

    by_bytes: int = number(-8, -1000, 1000, "a whole number of bytes, −1000 to 1000", whole=True)


class Garbage(_OfPackages, kind="garbage"):
    """Random bytes in place of the next data packages."""


# Faults of the controller and its arm


class ProtectiveStop(UrFault, kind="protective_stop"):
    """Protective stop by the controller, with an error code C… of UR."""

    code: int = number(158, 100, 999, "a UR error code, 100 to 999", whole=True)

    def begin(self, mock: Target) -> None:
        mock.machine.protective_stop(self.code)


class EmergencyStop(UrFault, kind="emergency_stop"):
    """Emergency stop of the robot by its button."""

    def begin(self, mock: Target) -> None:
        mock.machine.emergency_stop()


class SafeguardStop(UrFault, kind="safeguard_stop", lasts=True):
    """Safeguard stop, for example by a light curtain; afterwards the program stays paused."""

    def begin(self, mock: Target) -> None:
        mock.machine.safeguard_stop()

    def end(self, mock: Target) -> None:
        mock.machine.modes.cause("end safeguard stop")


class SafetyFault(UrFault, kind="safety_fault"):
    """Fault of the safety system itself."""

    def begin(self, mock: Target) -> None:
        mock.machine.fault()


class Overheat(UrFault, kind="overheat"):
    """Sudden high temperature of one joint."""

    joint: int = number(2, 1, 6, "a joint from 1, the base, to 6", whole=True)
    celsius: float = number(90.0, -50, 200, "a temperature from −50 to 200 °C")

    def begin(self, mock: Target) -> None:
        mock.machine.body.heat(self.joint - 1, self.celsius)


class Reboot(UrFault, kind="reboot", lasts=True):
    """Power failure and restart of the controller; with `powered` the arm is then switched on."""

    for_s: float = 3.0
    powered: bool = choice(False, lambda given: isinstance(given, bool), "true or false")

    def begin(self, mock: Target) -> None:
        mock.dark = True
        mock.machine.cut_power()

    def end(self, mock: Target) -> None:
        mock.dark = False
        mock.machine.boot(powered=self.powered)


class InputsOwned(UrFault, kind="inputs_owned", lasts=True):
    """Occupation of all free RTDE inputs by a fieldbus."""

    def begin(self, mock: Target) -> None:
        for name in mock.machine.inputs.variables:
            if mock.owners.free(name, self):
                mock.owners.take([name], self)

    def end(self, mock: Target) -> None:
        mock.owners.release(self)


class RemoteOff(UrFault, kind="remote_off", lasts=True):
    """Change of the controller to local control."""

    def begin(self, mock: Target) -> None:
        mock.machine.modes.remote = False

    def end(self, mock: Target) -> None:
        mock.machine.modes.remote = True


class PayloadRefused(UrFault, kind="payload_refused", lasts=True):
    """Controller that ignores payload declarations and retains its payload."""

    def begin(self, mock: Target) -> None:
        mock.machine.body.deaf = True

    def end(self, mock: Target) -> None:
        mock.machine.body.deaf = False


class DashboardHang(UrFault, kind="dashboard_hang", lasts=True):
    """Dashboard server that does not answer."""

    def begin(self, mock: Target) -> None:
        mock.mute = frozenset({DASHBOARD})

    def end(self, mock: Target) -> None:
        mock.mute = frozenset()


class UrFaults(Faults[Target]):
    """Fault schedule of one mock, advanced tick by tick.

    Args:
        machine: Simulated controller.
        planned: Planned faults.
        owners: Owners of the RTDE inputs.
    """

    def __init__(
        self, machine: Machine, planned: Sequence[UrFault] = (), owners: Ownership | None = None
    ) -> None:
        target = Target(machine, owners or Ownership())
        super().__init__(
            target, UrFault, machine.tick_s, planned, stays=Reboot.kind, mend=machine.line.mend
        )
        self._motion: Motion | None = None
        machine.listeners.append(self._heard)

    def tick(self) -> None:
        """Begin and end the faults that are due before the machine's next tick."""
        machine = self.mock.machine
        motion, before, self._motion = machine.motion, self._motion, machine.motion
        if motion is not before and motion is not None and not isinstance(motion, _STOPS):
            self.began("motion")
        self.passed()
        machine.line.tick()

    def _heard(self, event: Event) -> None:
        if event.kind == "program_started":
            self.began("program")


_STOPS = (StopJoints, StopL)
