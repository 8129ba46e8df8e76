"""An arm on CiA 402 drives: CANopen over CAN now, the same object dictionary as EtherCAT's CoE.

From top to bottom: `robot` is the driver that `hil` opens; it runs `axes_robot` in a process of its
own. That has a `session` while it is connected: drives are set up (`commissioning`), then a thread
exchanges cycles (`core`, `timing`), in which the `supervisor` judges all axes (`axis`) and the
`player` writes the set-points of a `track`, in CSV and CST by position control (`gains`), with
torques of the arm's `torque` model. `rows` has the record of a cycle and makes rows of it;
`profile` scales raw integers to SI. All of that stands on the `bus` protocol, the `objects` and
their `mapping` into process data. Below it is CAN: `can_bus`, `can_cycle`, `can_channel`; `replay`
rebuilds a recording from a log of its frames.
"""
