"""Common parts of all mock servers: faults, journal, side channel, loop, command-line options.

Each mock consists of its protocol and a small declaration: its command-line options, its faults
(one class each, see `faults`), and its answers on the side channel.
"""
