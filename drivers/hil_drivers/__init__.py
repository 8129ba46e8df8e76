"""Robot drivers that come with hil: `ur` (RTDE), `cia402` (CANopen drives) and `twincat` (ADS).

A driver is a robot file (`hil.robot.Robot`), a protocol file and its tables. What does not depend
on the protocol is here, once for all drivers: `arm` (facts and limits of the arm, and the checks
that hold commands against them), `network` (addresses, names and ports of a controller) and
`option_checks` (options of a station file). docs/how-to/add-a-driver.md says how to add one.
"""
