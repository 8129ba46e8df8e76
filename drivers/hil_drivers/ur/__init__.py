"""Universal Robots over RTDE: motion through `ur-rtde`, samples by our own reader.

`robot` is what `hil` uses. It listens to the controller in this process (`controller`, with
`rtde` and `state` for its rows, `dashboard` and `primary` for its other ports) and moves the arm
in another one: `motion` is that process from both sides, `servo` leads the arm tick by tick, and
`control` is `ur-rtde` with every answer looked at. `options` is what a station says.
"""
