"""A UR controller on loopback sockets: what UR clients see of a robot, with the mock's physics."""
