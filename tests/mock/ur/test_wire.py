"""RTDE without sockets: framing, recipes, sessions, masked inputs."""

import math
import struct
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil_mock_robot.ur.rtde import RtdeService
from hil_mock_robot.ur.rtde_variables import WIRE, Values
from hil_mock_robot.ur.rtde_wire import Framer, InputRecipe, Kind, Level, OutputRecipe, package
from tests.support.fuzzing import examples
from tests.support.ur_machine import Wire, machine_of

SIX = [f"output_double_register_{i}" for i in range(12, 20)]
RECEIVED = """
    timestamp target_q target_qd target_qdd target_current target_moment actual_q actual_qd
    actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force
    target_TCP_pose target_TCP_speed actual_digital_input_bits joint_temperatures
    actual_execution_time robot_mode joint_mode safety_mode actual_tool_accelerometer
    speed_scaling target_speed_fraction actual_momentum actual_main_voltage
    actual_robot_voltage actual_robot_current actual_joint_voltage actual_digital_output_bits
    runtime_state standard_analog_input0 standard_analog_input1 standard_analog_output0
    standard_analog_output1 robot_status_bits safety_status_bits
"""
REGISTERS = [f"output_int_register_{i}" for i in (2, *range(12, 20))] + SIX
LOAD = ["payload", "payload_cog", "payload_inertia"]


@cache
def machine(arm):
    """One for many examples: making an arm takes longer than a test of bytes."""
    return machine_of(arm)


class Conversation:
    """A session, and what it answers."""

    def __init__(self, arm="ur5", service=None, on=None):
        self.service = service or RtdeService(on or machine(arm))
        self.machine = self.service.machine
        self.wire = Wire()
        self.session = self.service.accept(self.wire)

    def ask(self, kind, payload=b""):
        """Payload of the only reply, which must be of the same kind; None when there is none."""
        self.session.received(package(kind, payload))
        replies = self.answers()
        if not replies:
            return None
        ((answered, reply),) = replies
        assert answered == kind
        return reply

    def answers(self):
        return Framer().feed(self.wire.take())

    def agree(self, version=2):
        return self.ask(Kind.PROTOCOL_VERSION, struct.pack(">H", version))

    def outputs(self, names, frequency=125.0):
        return self.ask(Kind.OUTPUTS, struct.pack(">d", frequency) + names.encode())

    def inputs(self, names):
        return self.ask(Kind.INPUTS, names.encode())

    def tick(self, count=1):
        for _ in range(count):
            self.machine.tick()
            self.session.ticked()


@pytest.fixture
def client():
    talk = Conversation(on=machine_of())
    talk.agree()
    return talk


kinds = st.sampled_from(list(Kind))


# Framing


@pytest.mark.thorough
@examples(200)
@given(
    st.lists(st.tuples(kinds, st.binary(max_size=300)), max_size=12),
    st.lists(st.integers(1, 40), min_size=1),
)
def test_packages_come_out_whole_wherever_the_stream_is_cut(packages, cuts):
    stream = b"".join(package(kind, payload) for kind, payload in packages)
    framer, found, at = Framer(), [], 0
    while at < len(stream):
        cut = cuts[at % len(cuts)]
        found += framer.feed(stream[at : at + cut])
        at += cut
    assert found == packages
    assert framer.held == 0


def test_a_length_below_the_header_ends_the_stream_after_what_was_whole():
    framer = Framer()
    first = framer.feed(package(Kind.START) + b"\x00\x02S" + package(Kind.PAUSE))
    assert first == [(Kind.START, b"")]
    assert framer.lost
    assert framer.feed(package(Kind.PAUSE)) == []
    assert framer.held == 0


@examples(200)
@given(st.lists(st.binary(max_size=4000), max_size=40))
def test_a_framer_never_holds_more_than_one_package(pieces):
    framer = Framer()
    for piece in pieces:
        framer.feed(piece)
        assert framer.held < 65_536


# Recipes

NUMBERS = {
    "?": st.booleans(),
    "B": st.integers(0, 2**8 - 1),
    "I": st.integers(0, 2**32 - 1),
    "Q": st.integers(0, 2**64 - 1),
    "i": st.integers(-(2**31), 2**31 - 1),
    "d": st.floats(allow_nan=False),
}


@st.composite
def filled(draw):
    """Variables of any types with values, in any order."""
    types = draw(st.lists(st.sampled_from(sorted(WIRE)), min_size=1, max_size=12))
    values = Values((f"v{i}", kind) for i, kind in enumerate(types))
    for name, at in values.variables.items():
        numbers = [draw(NUMBERS[WIRE[at.type][0]]) for _ in at.places]
        values[name] = numbers if at.count > 1 else numbers[0]
    return values, draw(st.permutations(sorted(values.variables)))


@pytest.mark.thorough
@examples(200)
@given(filled(), st.sampled_from([None, 1, 255]))
def test_what_an_output_recipe_packs_an_input_recipe_unpacks(content, number):
    values, order = content
    variables = [values.variables[name] for name in order]
    packed = OutputRecipe(variables, number).pack(values)
    ((kind, payload),) = Framer().feed(packed)
    assert kind == Kind.DATA
    if number is not None:
        assert payload[0] == number
        payload = payload[1:]
    recipe = InputRecipe(variables)
    assert recipe.unpack(payload) == [(name, values[name]) for name in order]
    assert recipe.unpack(payload + b"\x00") is None
    assert recipe.unpack(payload[:-1]) is None


@pytest.mark.parametrize(
    ("arm", "names", "size"),
    [
        # Measured with ur_rtde 1.6.5.
        ("ur5", [*RECEIVED.split(), *LOAD, *REGISTERS], 1132),
        ("ur5e", [*RECEIVED.split(), "ft_raw_wrench", *LOAD, *REGISTERS], 1180),
    ],
)
def test_data_packages_are_as_long_as_those_of_a_controller(arm, names, size):
    talk = Conversation(on=machine_of(arm))
    talk.agree()
    assert talk.outputs(",".join(names), talk.machine.series.rate_hz)[0] == 1
    assert talk.ask(Kind.START) == b"\x01"
    talk.tick()
    assert len(talk.wire.take()) == size


@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
def test_every_output_can_be_packed_while_the_arm_lives(arm):
    it = machine_of(arm)
    recipe = OutputRecipe(list(it.outputs.variables.values()), 1)
    for change in (lambda: None, lambda: it.protective_stop(4), it.emergency_stop):
        change()
        it.tick()
        assert len(recipe.pack(it.outputs)) == 4 + sum(
            struct.calcsize(">" + each.format) for each in it.outputs.variables.values()
        )


def test_values_do_not_shift_what_lies_behind_them():
    values = Values([("a", "VECTOR3D"), ("b", "DOUBLE")])
    with pytest.raises(ValueError, match="a: 4 numbers instead of 3"):
        values["a"] = [1.0, 2.0, 3.0, 4.0]
    assert values.flat == [0.0] * 4


# A session


def test_the_version_is_four_numbers(client):
    assert struct.unpack(">4I", client.ask(Kind.CONTROLLER_VERSION)) == (3, 15, 8, 106339)


def test_versions_1_and_2_of_the_protocol_are_accepted_and_no_others(client):
    assert [client.agree(version) for version in (1, 2, 0, 3, 65535)] == [
        b"\x01", b"\x01", b"\x00", b"\x00", b"\x00"
    ]  # fmt: skip
    assert client.session.protocol == 2


def test_a_comma_at_the_end_of_the_list_adds_nothing(client):
    assert client.outputs("timestamp,actual_q,") == b"\x01DOUBLE,VECTOR6D"
    assert client.inputs("input_int_register_0,") == b"\x01INT32"


def test_unknown_variables_are_named_and_refused(client):
    assert client.outputs("timestamp,actual_qdd,robot_mode") == b"\x00DOUBLE,NOT_FOUND,INT32"
    assert client.ask(Kind.START) == b"\x00"
    assert client.inputs("speed_slider_mask,actual_q") == b"\x00UINT32,NOT_FOUND"


@pytest.mark.parametrize(
    ("arm", "name", "known"),
    [
        ("ur5", "ft_raw_wrench", False),
        ("ur5e", "ft_raw_wrench", True),
        ("ur5e", "actual_current_as_torque", False),
        ("ur5", "tcp_offset", True),
        ("ur5", "payload_inertia", True),
        ("ur5", "output_bit_register_63", False),
        ("ur5", "output_bit_register_64", True),
        ("ur5", "output_bit_register_128", False),
        ("ur5e", "output_int_register_48", False),
    ],
)
def test_what_a_software_does_not_have_is_not_found(arm, name, known):
    talk = Conversation(arm)
    talk.agree()
    assert (talk.outputs(name)[:1] == b"\x01") is known


def test_nothing_starts_without_outputs(client):
    assert client.ask(Kind.START) == b"\x00"
    client.tick()
    assert client.answers() == []


@pytest.mark.thorough
@pytest.mark.parametrize("frequency", [0.0, -1.0, 5e-324, 1e-4, math.nan, math.inf])
def test_a_frequency_that_cannot_be_is_refused(client, frequency):
    assert client.outputs("timestamp", frequency) == b"\x00DOUBLE"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arm", "frequency", "every"),
    [("ur5", 125.0, 1), ("ur5", 500.0, 1), ("ur5", 10.0, 12), ("ur5e", 125.0, 4), ("ur5e", 30, 17)],
)
def test_every_so_manieth_tick_is_told(arm, frequency, every):
    talk = Conversation(on=machine_of(arm))
    talk.agree()
    talk.outputs("timestamp", frequency)
    talk.ask(Kind.START)
    talk.tick(4 * every)
    told = [struct.unpack(">d", payload[1:])[0] for _, payload in talk.answers()]
    assert told == pytest.approx([n * every * talk.machine.tick_s for n in (1, 2, 3, 4)])


def test_a_pause_holds_the_data_and_a_start_lets_it_go_on(client):
    client.outputs("timestamp")
    client.ask(Kind.START)
    client.tick(2)
    assert len(client.answers()) == 2
    assert client.ask(Kind.PAUSE) == b"\x01"
    client.tick(3)
    assert client.answers() == []
    assert client.ask(Kind.START) == b"\x01"
    client.tick(1)
    assert len(client.answers()) == 1


def test_new_outputs_replace_the_old_ones_and_wait_for_a_start(client):
    client.outputs("timestamp")
    client.ask(Kind.START)
    assert client.outputs("robot_mode") == b"\x01INT32"
    client.tick()
    assert client.answers() == []
    client.ask(Kind.START)
    client.tick()
    assert client.answers() == [(Kind.DATA, b"\x01\x00\x00\x00\x07")]


def test_version_1_has_one_rate_and_no_recipe_ids():
    talk = Conversation(on=machine_of("ur5e"))
    assert talk.ask(Kind.OUTPUTS, b"timestamp,robot_mode") == b"DOUBLE,INT32"
    talk.ask(Kind.START)
    talk.tick(4)
    ((_, payload),) = talk.answers()
    assert struct.unpack(">di", payload) == (0.008, 7)


def test_more_than_2048_bytes_of_names_are_refused(client):
    longest = ",".join(["timestamp"] * 204)
    assert len(longest) + 9 == 2048
    assert client.outputs(longest + ",robot_m")[:1] == b"\x00"
    assert client.outputs(longest)[:1] == b"\x01"
    assert client.outputs(longest + ",timestamp") == b"\x00"
    assert client.inputs(",".join(["input_int_register_0"] * 98)) == b"\x00"


def test_recipes_of_inputs_are_numbered_one_after_the_other_and_refused_ones_are_not(client):
    names = ["input_int_register_0", "no_such", "input_int_register_0", "input_int_register_1"]
    assert [client.inputs(name)[0] for name in names] == [1, 0, 2, 3]


def test_an_input_belongs_to_one_client_until_it_hangs_up():
    service = RtdeService(machine_of())
    one, two = Conversation(service=service), Conversation(service=service)
    assert one.inputs("input_int_register_0") == b"\x01INT32"
    wanted = "input_int_register_1,input_int_register_0"
    assert two.inputs(wanted) == b"\x00INT32,IN_USE"
    assert one.inputs("input_int_register_1") == b"\x02INT32", "a refused recipe takes nothing"
    one.session.hung_up()
    assert two.inputs(wanted) == b"\x01INT32,INT32"


def test_a_fieldbus_may_own_inputs(client):
    client.service.owners.take(["input_int_register_0"], "fieldbus")
    assert client.inputs("input_int_register_0") == b"\x00IN_USE"
    client.service.owners.release("fieldbus")
    assert client.inputs("input_int_register_0") == b"\x01INT32"


def test_inputs_are_taken_before_any_start_and_echoed(client):
    client.inputs("input_int_register_0,input_double_register_3,input_bit_registers0_to_31")
    assert client.ask(Kind.DATA, b"\x01" + struct.pack(">idI", -7, 2.5, 9)) is None
    for values in (client.machine.inputs, client.machine.outputs):
        assert values["input_int_register_0"] == -7
        assert values["input_double_register_3"] == 2.5
        assert values["input_bit_registers0_to_31"] == 9
    client.session.hung_up()
    assert client.machine.inputs["input_int_register_0"] == -7


@examples(100)
@given(st.binary(max_size=120).filter(lambda each: len(each) != 13))
def test_inputs_of_the_wrong_length_change_nothing(payload):
    it = machine("ur5")
    talk = Conversation()
    talk.inputs("input_int_register_0,input_double_register_0")
    before = list(it.inputs.flat)
    talk.session.received(package(Kind.DATA, payload))
    assert it.inputs.flat == before
    assert sum(talk.session.dropped.values()) == 1
    assert talk.wire.take() == b""


def test_a_client_hears_of_dropped_packages_once_and_only_after_its_start(client):
    client.session.received(package(Kind.DATA, b"\x07"))
    assert client.answers() == []
    client.outputs("timestamp")
    client.ask(Kind.START)
    client.session.received(package(Kind.DATA, b"") * 3 + b"\x00\x04Xx" * 2)
    ((kind, payload),) = client.answers()
    assert kind == Kind.TEXT
    assert payload[-1] == Level.WARNING
    assert payload[1 : 1 + payload[0]] == b"dropped: kind 88 is unknown"
    assert client.session.dropped == {
        "inputs of a recipe that was not set up": 4,
        "kind 88 is unknown": 2,
    }


def test_words_are_laid_out_as_each_version_of_the_protocol_wants_them():
    texts = []
    for version in (1, 2):
        talk = Conversation()
        talk.agree(version)
        assert talk.session.say(Level.ERROR, "here", "early") is False
        assert talk.wire.take() == b""
        talk.ask(Kind.OUTPUTS, (b"" if version == 1 else struct.pack(">d", 125)) + b"timestamp")
        talk.ask(Kind.START)
        assert talk.session.say(Level.ERROR, "here", "är" + 300 * "x") is True
        ((_, payload),) = talk.answers()
        texts.append(payload)
    text = "är".encode() + 252 * b"x"
    assert texts == [b"\x01" + text, b"\xff" + text + b"\x04here\x01"]


def test_a_client_may_say_something(client):
    heard = []
    client.machine.listeners.append(heard.append)
    client.session.received(package(Kind.TEXT, b"\x02hi\x02me\x03" + b""))
    assert [(each.kind, each.name, each.text, each.code) for each in heard] == [
        ("client_message", "me", "hi", 3)
    ]
    client.session.received(package(Kind.TEXT, b"\x09hi"))
    assert client.session.dropped == {"an invalid text message": 1}


def names_of(values):
    return st.lists(st.sampled_from([*values.variables, "no_such", ""]), max_size=6).map(",".join)


@st.composite
def conversations(draw):
    """What clients send, and what they do not."""
    it = machine("ur5")
    outputs, inputs = names_of(it.outputs), names_of(it.inputs)
    said = st.one_of(
        st.builds(lambda f, n: package(Kind.OUTPUTS, struct.pack(">d", f) + n.encode()),
                  st.floats(), outputs),
        inputs.map(lambda n: package(Kind.INPUTS, n.encode())),
        st.integers(0, 3).map(lambda v: package(Kind.PROTOCOL_VERSION, struct.pack(">H", v))),
        st.builds(package, kinds, st.binary(max_size=60)),
        st.builds(lambda r, b: package(Kind.DATA, bytes([r]) + b),
                  st.integers(0, 4), st.binary(max_size=60)),
        st.binary(max_size=60),
    )  # fmt: skip
    return b"".join(draw(st.lists(said, max_size=15)))


@pytest.mark.thorough
@examples(300)
@given(conversations(), st.lists(st.integers(1, 50), min_size=1))
def test_any_bytes_cut_anywhere_are_answered_the_same_and_harm_nobody(stream, cuts):
    whole = Conversation()
    whole.session.received(stream)
    told = whole.wire.take()
    whole.session.hung_up()
    pieces, at = Conversation(), 0
    while at < len(stream) and not pieces.wire.closed:
        cut = cuts[at % len(cuts)]
        pieces.session.received(stream[at : at + cut])
        assert pieces.session._framer.held < 65_536
        at += cut
    assert pieces.wire.take() == told
    assert pieces.wire.closed == whole.wire.closed
    if not pieces.wire.closed:
        pieces.session.ticked()
    pieces.session.hung_up()
    assert pieces.service.sessions == []


# What inputs do


@examples(150)
@given(*(st.integers(0, 255) for _ in range(4)), st.integers(0, 2**18 - 1))
def test_digital_outputs_change_where_the_mask_says(mask, bits, tool_mask, tool_bits, before):
    it = machine("ur5")
    it.outputs["actual_digital_output_bits"] = before
    talk = Conversation()
    for group in ("standard", "configurable", "tool"):
        talk.inputs(f"{group}_digital_output_mask,{group}_digital_output")
    talk.ask(Kind.DATA, bytes([1, mask, bits]))
    talk.ask(Kind.DATA, bytes([3, tool_mask, tool_bits]))
    after = it.outputs["actual_digital_output_bits"]
    for bit in range(18):
        given_mask, given_bits, at = (tool_mask, tool_bits, 16) if bit > 15 else (mask, bits, 0)
        chosen = not 8 <= bit < 16 and given_mask >> (bit - at) & 1
        expected = given_bits >> (bit - at) & 1 if chosen else before >> bit & 1
        assert after >> bit & 1 == expected, bit
    assert after < 2**18
    talk.session.hung_up()


ANALOG = (
    "standard_analog_output_mask,standard_analog_output_type,"
    "standard_analog_output_0,standard_analog_output_1"
)


def test_analog_outputs_are_currents_or_voltages_and_what_is_not_chosen_is_left_alone(client):
    out = client.machine.outputs
    client.inputs(ANALOG)
    client.ask(Kind.DATA, b"\x01" + struct.pack(">BBdd", 1, 0, 0.25, math.nan))
    assert (out["standard_analog_output0"], out["standard_analog_output1"]) == (8.0, 0.0)
    client.ask(Kind.DATA, b"\x01" + struct.pack(">BBdd", 2, 2, 1e300, 0.5))
    assert (out["standard_analog_output0"], out["standard_analog_output1"]) == (8.0, 5.0)
    assert out["analog_io_types"] == 0b1000
    client.ask(Kind.DATA, b"\x01" + struct.pack(">BBdd", 3, 2, 7.0, math.inf))
    assert (out["standard_analog_output0"], out["standard_analog_output1"]) == (20.0, 5.0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("mask", "fraction", "slider"),
    [(1, 0.3, 0.3), (0, 0.3, 1.0), (1, 7.0, 1.0), (1, -1.0, 0.0), (1, math.nan, 1.0)],
)
def test_the_speed_slider_moves_when_the_mask_says_so(client, mask, fraction, slider):
    client.inputs("speed_slider_mask,speed_slider_fraction")
    client.ask(Kind.DATA, b"\x01" + struct.pack(">Id", mask, fraction))
    client.machine.tick()
    assert client.machine.outputs["target_speed_fraction"] == slider
