"""What drives are told last: nobody is to be watched, and who may still move is to stop."""

from __future__ import annotations

from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.canopen_acyclic import CanopenAcyclic
from hil_drivers.cia402.states import POWERED, QUICK_STOP, state_of

WITHIN_S = 0.1
"""How long the answers of all drives together are waited for [s]."""


def stop_by_objects(acyclic: CanopenAcyclic) -> None:
    """Quick stop by SDO, for drives that process data do not reach; does not wait, never raises.

    A drive that has started anew or was taken out of operation has no RPDOs; it answers SDO.
    """
    acyclic.at_once.write(od.CONTROLWORD, QUICK_STOP, _axes(acyclic))


def unwatch(acyclic: CanopenAcyclic) -> list[int]:
    """Have drives that carry no current watch our heartbeat no more (1016h); never raises.

    Else they would be in fault for its end (8130h), and an error that somebody has to see would
    not be the present one any more. Who may still move has to notice that we are gone.

    Returns:
        Axes that are not known to carry no current.
    """
    words = acyclic.at_once.read(od.STATUSWORD, _axes(acyclic), WITHIN_S)
    off = [axis for axis, word in words.items() if state_of(word) not in POWERED]
    acyclic.at_once.write(od.CONSUMER_HEARTBEAT, 0, off, WITHIN_S)
    return [axis for axis in _axes(acyclic) if axis not in off]


def part(acyclic: CanopenAcyclic) -> None:
    """Leave drives that were driven: `unwatch` them, stop the others; never raises."""
    acyclic.at_once.write(od.CONTROLWORD, QUICK_STOP, unwatch(acyclic))


def _axes(acyclic: CanopenAcyclic) -> range:
    return range(len(acyclic.nodes))
