"""Whatever clients of the mock UR controller send on all ports at once: no exception, no hang."""

import json
import math
import os
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil_mock_robot.server.journal import Journal
from hil_mock_robot.ur.connections import Service
from hil_mock_robot.ur.control_script import HANDLERS
from hil_mock_robot.ur.dashboard import COMMANDS, CONTROL_LOOP
from hil_mock_robot.ur.faults import UrFault, UrFaults
from hil_mock_robot.ur.journal import Witness
from hil_mock_robot.ur.mock import services_of
from hil_mock_robot.ur.pacing import LockStep
from hil_mock_robot.ur.rtde import RtdeService
from hil_mock_robot.ur.rtde_variables import inputs_of, outputs_of, series_of
from hil_mock_robot.ur.rtde_wire import Framer, Kind, package
from hil_mock_robot.ur.script_functions import ACTIONS
from hil_mock_robot.ur.side import SideService
from tests.support.fuzzing import ANYTHING, examples
from tests.support.ur_machine import machine_of

RTDE, DASHBOARD, PRIMARY, SECONDARY, REALTIME, SIDE = 30004, 29999, 30001, 30002, 30003, 30100
TEXT_PORTS = (PRIMARY, SECONDARY, REALTIME)
SERIES = series_of("ur5e")
OUTPUTS, INPUTS = outputs_of(SERIES).variables, inputs_of(SERIES).variables


class Link:
    """Takes everything, and nothing more once it is closed, as `TcpLink`."""

    peer = "127.0.0.1"

    def __init__(self, port):
        self.port, self.closed, self.pending = port, False, 0
        self.sent = bytearray()

    def send(self, data):
        if not self.closed:
            self.sent += data

    def close(self):
        self.closed = True


class Controller:
    """All ports without sockets, one client on each, and the journal that is written of them."""

    def __init__(self, arm, path):
        self.machine = machine_of(arm)
        services: list[Service] = list(services_of(self.machine))
        owners = next(each.owners for each in services if isinstance(each, RtdeService))
        self.faults = UrFaults(self.machine, (), owners)
        self.pacer = LockStep()
        self.side = SideService(SIDE, self.machine, self.faults, self.pacer)
        journal = Journal(path, "fuzzed")
        journal.open()
        self.witness = Witness(self.machine, journal)
        self.faults.listeners.append(self.witness.struck)
        self.services = {each.port: each for each in (*services, self.side)}
        self.clients = {}
        for port in self.services:
            self.call(port)

    def call(self, port):
        link = Link(port)
        self.clients[port] = link, self.services[port].accept(link)
        self.witness.connected(link)

    def say(self, port, data):
        link, session = self.clients[port]
        self.witness.received(link, data)
        session.received(data)
        self.part()

    def part(self):
        for port, (link, session) in list(self.clients.items()):
            if link.closed:
                session.hung_up()
                self.witness.disconnected(link)
                self.call(port)

    def tick(self):
        """As `Loop` does it, with a permit for every tick."""
        self.pacer.allow(1)
        self.faults.tick()
        if not self.faults.mock.dark:
            self.machine.tick()
        self.pacer.ticked()
        for _, session in self.clients.values():
            session.ticked()
        self.witness.ticked()
        self.side.ticked()
        self.part()

    def close(self):
        self.witness.close()


# What is sent

AWKWARD = (0.0, -0.0, 5e-324, 1e-320, -1e-320, 1e-9, 1e9, -1e9, 1e308, math.inf, math.nan)
awkward = st.sampled_from(AWKWARD)
numbers = st.one_of(st.floats(), st.floats(-7, 7), awkward, awkward)
whole = st.one_of(st.integers(-(2**31), 2**31 - 1), st.sampled_from([*HANDLERS, 0, 1, 2, 255]))


def names_of(variables):
    known, some = st.sampled_from([*variables]), st.sampled_from([*variables, "no_such", ""])
    lists = st.one_of(st.lists(known, min_size=1, max_size=6), st.lists(some, max_size=6))
    return lists.map(lambda names: ",".join(names).encode())


MOTION_INPUTS = [f"input_double_register_{i}" for i in range(18)]
COMMAND_INPUTS = [f"input_int_register_{i}" for i in range(8)]
RECORDED = [name for name in OUTPUTS if name in outputs_of(series_of("ur5"))][:60]
kinds = st.sampled_from(list(Kind))
setups = [
    package(Kind.PROTOCOL_VERSION, b"\x00\x02"),
    package(Kind.OUTPUTS, struct.pack(">d", 500.0) + ",".join(RECORDED).encode()),
    package(Kind.INPUTS, ",".join([*MOTION_INPUTS, *COMMAND_INPUTS]).encode()),
    package(Kind.START),
]
registers = st.builds(
    lambda d, i: package(Kind.DATA, b"\x01" + struct.pack(">18d8i", *d, *i)),
    st.lists(numbers, min_size=18, max_size=18),
    st.tuples(st.sampled_from([*HANDLERS, 0, 255]), *[whole] * 7),
)
CONTROL = b"def rtde_control():\n# int register offset\n0\nend\n"
packages = st.one_of(
    registers,
    st.just(b"".join(setups)),
    st.builds(
        lambda f, n: package(Kind.OUTPUTS, struct.pack(">d", f) + n),
        st.one_of(awkward, numbers),
        names_of(OUTPUTS),
    ),
    names_of(INPUTS).map(lambda names: package(Kind.INPUTS, names)),
    st.builds(package, kinds, st.binary(max_size=60)),
    st.builds(
        lambda r, b: package(Kind.DATA, bytes([r]) + b), st.integers(0, 4), st.binary(max_size=99)
    ),
    st.binary(max_size=60),
)
lines = st.one_of(
    st.builds(
        lambda command, rest: f"{command.text} {rest}\n".encode("utf-8", "replace"),
        st.sampled_from(COMMANDS),
        st.one_of(st.sampled_from(["", "rtde_control_loop.urp", "a.urp"]), st.text(max_size=20)),
    ),
    st.binary(max_size=60),
)
value = st.one_of(
    numbers.map(repr),
    whole.map(str),
    st.sampled_from(
        ["True", "[]", "[0,-1.4,1.6,-1.7,-1.5,0]", "[[]]", "p[-0.4,-0.2,0.3,0,3,0]", "x", "get()",
         '"stop"', '"input_int_register_0"', '"\\ud800"', "get_actual_tcp_pose()", "1/0",
         "[1e9,0,0,0,0,0]", "p[0,0,0,0,0,0]", "9" * 400, "((((((1))))))", "2*[1]", '"a"*99999'],
    ),
)  # fmt: skip
statement = st.one_of(
    st.builds(
        lambda name, values: f"{name}({','.join(values)})",
        st.sampled_from([*ACTIONS, "movej", "movel", "movep", "norm", "nothing", "write"]),
        st.lists(value, max_size=4),
    ),
    st.builds(lambda v: f"x = {v}", value),
    st.builds(lambda v: f"while {v}:\nx = x + 1\nsync()\nend", value),
    st.builds(lambda v: f"if {v}:\nhalt\nelse:\nsleep(0.01)\nend", value),
    st.text(max_size=30),
)
programs = st.one_of(
    st.builds(
        lambda kind, body: "\n".join([f"{kind} work():", *body, "end", ""]),
        st.sampled_from(["def", "sec"]),
        st.lists(statement, max_size=6),
    ),
    statement.map(lambda line: line + "\n"),
    st.just(CONTROL_LOOP),
    st.just(CONTROL.decode()),
    st.text(max_size=60),
).map(lambda text: text.encode("utf-8", "surrogatepass"))
keys = sorted({"kind", *(key for kind in UrFault.kinds.values() for key in kind.keys)})
given_values = st.one_of(numbers, whole, st.booleans(), st.just("inputs"))
requests = st.one_of(
    st.builds(
        lambda kind, more: {"do": "fault", "kind": kind, **more},
        st.sampled_from(list(UrFault.kinds)),
        st.dictionaries(st.sampled_from(keys), given_values, max_size=3),
    ),
    st.builds(lambda q: {"do": "push", "torque": q}, st.lists(numbers, min_size=6, max_size=6)),
    st.builds(lambda m: {"do": "mount", "mass_kg": m}, st.one_of(numbers, ANYTHING)),
    st.builds(
        lambda do, key, it: {"do": do, key: it},
        st.one_of(st.sampled_from(["fault", "clear", "state", "step", "speed"]), ANYTHING),
        st.sampled_from(["ticks", "factor", "torque", "mass_kg", "com_m", "kind"]),
        ANYTHING,
    ),
    ANYTHING,
).map(lambda request: json.dumps(request).encode() + b"\n")
said = st.one_of(
    st.tuples(st.just(RTDE), packages),
    st.tuples(st.just(RTDE), registers),
    st.tuples(st.just(DASHBOARD), lines),
    st.tuples(st.sampled_from(TEXT_PORTS), programs),
    st.tuples(st.just(SIDE), st.one_of(requests, st.binary(max_size=40))),
    st.tuples(st.just(None), st.integers(1, 10)),
)


def sound(controller):
    """It still does what a controller does: answers, publishes what can be packed, and stops."""
    controller.side.faults.clear()
    for _ in range(1000):
        if not controller.faults.mock.dark:
            break
        controller.tick()
    else:
        return  # it reboots for as long as it was told to
    controller.machine.halt()
    for _ in range(3):
        controller.tick()
    link = Link(RTDE)
    session = controller.services[RTDE].accept(link)
    session.received(b"".join(setups))
    controller.tick()
    session.ticked()
    sent = [kind for kind, _ in Framer().feed(bytes(link.sent))]
    session.hung_up()
    assert sent[:2] == [Kind.PROTOCOL_VERSION, Kind.OUTPUTS]
    assert Kind.DATA in sent
    outputs = controller.machine.outputs
    for each in outputs.variables.values():
        struct.pack(f">{each.format}", *outputs.flat[each.offset : each.offset + each.count])
    controller.say(DASHBOARD, b"\nrobotmode\n")
    assert b"Robotmode: " in controller.clients[DASHBOARD][0].sent


@pytest.mark.thorough
@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
@examples(15)
@given(st.booleans(), st.lists(said, min_size=1, max_size=25))
def test_no_client_ends_or_stops_the_controller(arm, controlled, talks):
    controller = Controller(arm, os.devnull)
    with np.errstate(all="ignore"):
        controller.say(RTDE, b"".join(setups))
        controller.say(REALTIME, CONTROL if controlled else b"")
        for port, what in talks:
            if port == RTDE:
                controller.say(port, what)
                controller.tick()
            elif port is None:
                for _ in range(what):
                    controller.tick()
            else:
                controller.say(port, what)
        sound(controller)
    controller.close()


@pytest.mark.thorough
@pytest.mark.parametrize("number", AWKWARD)
def test_no_command_of_the_control_script_stumbles_over_a_number(number):
    controller = Controller("ur5e", os.devnull)
    controller.say(RTDE, b"".join(setups))
    with np.errstate(all="ignore"):
        for command in HANDLERS:
            controller.machine.cut_power()
            controller.machine.boot(powered=True)
            controller.tick()
            controller.say(REALTIME, CONTROL)
            controller.tick()
            assert controller.machine.program is not None
            data = struct.pack(">18d8i", *[number] * 18, command, *[1] * 7)
            controller.say(RTDE, package(Kind.DATA, b"\x01" + data))
            for _ in range(3):
                controller.tick()
        sound(controller)
    controller.close()


@pytest.mark.parametrize("number", AWKWARD)
def test_no_frequency_stumbles(number):
    controller = Controller("ur5", os.devnull)
    controller.say(RTDE, setups[0])
    wanted = struct.pack(">d", number) + b"timestamp"
    controller.say(RTDE, package(Kind.OUTPUTS, wanted) + package(Kind.START))
    for _ in range(3):
        controller.tick()
    sound(controller)
    controller.close()
