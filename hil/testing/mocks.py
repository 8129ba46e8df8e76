"""Mock robots for tests, each as a context manager: embedded, a UR controller, CiA 402 drives.

`mock_robot` is a robot in this process, on a virtual clock: it needs no time and no socket.
`ur_controller` and `can_bus` are what clients of a real controller talk to, so each is a process of
its own. Tests reach past the interface under test through a side channel (`MockProcess`): they ask
it for the truth about the arm, let something go wrong, and read its journal.

That process is this module too: `running` starts `python -m hil.testing.mocks NAME …`, whose `main`
becomes the mock. It ends when its standard input does: however the tests die, they leave no mock
behind. python-can is imported when a bus is asked for.
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
    """A robot that exists only here; beside the protocol it can be made to fail."""

    def fault(self, kind: str, **keys: Any) -> contextlib.ExitStack:
        """Let something go wrong now (docs/reference/mock.md); in a `with` until its end."""

    def clear(self) -> None:
        """What goes wrong is over and nothing is to come; a stop is over after `connect`."""

    def push(self, torque: Sequence[float] | FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""

    def wear(self, factor: Sequence[float] | FloatArray) -> None:
        """Scale all friction by `factor` (n,) from now on, 1 for as good as new."""


@contextlib.contextmanager
def mock_robot(
    model: str = "ur5", seed: int = 0, *, name: str = "mock", **options: Any
) -> Iterator[MockRobot]:
    """A connected mock robot; closed at the end.

    Args:
        model: A built-in arm.
        seed: Which individual.
        name: Its name, in messages.
        **options: Further ones of the mock (docs/reference/mock.md): `clock="wall"`,
            `profile="ideal"`, `faults=[{"kind": "refuse", "segment": 0}]`, …

    Raises:
        PluginError: The extra is missing.
        SpecError: There is no such arm or option.
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
    """A mock that runs as a process of its own.

    Attributes:
        process: The process.
    """

    def __init__(self, process: subprocess.Popen[str], journal: Path) -> None:
        self.process, self._journal = process, journal

    @abstractmethod
    def _line(self) -> socket.socket:
        """A new connection to the side channel."""

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """Ask the mock itself for something, past the interfaces under test; its answer.

        Args:
            do: A request of its side channel: `state`, `fault`, `push`, `mount`, …
            **more: What the request holds.

        Raises:
            CommandRefused: It does not do that.
            RobotConnectionError: It is not there any more.
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
        """The truth about the robot: where its arm is, modes, faults that last."""
        return self.tell("state")

    def fault(self, kind: str, **keys: Any) -> contextlib.ExitStack:
        """Let something go wrong now; in a `with` statement until its end.

        Args:
            kind: What: docs/reference/mock-ur-faults.md, docs/reference/mock-can-faults.md.
            **keys: Its further keys, such as `for_s`; `at_s` or `motion` for later.

        Raises:
            CommandRefused: There is no such kind or key.
        """
        self.tell("fault", kind=kind, **keys)
        over = contextlib.ExitStack()
        over.callback(self.clear)
        return over

    def clear(self) -> None:
        """What goes wrong is over and nothing is to come; stops stay until they are released."""
        self.tell("clear")

    def wait_until(
        self, true: Callable[[dict[str, Any]], bool], within_s: float = 10.0
    ) -> dict[str, Any]:
        """Wait until `true(state())`; returns that state.

        Raises:
            RobotTimeout: It does not become true in time.
        """
        until = time.monotonic() + within_s
        while not true(state := self.state()):
            if time.monotonic() > until:
                raise RobotTimeout(f"the mock has not got there within {within_s:g} s: {state}")
            time.sleep(_LOOKS_S)
        return state

    def journal(self, event: str = "") -> list[dict[str, Any]]:
        """What it was told and did so far, line by line.

        Args:
            event: Only lines of this event, such as `start`; all of them without.
        """
        if not self._journal.exists():
            return []
        text = self._journal.read_text("utf-8")
        lines = [dict(json.loads(line)) for line in text.splitlines()]
        return [line for line in lines if not event or line["event"] == event]

    def end(self) -> int:
        """End it; returns its exit code.

        Raises:
            RobotTimeout: It does not end, and was killed.
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
    """A UR controller that runs; give `host` to your client, ports are those of every UR.

    Attributes:
        host: Its address, a loopback one.
        model: The arm it controls.
    """

    def __init__(
        self, host: str, model: str, process: subprocess.Popen[str], journal: Path
    ) -> None:
        super().__init__(process, journal)
        self.host, self.model = host, model

    def dashboard(self, command: str) -> str:
        """Send one line to the dashboard server, as from a shell; its answer."""
        with (
            socket.create_connection((self.host, DASHBOARD), _CONNECT_S) as line,
            line.makefile("rw", encoding="utf-8", newline="\n") as text,
        ):
            text.readline()  # it greets first
            text.write(command + "\n")
            text.flush()
            return text.readline().strip()

    def press(self, button: str) -> dict[str, Any]:
        """Press what the teach pendant has, such as `unlock`: how stops are released.

        Raises:
            CommandRefused: It does nothing as things are; the hint says what would.
        """
        return self.tell("pendant", press=button)

    def _line(self) -> socket.socket:
        return socket.create_connection((self.host, SIDE), _CONNECT_S)


@contextlib.contextmanager
def ur_controller(
    model: str = "ur5", seed: int = 0, *, address: str | None = None, **options: Any
) -> Iterator[UrController]:
    """Start a mock UR controller, wait until it is ready, end it.

    Args:
        model: `ur3`, `ur5`, `ur10` (CB3) or `ur3e`, `ur5e`, `ur10e` (e-Series).
        seed: Which individual.
        address: A loopback address; a free one without.
        **options: Further ones of `hil mock ur`, with `_` for `-`: `speed=10`,
            `start_q_deg=[0, -90, 90, 0, 90, 0]`, `faults=[{"kind": "cut", "at_s": 2}]`, …

    Raises:
        PluginError: An extra is missing, or it does not start with these options.
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
    """A loopback address on which all ports of a controller are free.

    Raises:
        PluginError: There is none.
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
        hint="this needs Linux, where all of 127.0.0.0/8 is the computer itself; else address=",
    )


class CanBus(MockProcess):
    """Drives that run on a bus nobody else has.

    Attributes:
        interface, channel: Of the bus, as python-can wants them.
        model: The arm they move.
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
        """For `can.Bus(**config)` and `canopen.Network().connect(**config)`."""
        return {"interface": self.interface, "channel": self.channel}

    def bus(self, **more: Any) -> can.BusABC:
        """A further participant of the bus; it is shut down when the drives end, at the latest."""
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
    """Start mock drives on a bus of their own, wait until they are there, end them.

    Args:
        model: A built-in arm.
        seed: Which individual.
        **options: Further ones of `hil mock can`, with `_` for `-`: `bitrate=1_000_000`,
            `nodes=[11, 12, 13, 14, 15, 16]`, `faults=[{"kind": "emergency", "at_s": 2}]`, …

    Raises:
        PluginError: An extra is missing, or they do not start with these options.
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
    """Check that what a mock needs is installed; nothing is imported.

    Raises:
        PluginError: It is not; the hint says what to install.
    """
    missing = [module for extra in extras for module in plugins.absent_modules(extra)]
    if missing:
        raise plugins.not_installed(what, missing, *extras)


@contextlib.contextmanager
def own_folder() -> Iterator[Path]:
    """A temporary folder with a short path: that of a socket has 107 bytes at most."""
    with tempfile.TemporaryDirectory(prefix="hil-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


READY_WITHIN_S = 60.0
_LAST_WORDS_S = 5.0


@contextlib.contextmanager
def running(
    name: str, options: Mapping[str, Any], folder: Path
) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """Start a mock, wait until it is ready, end it; gives the process and its journal.

    Args:
        name: Of the mock, in the entry points `hil.mocks`.
        options: Of its command line, with `_` for `-`; `faults` may be a list.
        folder: For its files.

    Raises:
        PluginError: It does not start; the message is what it said.
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
            start_new_session=True,  # Ctrl-C is for the tests; they end their mocks themselves
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
            process.wait(_LAST_WORDS_S)  # its output ends before it does
    _, _, last = said.read_text("utf-8").strip().rpartition(": error: ")  # after its usage
    why = last or f"it says nothing for {READY_WITHIN_S:g} s"
    raise PluginError(f"the {name} mock does not start: {why}")


def main(arguments: Sequence[str]) -> int:
    """Be the mock that the first argument names; returns the exit code."""
    name, *own = arguments

    def end_with_the_input() -> None:
        while os.read(0, 1024):
            pass
        # To the main thread itself: a signal that another one hears does not wake it.
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)

    threading.Thread(target=end_with_the_input, name="hil-alone", daemon=True).start()
    try:
        return int(plugins.load("hil.mocks", name)().serve(own))
    except HilError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
