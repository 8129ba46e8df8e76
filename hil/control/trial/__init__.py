"""A fitted model tried out on a simulated arm that is driven by torque.

Nothing here commands a torque to a real robot: one that does not declare itself simulated
(`hil.robot.TorqueControlled`) is refused before it is opened.
"""
