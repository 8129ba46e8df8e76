"""Datasets from run directories and from recordings of other tools, and back.

Runs and MCAP files, CSV, MATLAB, ROS 2 bags, ur_rtde, one value per line; `hil.data` is pure and
imports none of this.
"""
