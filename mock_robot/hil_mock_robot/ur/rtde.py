"""RTDE, port 30004: clients choose the outputs of every tick, and the inputs that they write.

`RtdeSession` is one client: its recipes, whether it has started, what it sends. `Ownership` lets
only one client at a time write an input. What an input does besides lying in a register (masked
outputs, the speed slider) takes effect when a package with a variable of its group comes.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". What the guide leaves open is in
docs/reference/mock-ur-rtde.md.
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
    """Listens for RTDE clients.

    Args:
        machine: Whose values they get.

    Attributes:
        owners: Owner of each input.
        sessions: Clients that are connected.
        dropped: Reason → how many packages of all clients were dropped for it.
    """

    port = 30004

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.owners = Ownership()
        self.sessions: list[RtdeSession] = []
        self.dropped: Counter[str] = Counter()

    def accept(self, link: Link) -> RtdeSession:
        """See `Service`."""
        session = RtdeSession(self, self.machine.line.over(link))
        self.sessions.append(session)
        return session

    def say(self, level: Level, source: str, text: str) -> int:
        """Send a text message to every client that has started; return their number."""
        return sum(session.say(level, source, text) for session in self.sessions)


PROTOCOLS = (1, 2)

PROTOCOL_1_HZ = 125.0
"""The only rate of protocol version 1."""

LEAST_HZ = 1e-3
"""Nobody waits longer than that for a package; what is asked for below is a mistake."""

MOST_RECIPES = 255
OUTPUT_RECIPE = 1
REFUSED = 0
NOT_FOUND, IN_USE = "NOT_FOUND", "IN_USE"
Effect = Callable[["Machine"], None]


class RtdeSession:
    """The conversation with one client.

    Args:
        service: Which it is connected to.
        link: The way to it.

    Attributes:
        protocol: Version of the protocol; 1 until it asks for another.
        started: Whether it gets data.
        dropped: Reason → how many of its packages were dropped for it.
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
        """Whether the client has started, and gets every package; see `Session`."""
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
            self._drop("a package shorter than its header: the connection is of no use any more")
            self._link.close()

    def ticked(self) -> None:
        """See `Session`."""
        if self.started and self._output is not None and not self._machine.ticks % self._every:
            self._link.send(self._output.pack(self._machine.outputs))

    def hung_up(self) -> None:
        """See `Session`; its inputs keep their values, but are free for others."""
        self.started = False
        self._service.owners.release(self)
        if self in self._service.sessions:
            self._service.sessions.remove(self)

    def hang_up(self) -> None:
        """End the connection from our side."""
        self._link.close()

    def say(self, level: Level, source: str, text: str) -> bool:
        """Send a text message to this client, if it has started.

        Before that clients take the next package for the reply they wait for.
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
        told = parsed_text(self.protocol, payload)
        if told is None:
            self._drop("a text message that is none")
            return None
        level, source, text = told
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
        """Return the reply to a set-up of outputs; version 1 has no ids there."""
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
        """Count a package that cannot be understood; each client gets each reason once."""
        self.dropped[why] += 1
        self._service.dropped[why] += 1
        if self.dropped[why] == 1:
            self._machine.tell("rtde_dropped", self._link.peer, why)
            self.say(Level.WARNING, "RTDE", f"dropped: {why}")


@runtime_checkable
class Client(Protocol):
    """An owner that is a connection."""

    def hang_up(self) -> None:
        """End the conversation."""


class Ownership:
    """Inputs and those who have them; a fieldbus that occupies some is an owner like any other."""

    def __init__(self) -> None:
        self._owners: dict[str, object] = {}

    @property
    def clients(self) -> list[Client]:
        """Owners that are connections, each once."""
        return [who for who in dict.fromkeys(self._owners.values()) if isinstance(who, Client)]

    def free(self, name: str, owner: object) -> bool:
        """Whether this owner has it or may have it."""
        return self._owners.get(name, owner) is owner

    def take(self, names: Iterable[str], owner: object) -> bool:
        """Take all inputs, or none if one has another owner."""
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
"""Of `analog_io_types`: analog output 0 and 1 are voltages."""


def _analog(machine: Machine) -> None:
    inputs, outputs = machine.inputs, machine.outputs
    mask, kinds = inputs["standard_analog_output_mask"], inputs["standard_analog_output_type"]
    for number, voltage in enumerate(VOLTAGE_BITS):
        ratio = inputs[f"standard_analog_output_{number}"]
        # What is not chosen may be anything: ur_rtde sends uninitialised memory there.
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
    """Return the effects of a package with these inputs, each once."""
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
