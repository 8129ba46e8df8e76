"""Where a network is trained: the device by name, and what torch is told while it trains."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from hil.core import SpecError
from hil.networks.training_loop.settings import Precision


def torch_device(name: str) -> torch.device:
    """The device that `auto`, `cpu`, `cuda` or `cuda:1` stands for here.

    Raises:
        SpecError: torch has no such device on this machine.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0]
        raise SpecError(
            f"torch cannot use the device {name!r}: {reason}",
            hint="use device: auto, which takes a GPU only where there is one, or cpu",
        ) from error
    return device


def torch_dtype(precision: Precision) -> torch.dtype:
    """`float32` or `float64` as torch names it."""
    return torch.float64 if precision == "float64" else torch.float32


def device_of(module: torch.nn.Module) -> torch.device:
    """Where a network's parameters are."""
    return next(iter(module.parameters())).device


@contextmanager
def reproducible(device: torch.device, threads: int) -> Iterator[None]:
    """Random numbers and threads of torch that are the caller's again afterwards."""
    before = torch.get_num_threads()
    devices = [device] if device.type == "cuda" else []
    torch.set_num_threads(threads)
    try:
        with torch.random.fork_rng(devices=devices):
            yield
    finally:
        torch.set_num_threads(before)
