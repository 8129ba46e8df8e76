"""A mock controller whose outputs are all different, so that no mix-up can stay hidden.

Each number is made of its place among all outputs and of the tick; text messages come in between.
"""

from hil_mock_robot.server.cli import serve
from hil_mock_robot.ur.loop import Loop
from hil_mock_robot.ur.mock import machine_of, pacer_of, parser_of
from hil_mock_robot.ur.rtde import RtdeService
from hil_mock_robot.ur.rtde_variables import WIRE, series_of
from hil_mock_robot.ur.rtde_wire import Level


def distinct(machine, service):
    out = machine.outputs
    for each in out.variables.values():
        letter, _ = WIRE[each.type]
        for place in each.places if each.name != "timestamp" else ():
            number = 7 * place + machine.ticks % 5
            sign = -1 if number % 2 else 1
            made = {"d": sign * (number + 0.25), "i": sign * number, "B": number % 256}
            out.flat[place] = made.get(letter, number)
    service.say(Level.INFO, "test", f"tick {machine.ticks}")


def main(arguments):
    """Run until SIGTERM."""
    given = parser_of().parse_args(arguments)
    series = series_of(given.model)
    machine = machine_of(given, series)
    service = RtdeService(machine)
    publish = machine._publishing.publish

    def publish_distinct(machine):
        publish(machine)
        distinct(machine, service)

    machine._publishing.publish = publish_distinct
    loop = Loop(machine, [service], pacer_of(given.speed, series), given.address)
    return serve(loop, "distinct outputs")
