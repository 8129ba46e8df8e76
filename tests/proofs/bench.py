"""Measure by a benchmark and fail unless its numbers keep their bounds.

    python -m tests.proofs.bench mcap "columnar_vs_ros2_decoder>=10" "write_vs_mcap_writer>=1"

Every figure and ratio is printed, those with a bound last. A name that the benchmark does not
give, as when its peer is not installed, fails too.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

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


def is_kept(value: float, bound: Bound) -> bool:
    """Whether a number keeps its bound; NaN keeps none."""
    _, sign, number = bound
    return value >= number if sign == ">=" else value <= number


def main(arguments: Sequence[str]) -> int:
    """Print what a benchmark measures; return 1 if a bound is not kept."""
    name, *texts = arguments
    bounds = [bound_of(text) for text in texts]
    document = measure(name)
    numbers = document["figures"] | document["ratios"]
    lines = [f"{peer} left out: {why}" for peer, why in document.get("skipped", {}).items()]
    bounded = {of for of, _, _ in bounds}
    lines += [f"{of} {value:.4g}" for of, value in numbers.items() if of not in bounded]
    failed = 0
    for bound in bounds:
        of, sign, number = bound
        value = numbers.get(of, math.nan)
        kept = is_kept(value, bound)
        failed += not kept
        words = "at least" if sign == ">=" else "at most"
        lines.append(f"{of} {value:.4g} ({words} {number:g}{'' if kept else ': NOT KEPT'})")
    sys.stdout.write("\n".join(lines) + "\n")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
