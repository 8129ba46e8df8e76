"""What is looked at before an arm moves, with the figures: the driver's lines of a preflight."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.core import FloatArray
from hil.robot import Finding, Limits
from hil_drivers.cia402.bus import MASTER_SILENCE_MS
from hil_drivers.cia402.facts import limits_of
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.session import Session
from hil_drivers.cia402.supervisor import Phase
from hil_drivers.cia402.torque import HINT as TORQUE_HINT
from hil_drivers.cia402.torque import TorqueModel

HOTTEST_C = 90.0
"""Motors hotter than this are not moved: windings stand 120 to 155 °C, grease and sensors less."""

OUTSIDE_RAD = 0.01
"""A joint that rests at its end may be beyond it by so much [rad]."""

MOST_OVERRUN = 0.10
"""Share of cycles that may be late: CSP drives interpolate over one, and fault after a few."""


def findings_of(session: Session, model: TorqueModel) -> Iterator[Finding]:
    """One finding per thing that was looked at; moves nothing.

    Args:
        session: To the drives.
        model: Of the arm with its load: what it weighs.
    """
    yield _drives(session)
    yield _enabled(session)
    yield session.bus.load()
    yield _scaling(session)
    yield _limits(session)
    yield _torque(session)
    yield _weight(session, model)
    yield _watch(session)
    yield _temperature(session.core.temperature)
    yield _cycle(session)
    if session.were_reset:
        said = "reset when connecting: " + "; ".join(map(str, session.were_reset))
        yield Finding("faults-left", True, said, len(session.were_reset))


def _drives(session: Session) -> Finding:
    objects = [drive.objects for drive in session.drives.drives]
    kinds = {(o.get("vendor", 0), o.get("product", 0)) for o in objects}
    said = ", ".join(
        f"vendor {vendor:X}h product {product:X}h" for vendor, product in sorted(kinds)
    )
    serials = " ".join(f"{o.get('serial', 0):x}" for o in objects)
    return Finding(
        "drives", True, f"{len(objects)} CiA 402 drives: {said}; serials {serials}", said
    )


def _enabled(session: Session) -> Finding:
    phase, mode = session.core.phase, session.options.trajectory_mode
    return Finding(
        "drives-enabled",
        phase is Phase.ENABLED,
        f"all axes are {phase.value}, in mode {mode} ({_mode_read(session.options)})",
        phase.value,
        Phase.ENABLED.value,
        "connect again",
    )


def _mode_read(options: Options) -> str:
    if MAPPINGS[options.mapping].carries_mode:
        return "6061h, read back in every cycle"
    return f"6061h, read back before enabling; mapping {options.mapping} does not carry it since"


def _scaling(session: Session) -> Finding:
    """What was found otherwise has ended the connection already."""
    drives = session.drives
    torque, q = drives.scaling.torque_resolution, drives.scaling.position_resolution
    given = sorted({key for axis in session.options.axes for key in axis} - {"centre_rad"})
    source = f"by the station: {', '.join(given)}; all else" if given else "all"
    said = (
        f"scaling ({source} by the drives, nothing contradictory): one count of torque is "
        f"{torque.min():.3g} to {torque.max():.3g} N·m at the joints, one of position "
        f"{q.max():.2g} rad at most"
    )
    return Finding("scaling", True, said, float(torque.max()))


def _limits(session: Session) -> Finding:
    drives, makers = session.drives, limits_of(session.arm.name)
    none = int(np.isnan(drives.q_min).sum())
    used = limits_of(session.arm.name, drives)
    narrower = float(max((used.q_min - makers.q_min).max(), (makers.q_max - used.q_max).max()))
    said = f"joint range used is no wider than the drives' own (607Dh), {_narrower(narrower)}"
    if none:
        said += f"; {none} of {len(drives.drives)} drives have no limits of their own"
    at = drives.scaling.position(session.player.position)
    outside = outside_of(at, used, session.arm.joint_names)
    passed = bool((used.q_min < used.q_max).all()) and not outside
    hint = "correct 607Dh in the drives, or axes.offset_deg in the station"
    return Finding("joint-limits", passed, "; ".join([*outside, said]), narrower, hint=hint)


def outside_of(q: FloatArray, limits: Limits, names: Sequence[str]) -> list[str]:
    """Joints that are where they cannot be: what scales their drives is wrong.

    Args:
        q: (n,) where they are [rad].
        limits: Of the arm and its drives.
        names: Of the joints.
    """
    beyond = (q < limits.q_min - OUTSIDE_RAD) | (q > limits.q_max + OUTSIDE_RAD)
    degrees = np.degrees(np.stack((q, limits.q_min, limits.q_max)))
    return [
        "{} is at {:.1f}°, outside of its range of {:.1f} to {:.1f}°".format(
            name, *degrees[:, axis]
        )
        for axis, name in enumerate(names)
        if beyond[axis]
    ]


def _narrower(by_rad: float) -> str:
    if by_rad <= 0:
        return "which is as wide as the maker's"
    return f"which is narrower than the maker's by up to {by_rad:.3f} rad"


def _torque(session: Session) -> Finding:
    most = session.drives.max_torque
    told = " ".join("?" if np.isnan(each) else f"{each:.0f}" for each in most)
    return Finding("torque-limits", True, f"drives limit themselves to {told} N·m (6072h)", told)


def _weight(session: Session, model: TorqueModel) -> Finding:
    """Whether measured torque can be what holds the arm; it has to where we send torques."""
    weighed = session.weighed(model) if session.core.phase is Phase.ENABLED else None
    if weighed is None:
        said = f"not compared with the arm's weight: mapping {session.options.mapping}, axes "
        return Finding("torque-sign", True, said + session.core.phase.value, "not compared")
    if wrong := weighed.contradictions:
        options = session.options
        needed = options.feed_forward or options.trajectory_mode == "cst"
        said = "; ".join(wrong)
        said += "" if needed else ". No torque is sent in this mode, but recordings hold it"
        return Finding("torque-sign", not needed, said, len(wrong), 0, TORQUE_HINT)
    names = [weighed.names[axis] for axis in weighed.compared]
    said = f"measured torque holds the arm's weight in {', '.join(names)}"
    if not names:
        said = "no joint carries enough weight here to tell the sign of its torque"
    return Finding("torque-sign", True, said, 0, 0)


def _watch(session: Session) -> Finding:
    options, lacking = session.options, session.drives.lacking
    said = (
        f"every drive stops by itself when it has not heard of us for {MASTER_SILENCE_MS} ms, or "
        f"lags by more than {options.following_error_deg:g}°; read back"
    )
    if any(lacking):
        said += f"; not settable: {', '.join(sorted({name for each in lacking for name in each}))}"
    return Finding("drives-watch", True, said, MASTER_SILENCE_MS / 1000)


def _temperature(celsius: FloatArray) -> Finding:
    known = celsius[np.isfinite(celsius)]
    if not len(known):
        return Finding("temperatures", True, "the drives tell no temperatures", "not told")
    told = " ".join("?" if np.isnan(each) else f"{each:.1f}" for each in celsius)
    return Finding(
        "temperatures",
        bool(known.max() <= HOTTEST_C),
        f"motors at {told} °C",
        float(known.max()),
        HOTTEST_C,
        "let the arm cool down",
    )


def _cycle(session: Session) -> Finding:
    """How punctual the cycles have been since they began."""
    schedule = session.core.schedule
    late, p99 = schedule.overrun / max(schedule.cycles, 1), schedule.lateness.percentile(99)
    refused = session.core.not_permitted
    said = (
        f"{schedule.cycles} cycles, {late:.1%} overrun, woken within {1e6 * p99:.0f} µs (99 %); "
        + ("; ".join(refused) or "real-time priority is permitted")
    )
    if wrong := session.bus.losses():
        said += f"; {wrong}"
    hint = "free the computer of other work, permit real-time priority, or lower rate_hz"
    return Finding("cycle", late <= MOST_OVERRUN, said, round(late, 4), MOST_OVERRUN, hint)
