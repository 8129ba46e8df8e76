"""python-urx talks to a controller and prints what it saw as JSON; run as a process of its own.

Its threads call `Condition.notifyAll`, which warns. Its `movej(wait=True)` gives up with "Robot
stopped" on every software since 3.5, because version 0.11.0 does not know their state packets
(python-urx issue 112); so it does not wait here.
"""

import json
import sys
import time

import urx

host = sys.argv[1]
robot = urx.Robot(host, use_rt=True)
seen = {"start": robot.getj(), "pose": robot.secmon.get_cartesian_info(), "rt": []}
state = robot.secmon.get_all_data()
seen["parts"] = sorted(name for name in state)
seen["mode"] = state["RobotModeData"]["robotMode"]
target = list(seen["start"])
target[0] += 0.3
target[2] -= 0.2
robot.movej(target, acc=1.0, vel=1.0, wait=False)
seen["ran"], deadline = False, time.monotonic() + 20
while time.monotonic() < deadline:
    seen["ran"] |= robot.is_program_running()
    off = max(abs(a - b) for a, b in zip(robot.getj(wait=True), target, strict=True))
    if off < 0.002 and not robot.is_program_running():
        break
seen["off"], seen["running"] = off, robot.is_program_running()
monitor = robot.get_realtime_monitor()
seen["rt"] = [*monitor.q_actual(wait=True)]
seen["target"] = target
robot.close()
print(json.dumps(seen))  # noqa: T201
