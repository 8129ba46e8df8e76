"""Measure by a benchmark and fail unless its numbers keep their bounds.

    python -m tests.proofs.bench mcap "columnar_vs_ros2_decoder>=10" "write_vs_mcap_writer>=1"

Every figure and ratio is printed, those with a bound last. A name that the benchmark does not
give, as when its peer is not installed, fails too.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence

from hil.cli.bench import measure

Bound = tuple[str, str, float]
"""A name, `>=` or `<=`, and the number."""


def bound_of(text: str) -> Bound:
    """Read `name>=number` or `name<=number`.

    Raises:
        ValueError: It is neither.
    """
    for sign in (">=", "<="):
        name, found, number = text.partition(sign)
        if found:
            return name.strip(), sign, float(number)
    raise ValueError(f"a bound is `name>=number` or `name<=number`, not {text!r}")


def line_of(value: float, bound: Bound) -> str:
    """Return a number beside its bound, and whether it keeps it; NaN keeps none."""
    name, sign, number = bound
    kept = value >= number if sign == ">=" else value <= number
    words = "at least" if sign == ">=" else "at most"
    return f"{name} {value:.4g} ({words} {number:g}{'' if kept else ': NOT KEPT'})"


def judge(numbers: Mapping[str, float], bounds: Sequence[Bound]) -> list[str]:
    """Return a line for each number, those with a bound last."""
    bound_names = {name for name, _, _ in bounds}
    lines = [f"{name} {value:.4g}" for name, value in numbers.items() if name not in bound_names]
    return lines + [line_of(numbers.get(bound[0], math.nan), bound) for bound in bounds]


def main(arguments: Sequence[str]) -> int:
    """Print what a benchmark measures; return 1 if a bound is not kept."""
    name, *texts = arguments
    bounds = [bound_of(text) for text in texts]
    document = measure(name)
    lines = judge(document["figures"] | document["ratios"], bounds)
    left_out = (f"{peer} left out: {why}" for peer, why in document.get("skipped", {}).items())
    sys.stdout.write("\n".join([*left_out, *lines]) + "\n")
    return int(any(line.endswith("NOT KEPT)") for line in lines))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
