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
"""Of the connections, those whose client has inputs of RTDE."""


@dataclass(slots=True, eq=False)
class Target:
    """The parts of the mock that faults act on; `Loop` applies the attributes to the ports.

    Attributes:
        machine: The controller.
        owners: Of RTDE's inputs.
        unplugged: Nothing gets through on any port, in either direction.
        mute: Ports whose clients are neither heard nor answered.
        dark: Whether the controller is rebooting: ports are closed, and no time passes for it.
    """

    machine: Machine
    owners: Ownership = field(default_factory=Ownership)
    unplugged: bool = False
    mute: frozenset[int] = frozenset()
    dark: bool = False


class UrFault(Fault[Target], counted=("motion", "program"), example="{kind: silence, at_s: 2.0}"):
    """A fault of the controller, its arm or its interfaces."""

    motion: int | None = count(None)
    program: int | None = count(None)


# What happens to connections and RTDE packages


class Cut(UrFault, kind="cut", lasts=True):
    """RTDE connections are hung up on, as soon as they are made while it lasts.

    With `only: inputs` only those that own inputs are cut, and once.
    """

    for_s: float = 0.0
    only: str = choice(
        "", lambda given: given == OWNERS, f"{OWNERS}, or leave it away to cut all connections"
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
    """Nothing gets through on any port."""

    def begin(self, mock: Target) -> None:
        mock.unplugged = True

    def end(self, mock: Target) -> None:
        mock.unplugged = False


class _OnLine(UrFault):
    """A fault of RTDE packages, for as long as it lasts; `Line` applies it."""

    by_s = 0.0

    def begin(self, mock: Target) -> None:
        mock.machine.line.suffer(self.kind, self.by_s)

    def end(self, mock: Target) -> None:
        mock.machine.line.recover(self.kind, self.by_s)


class Silence(_OnLine, kind="silence", lasts=True):
    """Packages are lost, replies too."""


class Jitter(_OnLine, kind="jitter", lasts=True):
    """Packages come late, each by another time up to `by_s`; none overtakes."""

    by_s: float = seconds(REQUIRED, most=60.0)


class Late(_OnLine, kind="late", lasts=True):
    """Packages come late."""

    by_s: float = seconds(REQUIRED, most=60.0)


class Freeze(_OnLine, kind="freeze", lasts=True):
    """The last data package is repeated."""


class _OfPackages(UrFault):
    """A fault of the next data packages of each connected client."""

    packages: int = count()
    by_bytes = 0

    def begin(self, mock: Target) -> None:
        mock.machine.line.owe(self.kind, self.packages, self.by_bytes)


class Drop(_OfPackages, kind="drop"):
    """They are lost."""


class Duplicate(_OfPackages, kind="duplicate"):
    """They come twice."""


class WrongLength(_OfPackages, kind="wrong_length"):
    """They are too short or too long."""

    by_bytes: int = number(-8, -1000, 1000, "a whole number of bytes, −1000 to 1000", whole=True)


class Garbage(_OfPackages, kind="garbage"):
    """Any bytes come in their place."""


# What happens to the controller and its arm


class ProtectiveStop(UrFault, kind="protective_stop"):
    """The controller stops the arm, by one of UR's numbers C…."""

    code: int = number(158, 100, 999, "a UR error code, 100 to 999", whole=True)

    def begin(self, mock: Target) -> None:
        mock.machine.protective_stop(self.code)


class EmergencyStop(UrFault, kind="emergency_stop"):
    """The red button."""

    def begin(self, mock: Target) -> None:
        mock.machine.emergency_stop()


class SafeguardStop(UrFault, kind="safeguard_stop", lasts=True):
    """A light curtain is broken; when it is over the program stays paused until it is resumed."""

    def begin(self, mock: Target) -> None:
        mock.machine.safeguard_stop()

    def end(self, mock: Target) -> None:
        mock.machine.modes.cause("end safeguard stop")


class SafetyFault(UrFault, kind="safety_fault"):
    """The safety system itself fails."""

    def begin(self, mock: Target) -> None:
        mock.machine.fault()


class Overheat(UrFault, kind="overheat"):
    """A joint is hot at once."""

    joint: int = number(2, 1, 6, "a joint from 1, the base, to 6", whole=True)
    celsius: float = number(90.0, -50, 200, "a temperature from −50 to 200 °C")

    def begin(self, mock: Target) -> None:
        mock.machine.body.heat(self.joint - 1, self.celsius)


class Reboot(UrFault, kind="reboot", lasts=True):
    """The controller goes dark, and boots; with `powered` the arm is switched on then."""

    for_s: float = 3.0
    powered: bool = choice(False, lambda given: isinstance(given, bool), "true or false")

    def begin(self, mock: Target) -> None:
        mock.dark = True
        mock.machine.cut_power()

    def end(self, mock: Target) -> None:
        mock.dark = False
        mock.machine.boot(powered=self.powered)


class InputsOwned(UrFault, kind="inputs_owned", lasts=True):
    """A fieldbus occupies all inputs that no client has."""

    def begin(self, mock: Target) -> None:
        for name in mock.machine.inputs.variables:
            if mock.owners.free(name, self):
                mock.owners.take([name], self)

    def end(self, mock: Target) -> None:
        mock.owners.release(self)


class RemoteOff(UrFault, kind="remote_off", lasts=True):
    """The controller is in local control."""

    def begin(self, mock: Target) -> None:
        mock.machine.modes.remote = False

    def end(self, mock: Target) -> None:
        mock.machine.modes.remote = True


class PayloadRefused(UrFault, kind="payload_refused", lasts=True):
    """The controller goes on believing in the load it has, whatever is declared."""

    def begin(self, mock: Target) -> None:
        mock.machine.body.deaf = True

    def end(self, mock: Target) -> None:
        mock.machine.body.deaf = False


class DashboardHang(UrFault, kind="dashboard_hang", lasts=True):
    """Clients of the dashboard get no answer."""

    def begin(self, mock: Target) -> None:
        mock.mute = frozenset({DASHBOARD})

    def end(self, mock: Target) -> None:
        mock.mute = frozenset()


class UrFaults(Faults[Target]):
    """The faults of one mock, under way, tick by tick.

    Args:
        machine: What suffers.
        planned: Planned faults.
        owners: Of RTDE's inputs.
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
