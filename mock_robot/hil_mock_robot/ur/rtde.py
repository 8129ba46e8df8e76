"""RTDE server of the mock (port 30004): clients select outputs per tick and inputs to write.

`RtdeSession` is the session of one client, with recipes, state and sent packages. `Ownership`
ensures that only one client at a time writes an input. Some inputs have an effect beyond their
register (masked outputs, the speed slider). The effect of an input occurs when a package with a
variable of the same group arrives.

The source is Universal Robots, "Real-Time Data Exchange (RTDE) Guide". Behaviour that the guide
does not specify is described in docs/reference/mock-ur-rtde.md.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Protocol, runtime_checkable

from hil_mock_robot.ur.connections import Link
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.rtde_wire import (
    LONGEST_NAMES,
    Framer,
    InputRecipe,
    Kind,
    Level,
    OutputRecipe,
    names_in,
    package,
    parsed_text,
    text_message,
)


class RtdeService:
    """Service for RTDE clients.

    Args:
        machine: Controller whose variables the clients read and write.

    Attributes:
        owners: Owner of each input.
        sessions: Sessions of the connected clients.
        dropped: Map from reason to the number of packages of all clients that were dropped for this
            reason.
    """

    port = 30004

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.owners = Ownership()
        self.sessions: list[RtdeSession] = []
        self.dropped: Counter[str] = Counter()

    def accept(self, link: Link) -> RtdeSession:
        """Return the session of a new client; see `Service`."""
        session = RtdeSession(self, self.machine.line.over(link))
        self.sessions.append(session)
        return session

    def say(self, level: Level, source: str, text: str) -> int:
        """Send a text message to every client that has started; return their number."""
        return sum(session.say(level, source, text) for session in self.sessions)


PROTOCOLS = (1, 2)

PROTOCOL_1_HZ = 125.0
"""Fixed rate of protocol version 1 [Hz]."""

LEAST_HZ = 1e-3
"""Minimum accepted rate [Hz]; a lower request is considered a mistake of the client."""

MOST_RECIPES = 255
OUTPUT_RECIPE = 1
REFUSED = 0
NOT_FOUND, IN_USE = "NOT_FOUND", "IN_USE"
Effect = Callable[["Machine"], None]


class RtdeSession:
    """Session of one RTDE client.

    Args:
        service: Service of the session.
        link: Connection to the client.

    Attributes:
        protocol: Version of the protocol; 1 until the client requests a different version.
        started: Whether the client receives data.
        dropped: Map from reason to the number of packages of this client that were dropped for this
            reason.
    """

    def __init__(self, service: RtdeService, link: Link) -> None:
        self._service, self._machine, self._link = service, service.machine, link
        self._framer = Framer()
        self.protocol = 1
        self.started = False
        self.dropped: Counter[str] = Counter()
        self._output: OutputRecipe | None = None
        self._every = 1
        self._inputs: list[tuple[InputRecipe, tuple[Effect, ...]]] = []
        self._answers: dict[int, Callable[[bytes], bytes | None]] = {
            Kind.PROTOCOL_VERSION: self._agree,
            Kind.CONTROLLER_VERSION: self._version,
            Kind.TEXT: self._listen,
            Kind.OUTPUTS: self._set_up_outputs,
            Kind.INPUTS: self._set_up_inputs,
            Kind.START: self._start,
            Kind.PAUSE: self._pause,
            Kind.DATA: self._take,
        }

    @property
    def lossless(self) -> bool:
        """Whether the client has started and must receive every package; see `Session`."""
        return self.started

    def received(self, data: bytes) -> None:
        """See `Session`."""
        for kind, payload in self._framer.feed(data):
            answer = self._answers.get(kind)
            if answer is None:
                self._drop(f"kind {kind} is unknown")
                continue
            reply = answer(payload)
            if reply is not None:
                self._link.send(package(Kind(kind), reply))
            if self._link.closed:
                return
        if self._framer.lost:
            self._drop("a package shorter than its header: the connection is closed")
            self._link.close()

    def ticked(self) -> None:
        """See `Session`."""
        if self.started and self._output is not None and not self._machine.ticks % self._every:
            self._link.send(self._output.pack(self._machine.outputs))

    def hung_up(self) -> None:
        """Handle the end of the connection; the inputs keep their values and become free."""
        self.started = False
        self._service.owners.release(self)
        if self in self._service.sessions:
            self._service.sessions.remove(self)

    def hang_up(self) -> None:
        """Close the connection from the server side."""
        self._link.close()

    def say(self, level: Level, source: str, text: str) -> bool:
        """Send a text message to this client if it has started data; return whether it has started.

        Before the start, a client would take the message for the reply that the client awaits.
        """
        if self.started:
            self._link.send(text_message(self.protocol, level, source, text))
        return self.started

    def _agree(self, payload: bytes) -> bytes | None:
        if len(payload) != 2:
            self._drop("a protocol version of the wrong length")
            return None
        (wanted,) = struct.unpack(">H", payload)
        accepted = wanted in PROTOCOLS and not self.started
        if accepted and wanted != self.protocol:
            self.protocol, self._output = wanted, None
        return bytes([accepted])

    def _version(self, payload: bytes) -> bytes:
        return struct.pack(">4I", *self._machine.series.version)

    def _listen(self, payload: bytes) -> bytes | None:
        message = parsed_text(self.protocol, payload)
        if message is None:
            self._drop("an invalid text message")
            return None
        level, source, text = message
        self._machine.tell("client_message", source, text, int(level))
        return None

    def _set_up_outputs(self, payload: bytes) -> bytes | None:
        frequency = PROTOCOL_1_HZ
        if self.protocol > 1:
            if len(payload) < 8:
                self._drop("outputs without a frequency")
                return None
            (frequency,), payload = struct.unpack(">d", payload[:8]), payload[8:]
        self.started, self._output = False, None
        variables = self._machine.outputs.variables
        names = names_in(payload) if len(payload) <= LONGEST_NAMES else []
        types = [variables[name].type if name in variables else NOT_FOUND for name in names]
        if not names or NOT_FOUND in types or not LEAST_HZ <= frequency < math.inf:
            return self._recipe(REFUSED, types)
        number = OUTPUT_RECIPE if self.protocol > 1 else None
        self._output = OutputRecipe([variables[name] for name in names], number)
        self._every = max(1, round(self._machine.series.rate_hz / frequency))
        return self._recipe(OUTPUT_RECIPE, types)

    def _recipe(self, number: int, types: list[str]) -> bytes:
        """Return the reply to an output set-up; in protocol version 1 it has no recipe number."""
        return (b"" if self.protocol == 1 else bytes([number])) + ",".join(types).encode()

    def _set_up_inputs(self, payload: bytes) -> bytes:
        variables, owners = self._machine.inputs.variables, self._service.owners
        names = names_in(payload) if len(payload) <= LONGEST_NAMES else []
        types = [
            NOT_FOUND if name not in variables
            else variables[name].type if owners.free(name, self)
            else IN_USE
            for name in names
        ]  # fmt: skip
        refused = not names or NOT_FOUND in types or len(self._inputs) == MOST_RECIPES
        number = REFUSED
        if not refused and owners.take(names, self):
            recipe = InputRecipe([variables[name] for name in names])
            self._inputs.append((recipe, effects_of(names)))
            number = len(self._inputs)
        return bytes([number]) + ",".join(types).encode()

    def _start(self, payload: bytes) -> bytes:
        self.started = self._output is not None
        return bytes([self.started])

    def _pause(self, payload: bytes) -> bytes:
        self.started = False
        return b"\x01"

    def _take(self, payload: bytes) -> None:
        number = payload[0] if payload else 0
        if not 1 <= number <= len(self._inputs):
            self._drop("inputs of a recipe that was not set up")
            return
        recipe, effects = self._inputs[number - 1]
        values = recipe.unpack(payload[1:])
        if values is None:
            self._drop(f"inputs of recipe {number} of the wrong length")
            return
        for name, value in values:
            self._machine.write(name, value)
        for effect in effects:
            effect(self._machine)

    def _drop(self, why: str) -> None:
        """Count an invalid package; report each reason once to the client."""
        self.dropped[why] += 1
        self._service.dropped[why] += 1
        if self.dropped[why] == 1:
            self._machine.tell("rtde_dropped", self._link.peer, why)
            self.say(Level.WARNING, "RTDE", f"dropped: {why}")


@runtime_checkable
class Client(Protocol):
    """Owner of RTDE inputs that is a client connection."""

    def hang_up(self) -> None:
        """Close the connection to the client."""


class Ownership:
    """Owners of the RTDE inputs; a fieldbus that occupies inputs is an owner like a client."""

    def __init__(self) -> None:
        self._owners: dict[str, object] = {}

    @property
    def clients(self) -> list[Client]:
        """Owners that are connections, without repetitions."""
        return [who for who in dict.fromkeys(self._owners.values()) if isinstance(who, Client)]

    def free(self, name: str, owner: object) -> bool:
        """Return whether an input is free or already belongs to this owner."""
        return self._owners.get(name, owner) is owner

    def take(self, names: Iterable[str], owner: object) -> bool:
        """Assign all inputs to an owner, or no input if another owner has one of them."""
        names = list(names)
        if not all(self.free(name, owner) for name in names):
            return False
        self._owners.update(dict.fromkeys(names, owner))
        return True

    def release(self, owner: object) -> None:
        """Release all inputs of an owner."""
        self._owners = {name: who for name, who in self._owners.items() if who is not owner}

    def of(self, owner: object) -> list[str]:
        """Return the names of an owner's inputs."""
        return [name for name, who in self._owners.items() if who is owner]


STANDARD, CONFIGURABLE, TOOL = 0, 8, 16
"""Lowest bit of each group in `actual_digital_output_bits`."""

LOWEST_MA, SPAN_MA, SPAN_V = 4.0, 16.0, 10.0

VOLTAGE_BITS = (1 << 2, 1 << 3)
"""Bits of `analog_io_types` that are set if analog output 0 or 1 is a voltage instead of a
current."""


def _analog(machine: Machine) -> None:
    inputs, outputs = machine.inputs, machine.outputs
    mask, kinds = inputs["standard_analog_output_mask"], inputs["standard_analog_output_type"]
    for number, voltage in enumerate(VOLTAGE_BITS):
        ratio = inputs[f"standard_analog_output_{number}"]
        # Outputs without mask bit can have any value: ur_rtde sends uninitialised memory.
        if not mask >> number & 1 or not math.isfinite(ratio):
            continue
        ratio = min(max(ratio, 0.0), 1.0)
        is_voltage = bool(kinds >> number & 1)
        level = SPAN_V * ratio if is_voltage else LOWEST_MA + SPAN_MA * ratio
        outputs[f"standard_analog_output{number}"] = level
        types = outputs["analog_io_types"]
        outputs["analog_io_types"] = types | voltage if is_voltage else types & ~voltage


def _slider(machine: Machine) -> None:
    fraction = machine.inputs["speed_slider_fraction"]
    if machine.inputs["speed_slider_mask"] & 1 and math.isfinite(fraction):
        machine.speed_fraction = min(max(fraction, 0.0), 1.0)


_EFFECTS: dict[str, Effect] = {
    "standard_analog_output_mask": _analog,
    "standard_analog_output_type": _analog,
    "standard_analog_output_0": _analog,
    "standard_analog_output_1": _analog,
    "speed_slider_mask": _slider,
    "speed_slider_fraction": _slider,
}


def effects_of(names: Iterable[str]) -> tuple[Effect, ...]:
    """Return the effects of a package that contains these inputs, without repetitions."""
    return tuple(dict.fromkeys(_EFFECTS[name] for name in names if name in _EFFECTS))


def _digital(group: str, lowest: int, width: int) -> Effect:
    bits, mask = f"{group}_digital_output", f"{group}_digital_output_mask"

    def effect(machine: Machine) -> None:
        inputs, outputs = machine.inputs, machine.outputs
        chosen = (inputs[mask] & (1 << width) - 1) << lowest
        before = outputs["actual_digital_output_bits"]
        outputs["actual_digital_output_bits"] = (before & ~chosen) | (
            inputs[bits] << lowest & chosen
        )

    return effect


for _group, _lowest, _width in (
    ("standard", STANDARD, 8),
    ("configurable", CONFIGURABLE, 8),
    ("tool", TOOL, 2),
):
    _effect = _digital(_group, _lowest, _width)
    _EFFECTS[f"{_group}_digital_output"] = _EFFECTS[f"{_group}_digital_output_mask"] = _effect
