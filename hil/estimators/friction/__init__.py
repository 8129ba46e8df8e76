"""Friction as columns of a regressor: memory, load, speed laws, ripple, temperature.

`memory` carries Dahl's state along a path, `motion` is what the columns are made of, `library`
names the columns in groups, `shapes` fits the few parameters that are not linear, and `selection`
keeps the groups that predict whole trajectories they were not fitted to.
"""
