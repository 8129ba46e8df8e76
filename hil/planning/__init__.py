"""From spec, station and excitation to an immutable plan.

`hil.plan(experiment)` makes one; `hil.planning.plan` holds the data.
"""
