"""What all mock servers share: faults, journal, side channel, loop, options of the command line.

A mock is its protocol and a small declaration: the options of its command line, its faults (one
class each, see `faults`), and what it answers on its side channel.
"""
