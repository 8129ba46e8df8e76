"""The physics of a mock robot: what is true of one individual, and how it moves.

`truth` draws an individual; `simulation` moves it. No module here knows a protocol, and none
shares code with `hil.dynamics`: what the identification computes is checked against MuJoCo.
"""
