"""A mock UR controller without sockets, and links that keep what they are sent."""

import numpy as np

from hil_mock_robot.plant.truth import draw_truth
from hil_mock_robot.ur.body import Body
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.rtde_variables import series_of

UPRIGHT = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
SERIAL = "20225500042"


def machine_of(arm="ur5", powered=True):
    """A fresh controller; each has its own arm."""
    series = series_of(arm)
    body = Body(draw_truth(arm, 1, "ideal"), series.rate_hz, UPRIGHT)
    return Machine(series, body, serial=SERIAL, powered=powered)


def pass_time(machine, seconds, sessions=()):
    for _ in range(round(seconds / machine.tick_s)):
        machine.tick()
        for session in sessions:
            session.ticked()


class Wire:
    """A link that takes everything; set `pending` for a client that does not read."""

    peer = "127.0.0.1"

    def __init__(self):
        self.closed = False
        self.sent = bytearray()
        self.pending = 0

    def send(self, data):
        assert not self.closed
        self.sent += data

    def close(self):
        self.closed = True

    def take(self):
        taken, self.sent = bytes(self.sent), bytearray()
        return taken
