"""Motions for tests of residual networks, and networks with weights that are not zero."""

import numpy as np

from hil.networks.residual_data import Motions, ResidualSettings

N_JOINTS = 2
OFFSETS = np.array([0, 300, 301, 500])
ROWS = int(OFFSETS[-1])


def motions(seed: int = 0, offsets=OFFSETS, rate_hz: float = 1000.0, n: int = N_JOINTS) -> Motions:
    """Random walks: every quantity goes its own way."""
    random = np.random.default_rng(seed)
    shape = (int(offsets[-1]), n)
    q, qd, qdd, base, effort = (np.cumsum(random.normal(size=shape), 0) * 0.05 for _ in range(5))
    return Motions(q, qd, qdd, base, effort, offsets, rate_hz)


def small(**changed) -> ResidualSettings:
    """A network of few weights with a window of 17 samples."""
    return ResidualSettings(
        **{"channels": 4, "dilations": (1, 4), "kernel": 4, "crop": 16} | changed
    )


def problem(settings: ResidualSettings, recorded: Motions | None = None, **given):
    """Half of the rows to learn from, the rest to stop by; the residual is what is heard last."""
    from hil.networks.residual_training import ResidualProblem

    found = recorded or motions()
    learn = np.arange(len(found)) < len(found) // 2
    residual = found.effort - found.base
    return ResidualProblem(found, residual, learn, ~learn, settings, **given)


def random_network(settings: ResidualSettings, recorded: Motions | None = None):
    """As trained, with weights drawn at random: the last layer's are zero before training."""
    import torch

    made = problem(settings, recorded)
    draw = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for name, weight in made.module.named_parameters():
            if name.startswith("leave"):
                weight.copy_(torch.randn(weight.shape, generator=draw))
    return made.trained()
