"""Stands in for `ur-rtde` and the controller in the process that moves a UR arm; see UR_FAKE.

Loaded as `rtde_control` and as the receiver. Its arm goes where it is told at once, tick by tick.
What was commanded is appended to the file UR_FAKE_LOG, one line per command.
"""

from __future__ import annotations

import ctypes
import os
import threading
import time

import numpy as np

from hil.core.errors import RobotConnectionError, RobotTimeout

RATE_HZ = 125.0
ROW = np.dtype(
    [
        ("timestamp", "<f8"),
        ("target_q", "<f8", (6,)),
        ("target_qd", "<f8", (6,)),
        ("runtime_state", "<u4"),
    ]
)


def how(word):
    return word in os.environ.get("UR_FAKE", "").split()


def note(text):
    if path := os.environ.get("UR_FAKE_LOG"):
        with open(path, "a") as log:
            log.write(f"{time.monotonic():.4f} {text}\n")


class World:
    """One arm and its program; a tick per 8 ms of wall time."""

    def __init__(self):
        self.lock = threading.Lock()
        self.q, self.qd = np.zeros(6), np.zeros(6)
        self.goal, self.speed = None, 0.0
        self.playing, self.operation, self.running = False, 0, False
        self.led = None
        self.silent = self.cut = False
        self.frozen = None
        self.stopped = 1
        self.blinks = 0
        self.ticks = 0
        self.begun = time.monotonic()

    def rows_due(self):
        with self.lock:
            due = int((time.monotonic() - self.begun) * RATE_HZ)
            rows = [self._tick() for _ in range(max(0, due - self.ticks))]
            if self.frozen is not None and rows:
                self.frozen = self.frozen or rows[0]
                rows = [self.frozen] * len(rows)
        return [] if self.silent else rows

    def freeze(self):
        """The controller repeats what it says next for ever."""
        with self.lock:
            self.frozen = self.frozen or ()

    def _tick(self):
        self.ticks += 1
        before = self.q.copy()
        if self.goal is not None:
            way = self.goal - self.q
            step = self.speed / RATE_HZ
            arrived = np.abs(way).max() <= step
            self.q = self.goal.copy() if arrived else self.q + way / np.abs(way).max() * step
            if arrived:
                self.goal, self.running = None, False
        elif self.led is not None:
            self.q = self.led.copy()
        if self.q is not before:
            self.qd = (self.q - before) * RATE_HZ
        return (self.ticks / RATE_HZ, self.q, self.qd, self._state())

    def _state(self):
        if self.blinks:
            self.blinks -= 1
            return 1
        return 2 if self.playing else self.stopped

    def stand(self):
        with self.lock:
            self.goal = self.led = None
            self.running = False


WORLD = World()


class Status:
    def __init__(self, number, running):
        self._said = number, running

    def operationId(self):  # noqa: N802
        return self._said[0]

    def isAsyncOperationRunning(self):  # noqa: N802
        return self._said[1]


class RTDEControlInterface:
    FLAG_UPLOAD_SCRIPT, FLAG_NO_EXT_FT = 1, 0x40
    tries = 0

    def __init__(self, host, frequency, flags):
        note(f"connect {host} {frequency:g} {flags}")
        RTDEControlInterface.tries += 1
        if how("hold_gil"):
            ctypes.PyDLL(None).sleep(60)
        if how("crash_connect"):
            os.abort()
        if how("in_use") and self.tries < 3:
            raise RuntimeError("One of the RTDE input registers are already in use! Currently")
        if how("local"):
            raise RuntimeError("ur_rtde: Please enable remote control on the robot!")
        WORLD.playing = True
        if how("late_rows"):
            WORLD.blinks = 40

    def isProgramRunning(self):  # noqa: N802
        return WORLD.playing

    def getAsyncOperationProgressEx(self):  # noqa: N802
        return Status(WORLD.operation, WORLD.running)

    def setWatchdog(self, hz):  # noqa: N802
        note(f"watchdog {hz:g}")
        return not how("refuse_watchdog")

    def kickWatchdog(self):  # noqa: N802
        note("kick")
        if how("throw_kick") and WORLD.running:
            raise RuntimeError("basic_string::_M_create")
        return WORLD.playing

    def moveJ(self, q, speed, acceleration, asynchronous):  # noqa: N802
        note(f"moveJ {q[5]:.4f} {speed:.3f} {acceleration:.3f} {asynchronous}")
        if how("refuse_move"):
            return False
        if how("crash_move"):
            os.abort()
        if how("hang_move"):
            time.sleep(60)
        with WORLD.lock:
            WORLD.operation += 1
            WORLD.goal, WORLD.speed, WORLD.running = np.array(q), speed, True
        if how("silence_move"):
            WORLD.silent = True
        if how("cut_move"):
            WORLD.cut = True
        if how("blink_move"):
            WORLD.blinks = 1
        if how("pause_move"):
            WORLD.playing, WORLD.stopped = False, 4
        if how("program_ends"):
            WORLD.playing = False
            WORLD.stand()
        return True

    def servoJ(self, q, speed, acceleration, period, lookahead, gain):  # noqa: N802
        note(f"servoJ {q[5]:.4f} {period:.4f}")
        if how("throw_servo"):
            raise ValueError("the value is not within [0.03;0.2]")
        if not how("no_follow"):
            with WORLD.lock:
                WORLD.led = np.array(q)
        if how("freeze_servo"):
            WORLD.freeze()
        return not how("refuse_servo")

    def servoStop(self, deceleration):  # noqa: N802
        note("servoStop")
        WORLD.stand()
        return not how("refuse_stop")

    def stopJ(self, deceleration):  # noqa: N802
        note("stopJ")
        if how("hang_stop"):
            time.sleep(60)
        if how("throw_stop"):
            raise RuntimeError("unable to get state data for specified key: runtime_state")
        if not how("deaf_stop"):
            WORLD.stand()

    def stopScript(self):  # noqa: N802
        note("stopScript")
        if how("pause_at_end"):
            WORLD.stopped = 4
        WORLD.playing = False
        WORLD.stand()

    def setPayload(self, mass, com):  # noqa: N802
        note(f"payload {mass:g} {com}")
        return True

    def disconnect(self):
        note("disconnect")


class Receiver:
    version = (3, 15, 8, 0)

    def __init__(self, host, frequency_hz=None):
        self._heard, self._clock = time.monotonic(), -1.0
        self._rows = []
        self._changed = threading.Condition()
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def age_s(self):
        return time.monotonic() - self._heard

    def open(self):
        pass

    def close(self):
        pass

    def take(self, timeout_s=1.0):
        with self._changed:
            self._changed.wait_for(lambda: self._rows or WORLD.cut, timeout_s)
            rows, self._rows = self._rows, []
        if WORLD.cut:
            raise RobotConnectionError("the controller has hung up")
        if not rows:
            raise RobotTimeout("no row")
        return np.array(rows, ROW)

    def _listen(self):
        while True:
            if rows := WORLD.rows_due():
                if rows[-1][0] != self._clock:
                    self._heard, self._clock = time.monotonic(), rows[-1][0]
                with self._changed:
                    self._rows += rows
                    self._changed.notify_all()
            time.sleep(0.002)
