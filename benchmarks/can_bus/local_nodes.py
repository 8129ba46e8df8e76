"""The same six drives written with canopen: LocalNodes that answer SYNC with their PdoMaps.

As canopen's documentation has it: RPDOs are read in the callbacks of their maps, TPDOs are written
object by object, by name, and transmitted. No heartbeats, no SDOs while it is measured.
`python -m benchmarks.can_bus.local_nodes CHANNEL [ordinary]`, until its input ends.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import canopen

from benchmarks.can_bus.drives import DISABLED, NODES, STATUSWORDS
from benchmarks.can_bus.ending import forbid_priority, until_over
from benchmarks.can_bus.maps import dictionary, lay_out
from hil_drivers.cia402.can_channel import SYNC_COB_ID, rpdo_cob_id, tpdo_cob_id
from hil_drivers.cia402.mapping import POSITION
from hil_drivers.cia402.objects import CSP
from hil_drivers.cia402.timing import realtime


class Drive:
    """One axis; its position is the target of the last cycle.

    Args:
        network: It joins.
        node_id: Its own.
    """

    def __init__(self, network: Any, node_id: int) -> None:
        node = canopen.LocalNode(node_id, dictionary())
        network.add_node(node)
        command = lay_out(node.rpdo[1], POSITION.rpdos[0], rpdo_cob_id)
        command.subscribe()
        command.add_callback(self._told)
        for pdo in POSITION.tpdos:
            lay_out(node.tpdo[pdo.number], pdo, tpdo_cob_id)
        self._state, self._measured = node.tpdo[1], node.tpdo[2]
        self._command = {"controlword": 0, "mode": CSP, "target_position": 0}
        network.subscribe(SYNC_COB_ID, self._answer)

    def _told(self, command: Any) -> None:
        self._command = {variable.name: variable.raw for variable in command}

    def _answer(self, *_: object) -> None:
        told, state, measured = self._command, self._state, self._measured
        state["statusword"].raw = STATUSWORDS.get(told["controlword"], DISABLED)
        state["position"].raw = told["target_position"]
        state["mode_display"].raw = told["mode"]
        state.transmit()
        measured["velocity"].raw, measured["torque"].raw, measured["current"].raw = 0, 100, 200
        measured.transmit()


def main(channel: str, *how: str) -> None:
    """Answer, from canopen's thread."""
    if "ordinary" in how:
        forbid_priority()
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.1
    with realtime():  # the thread of the notifier inherits it
        network.connect(interface="hil_unix", channel=channel)
        for node_id in NODES:
            Drive(network, node_id)
        until_over(time.sleep)
        network.disconnect()


if __name__ == "__main__":
    main(*sys.argv[1:])
