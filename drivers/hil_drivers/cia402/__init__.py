"""Driver for arms with CiA 402 drives on CANopen; EtherCAT drives have the same objects (CoE).

The modules of the driver, from the public interface down to the bus:

- `robot` is the driver that `hil` opens. The driver runs `axes_robot` in a separate process.
- A `session` represents the connection to the drives, from connecting to closing. Before the first
  cycle of a session, `commissioning` checks and configures the drives. After commissioning, a
  thread exchanges set-points and measurements with the drives in every cycle (`core`, `timing`).
- In each cycle the `supervisor` monitors all axes (`axis`), and the `player` writes the set-points
  of a `track`. In the modes CSV and CST, the set-points come from position control (`gains`), with
  feed-forward torques from the `torque` model of the arm.
- `rows` defines the record of a cycle and converts records to rows of a recording. `profile`
  converts raw integers to SI units.
- The modules from `robot` to `profile` are independent of the type of bus: they use only the `bus`
  protocol, the `objects` of the drives and the `mapping` of objects into process data.
- `can_bus`, `can_cycle` and `can_channel` implement the `bus` protocol on CAN. `replay` rebuilds a
  recording from a log of the CAN frames.
"""
