"""An arm on CiA 402 drives: CANopen over CAN now, the same object dictionary as EtherCAT's CoE.

From top to bottom: `robot` is what `hil` sees, and runs `axes_robot` in a process of its own. That
has a `session` while it is connected: drives are set up (`commissioning`), then a thread exchanges
cycles (`core`, `timing`), in which the `supervisor` judges all axes (`axis`) and the `player`
writes set-points; `rows` makes records of it, `findings` the driver's lines of a preflight. All of
that stands on the `bus` protocol, the `objects` and their `mapping` into process data. Below it is
CAN: `can_bus`, `can_cycle`, `can_channel`; `replay` makes a recording anew from a log of its
frames.
"""
