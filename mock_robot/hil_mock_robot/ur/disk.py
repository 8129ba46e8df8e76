"""Programs on the controller's disk that do something; any other file is an `IdleProgram`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from hil_mock_robot.ur.contracts import Program
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.scripts import program_of

CONTROL_LOOP = """
def rtde_control_loop():
  rtde_set_watchdog("input_int_register_0", 1, "pause")
  write_output_integer_register(0, 1)
  while True:
    if read_input_integer_register(0) == 1:
      x = read_input_float_register(0)
      y = read_input_float_register(1)
      z = read_input_float_register(2)
      rx = read_input_float_register(3)
      ry = read_input_float_register(4)
      rz = read_input_float_register(5)
      if x != 0 or y != 0 or z != 0 or rx != 0 or ry != 0 or rz != 0:
        movel(p[x, y, z, rx, ry, rz], a=1.2, v=0.08)
        write_output_integer_register(0, 0)
        while read_input_integer_register(0) == 1:
          sync()
        end
        write_output_integer_register(0, 1)
      end
    end
    sync()
  end
end
"""
"""The robot's side of `example_control_loop.py`, which comes with UR's own RTDE client.

Output integer 0 asks for a pose with 1 and says with 0 that it was reached; input integer 0 says
with 1 that a pose is in the input doubles 0 to 5, and is the watchdog. Moves at 0.08 m/s.
Source of this dialogue: RTDE_Python_Client_Library, `examples/rtde_control_loop.urp`.
"""


def disk_of(machine: Machine) -> Mapping[str, Callable[[], Program]]:
    """File → what makes its program, for this machine."""
    return {"rtde_control_loop.urp": lambda: program_of(CONTROL_LOOP, machine)}
