"""From spec, station and excitation to an immutable plan.

`hil.plan(experiment)` is the function of the API (`hil.api.plan`); `hil.plan.plan` the data.
"""

from hil.callable_module import make_callable

make_callable(__name__)
