"""A mock UR controller without sockets, and links that keep what they are sent."""

import numpy as np

from hil_mock_robot.plant.truth import draw_truth
from hil_mock_robot.ur.body import Body
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.motion import Leg, MovePath
from hil_mock_robot.ur.rtde_variables import series_of

UPRIGHT = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
SERIAL = "20225500042"


def machine_of(arm="ur5", powered=True):
    """A fresh controller; each has its own arm."""
    series = series_of(arm)
    body = Body(draw_truth(arm, 1, "ideal"), series.rate_hz, UPRIGHT)
    return Machine(series, body, serial=SERIAL, powered=powered)


def movej(q, v, a, tick_s, *, time_s=0.0, arm=None):
    """The motion of URScript's `movej` to a joint position (6,) [rad]."""
    leg = Leg("j", np.array(q, dtype=np.float64), v, a, time_s=time_s)
    return MovePath(arm, None, [leg], tick_s)


def movej_to_pose(arm, tcp, pose, v, a, tick_s):
    """The motion of URScript's `movej` to a pose (6,) of the tool."""
    return MovePath(
        arm, tcp, [Leg("j", np.array(pose, dtype=np.float64), v, a, is_pose=True)], tick_s
    )


def movel(arm, tcp, pose, v, a, tick_s):
    """The motion of URScript's `movel` to a pose (6,) of the tool."""
    return MovePath(
        arm, tcp, [Leg("l", np.array(pose, dtype=np.float64), v, a, is_pose=True)], tick_s
    )


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
