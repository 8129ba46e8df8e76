"""The client's side of the control script, tick by tick: what `ur-rtde` writes and waits for."""

from dataclasses import replace

import numpy as np

from hil_mock_robot.ur.control_script import ControlScript
from hil_mock_robot.ur.modes import RuntimeState
from tests.support.ur_machine import machine_of

HOME = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.1])
READY, DONE = 1, 2
MOVEJ, MOVEL, STOPL, STOPJ, MOVE_PATH, SERVOJ, SERVO_STOP = 1, 3, 33, 34, 45, 11, 16
SPEEDJ, SPEED_STOP, SET_PAYLOAD, TARGET_PAYLOAD, WATCHDOG = 9, 15, 17, 65, 35
STOP_SCRIPT = 255


def beside(*change):
    """Joint angles near `HOME`."""
    return HOME + np.array(change)


class Client:
    """One control session; register numbers count from `offset`."""

    def __init__(self, arm="ur5", offset=0, path=(), version=None):
        self.machine = machine_of(arm)
        if version:
            self.machine.series = replace(self.machine.series, version=version)
        self.offset = offset
        self.events = []
        self.machine.listeners.append(self.events.append)
        self.start(path)

    def start(self, path=()):
        self.write(0)
        assert self.machine.play(ControlScript(self.offset, path))
        self.machine.tick()

    def write(self, command, doubles=(), flag=None):
        for i, value in enumerate(doubles):
            self.machine.write(f"input_double_register_{self.offset + i}", float(value))
        if flag is not None:
            self.machine.write(f"input_int_register_{self.offset + 1}", flag)
        self.machine.write(f"input_int_register_{self.offset}", command)

    def call(self, command, doubles=(), flag=0, most_ticks=20_000):
        """Ticks until the script was done, None if it ended or did not answer."""
        assert self.state == READY
        self.write(command, doubles, flag)
        for ticks in range(1, most_ticks + 1):
            self.machine.tick()
            if self.machine.runtime is not RuntimeState.PLAYING:
                return None
            if self.state == DONE:
                self.write(0)
                self.machine.tick()
                return ticks
        return None

    def stream(self, command, doubles, ticks=1):
        """A command that is not waited for."""
        self.write(command, doubles)
        self.pass_ticks(ticks)

    def pass_ticks(self, count):
        for _ in range(count):
            self.machine.tick()

    def settle(self, most_ticks=20_000):
        for ticks in range(most_ticks):
            if self.machine.motion is None:
                return ticks
            self.machine.tick()
        raise AssertionError("it never comes to rest")

    def out_int(self, number):
        return self.machine.outputs[f"output_int_register_{self.offset + number}"]

    def out(self, count=6):
        names = (f"output_double_register_{self.offset + i}" for i in range(count))
        return np.array([self.machine.outputs[name] for name in names])

    @property
    def state(self):
        return self.out_int(0)

    @property
    def progress(self):
        """As `getAsyncOperationProgress` reads the word: None when nothing is under way."""
        word = self.out_int(2)
        return word & 0x7FFF if word >> 15 & 1 else None

    @property
    def operation(self):
        return self.out_int(2) >> 24 & 0x7F

    @property
    def q(self):
        return self.machine.setpoint[0]

    @property
    def qd(self):
        return self.machine.setpoint[1]

    @property
    def errors(self):
        return [event.text for event in self.events if event.kind == "error"]

    @property
    def playing(self):
        return self.machine.runtime is RuntimeState.PLAYING

    def go(self, q=HOME):
        """Bring the arm somewhere, fast."""
        assert self.call(MOVEJ, [*q, 3.0, 20.0]) is not None
        np.testing.assert_allclose(self.q, q, atol=1e-9)
