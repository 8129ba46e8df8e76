"""A fitted model tried out on a simulated arm that is driven by torque.

Nothing here commands a torque to a real robot: a robot without `command_torque` and `push` is
refused before it is opened.
"""
