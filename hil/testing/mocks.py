"""Mock robots for tests as context managers: embedded robot, UR controller, CiA 402 drives.

The function `mock_robot` yields a robot inside this process on a virtual clock, which needs neither
real time nor a socket. The mocks of `ur_controller` and `can_bus` replace a real controller for its
clients, so that each mock runs in a separate process. Over a side channel (`MockProcess`), tests
read the true state of the arm, inject faults and read the journal of the mock.

The separate mock process also runs this module: `running` starts `python -m hil.testing.mocks NAME
…`, and `main` runs the mock. The mock process exits when its standard input is closed, so that no
mock remains after the tests, however the tests end. The package python-can is imported only if a
bus is requested.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hil.core import (
    CommandRefused,
    FloatArray,
    HilError,
    PluginError,
    RobotConnectionError,
    RobotTimeout,
    plugins,
)
from hil.robot import Robot

if TYPE_CHECKING:
    import can


class MockRobot(Robot, Protocol):
    """Type of a mock robot inside this process: robot protocol and fault injection."""

    def fault(self, kind: str, **keys: Any) -> contextlib.ExitStack:
        """Inject a fault now; a `with` statement removes the fault at its end.

        The kinds of faults are listed in docs/reference/mock.md.
        """

    def clear(self) -> None:
        """Remove all present and scheduled faults.

        After a stop, `connect` must also be called.
        """

    def push(self, torque: Sequence[float] | FloatArray) -> None:
        """Apply an external joint torque (n,) [N·m] from now on; zeros end the torque."""

    def wear(self, factor: Sequence[float] | FloatArray) -> None:
        """Scale the friction of the joints by `factor` (n,); 1 is the friction of a new arm."""


@contextlib.contextmanager
def mock_robot(
    model: str = "ur5", seed: int = 0, *, name: str = "mock", **options: Any
) -> Iterator[MockRobot]:
    """Yield a connected mock robot, which is closed after the block.

    Args:
        model: Name of a built-in arm.
        seed: Number that determines the parameters of the simulated individual arm.
        name: Name of the robot in messages.
        **options: Further options of the mock (docs/reference/mock.md): `clock="wall"`,
            `profile="ideal"`, `faults=[{"kind": "refuse", "segment": 0}]`, …

    Raises:
        PluginError: The extra of hil that the mock requires is not installed.
        SpecError: The arm or an option of the mock does not exist.
    """
    require_extras("the mock robot", "mock")
    robot: MockRobot = plugins.load("hil.drivers", "mock")(name, model, seed=seed, **options)
    try:
        robot.connect()
        yield robot
    finally:
        robot.close()


ANSWER_WITHIN_S = 60.0
ENDED_WITHIN_S = 20.0
_LOOKS_S = 0.02


class MockProcess(ABC):
    """Mock robot that runs in a separate process.

    Attributes:
        process: Process in which the mock runs.
    """

    def __init__(self, process: subprocess.Popen[str], journal: Path) -> None:
        self.process, self._journal = process, journal

    @abstractmethod
    def _line(self) -> socket.socket:
        """Return a new connection to the side channel of the mock."""

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """Send a request to the side channel of the mock and return its answer.

        Args:
            do: Name of the request: `state`, `fault`, `push`, `mount`, …
            **more: Parameters of the request.

        Raises:
            CommandRefused: The mock does not support the request.
            RobotConnectionError: The mock process has exited.
        """
        request = json.dumps({"do": do, **more}).encode() + b"\n"
        try:
            with self._line() as line, line.makefile("r", encoding="utf-8") as answers:
                line.settimeout(ANSWER_WITHIN_S)
                line.sendall(request)
                answer = dict(json.loads(answers.readline()))
        except (OSError, ValueError) as error:
            raise RobotConnectionError(f"the mock does not answer: {error}") from error
        if "error" in answer:
            raise CommandRefused(answer["error"], hint=answer.get("hint", ""))
        return answer

    def state(self) -> dict[str, Any]:
        """Return the true state of the robot: arm position, modes and persistent faults."""
        return self.tell("state")

    def fault(self, kind: str, **keys: Any) -> contextlib.ExitStack:
        """Inject a fault now; a `with` statement removes the fault at its end.

        Args:
            kind: Kind of the fault: docs/reference/mock-ur-faults.md,
                docs/reference/mock-can-faults.md.
            **keys: Further parameters, such as `for_s`; `at_s` or `motion` for a later fault.

        Raises:
            CommandRefused: The kind of fault or a parameter does not exist.
        """
        self.tell("fault", kind=kind, **keys)
        over = contextlib.ExitStack()
        over.callback(self.clear)
        return over

    def clear(self) -> None:
        """Remove all present and scheduled faults; stops remain until they are released."""
        self.tell("clear")

    def wait_until(
        self, true: Callable[[dict[str, Any]], bool], within_s: float = 10.0
    ) -> dict[str, Any]:
        """Wait until `true(state())` is true and return that state.

        Raises:
            RobotTimeout: The state does not satisfy the condition in time.
        """
        until = time.monotonic() + within_s
        while not true(state := self.state()):
            if time.monotonic() > until:
                raise RobotTimeout(f"the mock has not reached it within {within_s:g} s: {state}")
            time.sleep(_LOOKS_S)
        return state

    def journal(self, event: str = "") -> list[dict[str, Any]]:
        """Return the requests and actions of the mock so far, one per journal line.

        Args:
            event: Name of the events to return, such as `start`; empty for all events.
        """
        if not self._journal.exists():
            return []
        text = self._journal.read_text("utf-8")
        lines = [dict(json.loads(line)) for line in text.splitlines()]
        return [line for line in lines if not event or line["event"] == event]

    def end(self) -> int:
        """Stop the mock process; return its exit code.

        Raises:
            RobotTimeout: The process did not exit in time and was killed.
        """
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(ENDED_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise RobotTimeout(f"the mock has not ended within {ENDED_WITHIN_S:g} s") from None


DASHBOARD, SIDE = 29999, 30100
PORTS = (DASHBOARD, 30001, 30002, 30003, 30004, SIDE)
_CONNECT_S = 5.0
_TRIES = 100


class UrController(MockProcess):
    """Running mock UR controller; clients connect to `host` on the usual UR ports.

    Attributes:
        host: Loopback address of the controller.
        model: Name of the arm of the controller.
    """

    def __init__(
        self, host: str, model: str, process: subprocess.Popen[str], journal: Path
    ) -> None:
        super().__init__(process, journal)
        self.host, self.model = host, model

    def dashboard(self, command: str) -> str:
        """Send one line to the dashboard server and return its answer."""
        with (
            socket.create_connection((self.host, DASHBOARD), _CONNECT_S) as line,
            line.makefile("rw", encoding="utf-8", newline="\n") as text,
        ):
            text.readline()  # the server sends a greeting first
            text.write(command + "\n")
            text.flush()
            return text.readline().strip()

    def press(self, button: str) -> dict[str, Any]:
        """Press a button of the teach pendant, such as `unlock`, which releases stops.

        Raises:
            CommandRefused: The button has no effect in the present state; the hint names a button
                that has an effect.
        """
        return self.tell("pendant", press=button)

    def _line(self) -> socket.socket:
        return socket.create_connection((self.host, SIDE), _CONNECT_S)


@contextlib.contextmanager
def ur_controller(
    model: str = "ur5", seed: int = 0, *, address: str | None = None, **options: Any
) -> Iterator[UrController]:
    """Start a mock UR controller, yield it when it is ready, and end it after the block.

    Args:
        model: Name of the arm: `ur3`, `ur5`, `ur10` (CB3) or `ur3e`, `ur5e`, `ur10e` (e-Series).
        seed: Number that determines the parameters of the simulated individual arm.
        address: Loopback address of the controller; by default a free address. **options: Further
            options of `hil mock ur`, with `_` for `-`: `speed=10`, `start_q_deg=[0, -90, 90, 0, 90,
            0]`, `faults=[{"kind": "cut", "at_s": 2}]`, …
        **options: Further options of `hil mock ur`, with `_` for `-`: `speed=10`, `start_q_deg=[0,
            -90, 90, 0, 90, 0]`, `faults=[{"kind": "cut", "at_s": 2}]`, …

    Raises:
        PluginError: An extra of hil that the mock requires is not installed, or the mock does not
            start with these options.
    """
    require_extras("the mock UR controller", "mock")
    host = address or free_address()
    given = {"model": model, "seed": seed, "address": host, **options}
    with own_folder() as folder, running("ur", given, folder) as (process, journal):
        controller = UrController(host, model, process, journal)
        try:
            yield controller
        finally:
            controller.end()


def free_address() -> str:
    """Return a loopback address on which all ports of a controller are free.

    Raises:
        PluginError: No loopback address is free.
    """

    def free(address: str, port: int) -> bool:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
            except OSError:
                return False
        return True

    for _ in range(_TRIES):
        numbers = (1 + secrets.randbelow(250) for _ in range(3))
        address = "127." + ".".join(map(str, numbers))
        if all(free(address, port) for port in PORTS):
            return address
    raise PluginError(
        "no loopback address is free for a UR controller",
        hint="use Linux, where 127.0.0.0/8 is local, or pass address=",
    )


class CanBus(MockProcess):
    """Running mock CiA 402 drives on a separate CAN bus.

    Attributes:
        interface, channel: Interface and channel of the bus for python-can.
        model: Name of the arm whose drives are simulated.
    """

    interface = "hil_unix"

    def __init__(
        self, channel: Path, model: str, process: subprocess.Popen[str], journal: Path
    ) -> None:
        super().__init__(process, journal)
        self.channel, self.model = str(channel), model
        self._side = str(channel.with_suffix(".side"))
        self._opened = contextlib.ExitStack()

    @property
    def config(self) -> dict[str, str]:
        """Arguments to connect: `can.Bus(**config)`, `canopen.Network().connect(**config)`."""
        return {"interface": self.interface, "channel": self.channel}

    def bus(self, **more: Any) -> can.BusABC:
        """Return a further node of the bus, which is shut down with the drives or earlier."""
        import can

        return self._opened.enter_context(
            can.Bus(interface=self.interface, channel=self.channel, **more)
        )

    def end(self) -> int:
        """See `MockProcess.end`."""
        self._opened.close()
        return super().end()

    def _line(self) -> socket.socket:
        line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            line.connect(self._side)
        except OSError:
            line.close()
            raise
        return line


@contextlib.contextmanager
def can_bus(model: str = "lab6", seed: int = 0, **options: Any) -> Iterator[CanBus]:
    """Start mock drives on a separate bus, yield them when ready, and end them.

    Args:
        model: Name of a built-in arm.
        seed: Number that determines the parameters of the simulated individual arm. **options:
            Further options of `hil mock can`, with `_` for `-`: `bitrate=1_000_000`, `nodes=[11,
            12, 13, 14, 15, 16]`, `faults=[{"kind": "emergency", "at_s": 2}]`, …
        **options: Further options of `hil mock can`, with `_` for `-`: `bitrate=1_000_000`,
            `nodes=[11, 12, 13, 14, 15, 16]`, `faults=[{"kind": "emergency", "at_s": 2}]`, …

    Raises:
        PluginError: An extra of hil that the mock requires is not installed, or the mock does not
            start with these options.
    """
    require_extras("the mock drives", "can", "mock")
    with own_folder() as folder:
        channel = folder / "can0.sock"
        given = {"channel": channel, "model": model, "seed": seed, **options}
        with running("can", given, folder) as (process, journal):
            drives = CanBus(channel, model, process, journal)
            try:
                yield drives
            finally:
                drives.end()


def require_extras(what: str, *extras: str) -> None:
    """Raise if a package that a mock requires is not installed; nothing is imported.

    Raises:
        PluginError: A package is missing; the hint contains the installation command.
    """
    missing = [module for extra in extras for module in plugins.absent_modules(extra)]
    if missing:
        raise plugins.not_installed(what, missing, *extras)


@contextlib.contextmanager
def own_folder() -> Iterator[Path]:
    """Yield a temporary folder with a short path, because socket paths have at most 107 bytes."""
    with tempfile.TemporaryDirectory(prefix="hil-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


READY_WITHIN_S = 60.0
_LAST_WORDS_S = 5.0


@contextlib.contextmanager
def running(
    name: str, options: Mapping[str, Any], folder: Path
) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """Start a mock, yield its process and journal when it is ready, and end it.

    Args:
        name: Name of the mock in the entry points `hil.mocks`.
        options: Command-line options of the mock, with `_` for `-`; the value of `faults` can be a
            list.
        folder: Folder in which the mock stores its files.

    Raises:
        PluginError: The mock does not start; the message contains its error output.
    """
    options = {"journal": folder / "journal.jsonl", **options}
    command = [sys.executable, "-m", "hil.testing.mocks", name, *_arguments(options, folder)]
    said = folder / "stderr"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with (
        said.open("w", encoding="utf-8") as errors,
        subprocess.Popen(  # noqa: S603 - this interpreter, our own module
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environment,
            start_new_session=True,  # Ctrl-C must reach only the tests, which end their mocks
        ) as process,
    ):
        try:
            _wait_until_ready(name, process, said)
            yield process, Path(options["journal"])
        finally:
            if process.poll() is None:
                process.kill()


def _arguments(options: Mapping[str, Any], folder: Path) -> Iterator[str]:
    for key, value in options.items():
        flag = "--" + key.replace("_", "-")
        if value is None or value is False:
            continue
        if value is True:
            yield flag
        elif key == "faults" and not isinstance(value, str | Path):
            file = folder / "faults.yaml"  # JSON is YAML
            file.write_text(json.dumps(list(value)), "utf-8")
            yield f"{flag}={file}"
        elif isinstance(value, list | tuple):
            yield from (flag, *map(str, value))
        else:
            yield f"{flag}={value}"


def _wait_until_ready(name: str, process: subprocess.Popen[str], said: Path) -> None:
    assert process.stdout is not None
    readable, _, _ = select.select([process.stdout], [], [], READY_WITHIN_S)
    if readable and process.stdout.readline().startswith("ready"):
        return
    if readable:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_LAST_WORDS_S)  # the output is closed before the process exits
    # The error message follows the usage text.
    _, _, last = said.read_text("utf-8").strip().rpartition(": error: ")
    why = last or f"it printed nothing for {READY_WITHIN_S:g} s"
    raise PluginError(f"the {name} mock does not start: {why}")


def main(arguments: Sequence[str]) -> int:
    """Run the mock named by the first argument; return the exit code."""
    name, *own = arguments

    def end_with_the_input() -> None:
        while os.read(0, 1024):
            pass
        # Sent to the main thread, because a signal handled by a different thread does not wake it.
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)

    threading.Thread(target=end_with_the_input, name="hil-alone", daemon=True).start()
    try:
        return int(plugins.load("hil.mocks", name)().serve(own))
    except HilError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
