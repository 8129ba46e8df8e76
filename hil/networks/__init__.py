"""Networks: Levenberg-Marquardt MLPs, Lagrangian networks, residual networks and their training.

They are estimators as those of `hil.estimators`; torch is imported in the modules that compute
with it.
"""
