"""What is looked at before an arm moves, with the figures: the driver's lines of a preflight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.robot import Finding, Limits
from hil_drivers.arm import payload_finding
from hil_drivers.twincat.beat import EVERY_S
from hil_drivers.twincat.controller import Controller
from hil_drivers.twincat.facts import reported_limits
from hil_drivers.twincat.return_codes import RUN, STATES
from hil_drivers.twincat.ring import Ring
from hil_drivers.twincat.symbols import CONTRACT, Phase

LEAST_BEATS = 3
"""Beats that have to fit into the PLC's watchdog: one may come late."""


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What the findings are made of.

    Attributes:
        controller: Connected.
        runtime: ADS state of the PLC's runtime.
        state: `stState`.
        limits: That plans are held against.
        declared: The load it was last told of; None when it was not.
        computed: The load it says that it computes with.
        ring: That is read.
    """

    controller: Controller
    runtime: int
    state: np.void
    limits: Limits
    declared: Payload | None
    computed: Payload
    ring: Ring


def findings_of(looked: Looked) -> Iterator[Finding]:
    """One finding per thing that was looked at."""
    yield _runtime(looked.runtime)
    yield _phase(looked)
    yield _session(looked)
    yield _cycle(looked.controller.info)
    yield _watchdog(looked.controller.info)
    yield _joint_limits(looked)
    yield payload_finding(looked.declared, looked.computed, "see to the PLC's program")
    yield _ring(looked)


def _runtime(state: int) -> Finding:
    name = STATES.get(state, str(state))
    said = f"the PLC's runtime is in state {name}"
    return Finding("runtime", state == RUN, said, name, "RUN", "start the PLC in TwinCAT")


def _phase(looked: Looked) -> Finding:
    phase = int(looked.state["nPhase"])
    name = Phase(phase).name if phase in tuple(Phase) else str(phase)
    said = f"the PLC's program says {name}"
    if phase == Phase.FAULT:
        said += f", {looked.controller.fault(looked.state)}"
    hint = "see to the drives and the PLC's program"
    return Finding("phase", phase == Phase.HOLDING, said, name, "HOLDING", hint)


def _session(looked: Looked) -> Finding:
    told, ours = int(looked.state["nSession"]), looked.controller.session
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


def _joint_limits(looked: Looked) -> Finding:
    """The limits that plans are held against are the stricter ones of maker and PLC."""
    wider = reported_limits(looked.controller.info).exceeded_by(looked.limits)
    said = "joint limits used are no wider than what the PLC checks"
    return Finding("joint-limits", not wider.any(), said, int(wider.sum()), 0)


def _ring(looked: Looked) -> Finding:
    ring, rows = looked.ring, int(looked.controller.info["nRingRows"])
    seconds = rows * float(looked.controller.info["fCycleS"])
    said = f"ring of {rows} rows ({seconds:.1f} s): {ring.lost} rows lost in {ring.gaps} gaps"
    said += f", {ring.torn} blocks read again" if ring.torn else ""
    hint = "something kept hil from reading: look for other load on this computer"
    return Finding("ring", ring.lost == 0, said, ring.lost, 0, hint)
