"""Driver for arms of Universal Robots: `ur-rtde` moves the arm, an RTDE client reads its state.

The module `robot` contains the driver class that `hil` uses. The driver's own process reads the
controller: the module `controller` uses `rtde` and `state` to receive rows of the controller's
state, and `dashboard` and `primary` for the other ports. A second process moves the arm: the module
`motion` contains this process and its client, `servo` sends set-points tick by tick, and `control`
wraps `ur-rtde`. The module `options` defines the options of the arm in the station file.
"""
