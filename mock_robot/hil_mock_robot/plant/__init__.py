"""Physics of a mock robot: the true parameters of one individual, and its motion.

The module `truth` draws the parameters of an individual robot, and `simulation` moves this robot.
No module of this package depends on a protocol or shares code with `hil.dynamics`, so that the
identification is checked against MuJoCo.
"""
