"""Well-spread clear poses: scrambled Sobol points of the joint ranges, less the colliding ones."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from hil.errors import PlanError
from hil.excite.workspace import Workspace
from hil.typing import FloatArray

BLOCK = 1024

HARDLY_ANY = 0.002
"""Share of clear poses below which there is no use in drawing on."""


def draw_poses(workspace: Workspace, seed: int) -> Iterator[FloatArray]:
    """Blocks (m, n) of clear poses within the workspace's range, well spread, without end.

    Sobol points fill the range evenly for any number of them (Sobol 1967, scrambled after Owen),
    so does what is left of them fill the clear part of the range.

    Raises:
        PlanError: Hardly any pose is clear.
    """
    from scipy.stats import qmc

    points = qmc.Sobol(len(workspace.low), scramble=True, rng=np.random.default_rng(seed))
    found = 0
    for drawn in itertools.count(BLOCK, BLOCK):
        q = workspace.low + points.random(BLOCK) * (workspace.high - workspace.low)
        clear = q[workspace.is_clear(q)]
        found += len(clear)
        if found < HARDLY_ANY * drawn and drawn >= 4 * BLOCK:
            raise PlanError(
                f"only {found} of {drawn} well-spread poses keep "
                f"{1e3 * workspace.clearance_m:.0f} mm from everything around and the arm itself",
                hint="widen excitation.range_deg, or see whether the station's surroundings are "
                "as described",
            )
        yield clear


def roomy_poses(workspace: Workspace, count: int, seed: int) -> FloatArray:
    """(count, n) well-spread poses from the roomier half of the clear ones."""
    blocks: list[FloatArray] = []
    for block in draw_poses(workspace, seed):
        blocks.append(block)
        if sum(map(len, blocks)) >= 2 * count:
            break
    q = np.concatenate(blocks)
    room = workspace.clearance(q)
    return q[room >= np.median(room)][:count]
