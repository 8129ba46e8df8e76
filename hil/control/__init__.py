"""Uses of a fitted model: where an arm rests best, and how it follows a hand.

They see models, data and dynamics; where a robot's surroundings matter they are handed in.
"""
