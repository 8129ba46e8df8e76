"""Well-spread clear poses: scrambled Sobol points of the joint ranges, less the colliding ones."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from hil.core import FloatArray, PlanError
from hil.excitation.workspace import Workspace

BLOCK = 1024

HARDLY_ANY = 0.002
"""Share of clear poses below which there is no use in drawing on."""

HARDLY_ANY_INSIDE = 0.0003
"""The same where the flange is confined: most poses are then dropped by their flange alone, which
costs little, and a box of 0.3 m holds one in a thousand poses of a UR5."""


FEWEST_INSIDE = 64
"""Poses of a block where the flange is confined: fewer are not worth a look at their ways."""

ENOUGH = 8
"""The share is judged once so many poses were drawn that the minimum share would give this many
clear ones."""


def draw_poses(workspace: Workspace, seed: int, part: str = "poses") -> Iterator[FloatArray]:
    """Blocks (m, n) of clear poses within the workspace's range, well spread, without end.

    Sobol points fill the range evenly for any number of them (Sobol 1967, scrambled after Owen),
    so does what is left of them fill the clear part of the range.

    Args:
        workspace: Where they must be clear.
        seed: Of the scrambling.
        part: What messages call them, e.g. `dwell poses`.

    Raises:
        PlanError: Hardly any pose is clear.
    """
    from scipy.stats import qmc

    points = qmc.Sobol(len(workspace.low), scramble=True, rng=np.random.default_rng(seed))
    confined = workspace.space is not None
    least, fewest = (HARDLY_ANY_INSIDE, FEWEST_INSIDE) if confined else (HARDLY_ANY, 0)
    waiting: list[FloatArray] = []
    found = 0
    for drawn in itertools.count(BLOCK, BLOCK):
        q = workspace.low + points.random(BLOCK) * (workspace.high - workspace.low)
        clear = q[workspace.is_clear(q)]
        found += len(clear)
        if found < least * drawn and least * drawn >= ENOUGH:
            raise _too_few(workspace, q, f"{part}: only {found} of {drawn} well-spread poses")
        waiting.append(clear)
        if sum(map(len, waiting)) >= fewest:
            yield np.concatenate(waiting)
            waiting.clear()


def _too_few(workspace: Workspace, q: FloatArray, few: str) -> PlanError:
    """Return the error for the poses `few`, of which `q` (N, n) are the last that were drawn."""
    around = f"keep {1e3 * workspace.clearance_m:.0f} mm from everything around and the arm itself"
    free = q[workspace.clearance(q) >= workspace.clearance_m]
    depth = workspace.depth(free)
    if workspace.space is None or not len(free) or np.all(depth >= workspace.clearance_m):
        return PlanError(
            f"{few} {around}",
            hint="widen excitation.range_deg, or see whether the station's surroundings are "
            "as described",
        )
    nearest = workspace.complaint(free[int(depth.argmax())])
    return PlanError(
        f"{few} {around}, and the flange inside its workspace; closest rejected pose: {nearest}",
        hint=f"{workspace.larger_space}widen excitation.range_deg",
    )


def roomy_poses(workspace: Workspace, count: int, seed: int) -> FloatArray:
    """(count, n) well-spread poses from the roomier half of the clear ones."""
    blocks: list[FloatArray] = []
    for block in draw_poses(workspace, seed, "poses to travel over"):
        blocks.append(block)
        if sum(map(len, blocks)) >= 2 * count:
            break
    q = np.concatenate(blocks)
    room = workspace.room(q)
    return q[room >= np.median(room)][:count]
