"""What is looked at before an arm moves, with the figures: the driver's lines of a preflight."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hil.arms import Payload
from hil.robot import Finding, Limits
from hil_drivers.arm import payload_finding
from hil_drivers.twincat.ads import RUN, STATES
from hil_drivers.twincat.controller import EVERY_S, Controller, payload_in
from hil_drivers.twincat.facts import reported_limits
from hil_drivers.twincat.reading import Ring
from hil_drivers.twincat.variables import CONTRACT, Phase

LEAST_BEATS = 3
"""Beats that have to fit into the PLC's watchdog: one may come late."""


def findings_of(
    controller: Controller, ring: Ring, limits: Limits, declared: Payload | None
) -> Iterator[Finding]:
    """One finding per thing that was looked at.

    Args:
        controller: Connected.
        ring: That is read.
        limits: That plans are held against.
        declared: The load that the PLC was last given; None when it was not.
    """
    info, state = controller.info, controller.state()
    computed = payload_in(controller.variables.structure("stAnswer"))
    yield _runtime(controller.runtime_state())
    yield _phase(controller, state)
    yield _session(controller, state)
    yield _cycle(info)
    yield _watchdog(info)
    yield _joint_limits(info, limits)
    yield payload_finding(declared, computed, "see to the PLC's program")
    yield _ring(info, ring)


def _runtime(state: int) -> Finding:
    name = STATES.get(state, str(state))
    said = f"the PLC's runtime is in state {name}"
    return Finding("runtime", state == RUN, said, name, "RUN", "start the PLC in TwinCAT")


def _phase(controller: Controller, state: np.void) -> Finding:
    phase = int(state["nPhase"])
    name = Phase(phase).name if phase in tuple(Phase) else str(phase)
    said = f"the PLC's program says {name}"
    if phase == Phase.FAULT:
        said += f", {controller.fault(state)}"
    hint = "see to the drives and the PLC's program"
    return Finding("phase", phase == Phase.HOLDING, said, name, "HOLDING", hint)


def _session(controller: Controller, state: np.void) -> Finding:
    told, ours = int(state["nSession"]), controller.session
    said = "the PLC obeys this computer" if told == ours else "the PLC obeys somebody else"
    hint = "end the other client, then connect again"
    return Finding("session", told == ours, said, str(told), str(ours), hint)


def _cycle(info: np.void) -> Finding:
    said = f"cycle {float(info['fCycleS']) * 1e3:g} ms, contract {CONTRACT}"
    return Finding("cycle", True, said, float(info["fCycleS"]))


def _watchdog(info: np.void) -> Finding:
    told, least = float(info["fWatchdogS"]), LEAST_BEATS * EVERY_S
    said = f"the PLC stops the arm {told:g} s after our last beat, one comes every {EVERY_S:g} s"
    hint = "set fWatchdogS in the PLC to some tenths of a second"
    return Finding("watchdog", least <= told <= 1.0, said, told, f"{least:g} … 1 s", hint)


def _joint_limits(info: np.void, used: Limits) -> Finding:
    """The limits that plans are held against are the stricter ones of maker and PLC."""
    wider = reported_limits(info).exceeded_by(used)
    said = "joint limits used are no wider than what the PLC checks"
    return Finding("joint-limits", not wider.any(), said, int(wider.sum()), 0)


def _ring(info: np.void, ring: Ring) -> Finding:
    rows = int(info["nRingRows"])
    seconds = rows * float(info["fCycleS"])
    said = f"ring of {rows} rows ({seconds:.1f} s): {ring.lost} rows lost in {ring.gaps} gaps"
    said += f", {ring.torn} blocks read again" if ring.torn else ""
    hint = "something kept hil from reading: look for other load on this computer"
    return Finding("ring", ring.lost == 0, said, ring.lost, 0, hint)
