"""Robot drivers that come with hil: `ur` (RTDE), `cia402` (CANopen drives) and `twincat` (ADS).

A driver consists of a robot file (`hil.robot.Robot`), a protocol file and its tables. Code that
does not depend on the protocol is shared by all drivers: `arm` (properties and limits of the arm,
and the checks of commands against them), `network` (addresses, names and ports of a controller) and
`option_checks` (options of a station file). docs/how-to/add-a-driver.md explains how to add a
driver.
"""
