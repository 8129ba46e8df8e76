"""Descriptions of arms, and whether the file of a custom arm still says what it said.

A built-in arm is described in `hil/arms/<name>.yaml`, a custom arm in a file of the same form or in
a URDF. Runs and models store a digest of a custom arm's file (`model_sha256`), so that they are not
used with another arm later (`require_same_arm`).
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FloatArray, SpecError


@dataclass(frozen=True, slots=True)
class Capsule:
    """A collision body: all points within `radius` of the segment from `a` to `b`.

    Attributes:
        link: 0 for the fixed base, 1…n for the links in their DH frames.
        a, b: Ends of the axis in the link's frame [m].
        radius: [m].
    """

    link: int
    a: tuple[float, float, float]
    b: tuple[float, float, float]
    radius: float


@dataclass(frozen=True, slots=True, eq=False)
class ArmDescription:
    """An arm as its maker publishes it, in SI units and standard (distal) DH convention.

    `load_arm` returns the same object to all callers, so its arrays are read-only.

    Attributes:
        name: Key of the arm, e.g. `ur5`, or the path of its description.
        joint_names: Length n.
        dh: (n, 4) rows of a [m], alpha [rad], d [m], theta offset [rad].
        q_min, q_max: Position limits [rad], (n,).
        qd_max, qdd_max: Velocity [rad/s] and acceleration [rad/s²] limits, (n,).
        effort_max: Joint torque limits [N·m], (n,).
        excite_min, excite_max: The range excitation uses unless a spec says otherwise [rad], (n,).
        mass: (n,) nominal link masses [kg].
        com: (n, 3) nominal centres of mass in the link's DH frame [m].
        inertia: (n, 3, 3) nominal inertia about the centre of mass, DH axes [kg·m²].
        gear_ratio: (n,) motor revolutions per joint revolution.
        drive_gains: (n,) torque per motor current at the joint [N·m/A].
        rate_hz: State and command rate of the controller [Hz].
        payload_max_kg: Rated payload [kg].
        capsules: Collision bodies, base and links.
        sources: Where each number comes from, by topic.
        link_names: (n + 1,) names of the base and the links, for messages.
        joints_per_motor: (n, n) joint angles per angle of the motors behind their gears; not the
            unit matrix where a motor also moves a neighbour of its joint.
        guessed: Which of these are unknown: guessed numbers are good enough for a mock only.
        sha256: Digest of the description of a custom arm (`description_sha256`); empty for a
            built-in arm.
        file_sha256: Digest of the bytes of that file.
    """

    name: str
    joint_names: tuple[str, ...]
    dh: FloatArray
    q_min: FloatArray
    q_max: FloatArray
    qd_max: FloatArray
    qdd_max: FloatArray
    effort_max: FloatArray
    excite_min: FloatArray
    excite_max: FloatArray
    mass: FloatArray
    com: FloatArray
    inertia: FloatArray
    gear_ratio: FloatArray
    drive_gains: FloatArray
    rate_hz: float
    payload_max_kg: float
    capsules: tuple[Capsule, ...]
    sources: Mapping[str, str]
    link_names: tuple[str, ...]
    joints_per_motor: FloatArray
    guessed: tuple[str, ...] = ()
    sha256: str = ""
    file_sha256: str = ""

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)


def arm_names() -> tuple[str, ...]:
    """Return the names of the built-in arms."""
    folder = files("hil.arms")
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".yaml")))


def is_description(model: str) -> bool:
    """Return whether a robot's `model` is the path of a description, not a built-in arm's name."""
    return model.casefold().endswith((".yaml", ".yml"))


def is_described(model: str) -> bool:
    """Return whether an arm is built in or described in a file: both have collision bodies."""
    return model in arm_names() or is_description(model)


def load_arm(name: str) -> ArmDescription:
    """Return the built-in arm `name`, or the one that a file describes; parsed once per process.

    Raises:
        SpecError: There is no such arm, or its description cannot be used.
    """
    return _parsed(name)


@cache
def _parsed(name: str) -> ArmDescription:
    from hil.core import look_into  # a model file is read without PyYAML

    if is_description(name):
        arm = _of_file(Path(name))
    elif name in arm_names():
        text = files("hil.arms").joinpath(f"{name}.yaml").read_text("utf-8")
        arm = arm_from_dict(name, look_into(text))
    else:
        raise SpecError(
            f"there is no built-in arm {name!r}",
            hint=f"built in are {', '.join(arm_names())}; a path to a URDF works too",
        )
    for value in (getattr(arm, field.name) for field in fields(arm)):
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return arm


def _of_file(path: Path) -> ArmDescription:
    """Return the arm of a file of the same form as those beside this module."""
    from hil.core import look_into

    hint = "`hil new own-urdf` writes one from a URDF; hil/arms/ur5.yaml is one, too"
    try:
        raw = path.read_bytes()
        document = look_into(raw.decode("utf-8"))
    except (OSError, ValueError) as error:
        raise SpecError(f"{path}: cannot be read as an arm: {error}", hint=hint) from None
    try:
        arm, digest = arm_from_dict(str(path), document), description_sha256(document)
        return replace(arm, sha256=digest, file_sha256=sha256(raw).hexdigest())
    except KeyError as error:
        raise SpecError(f"{path}: the arm lacks {error.args[0]!r}", hint=hint) from None
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SpecError(f"{path}: describes no arm: {error}", hint=hint) from None


def arm_from_dict(name: str, raw: dict[str, Any]) -> ArmDescription:
    """Return an arm from the content of its file.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: It describes none.
    """
    joints, links = raw["joints"], raw["links"]

    def column(key: str, scale: float = 1.0) -> FloatArray:
        return np.array([joint[key] for joint in joints], dtype=np.float64) * scale

    if (column("drive_gain_nm_a") == 0).any():
        raise ValueError("a drive_gain_nm_a is 0; write null where it is not known")
    degree = np.pi / 180
    dh = np.array([[j["a_m"], j["alpha_deg"], j["d_m"], j["theta_deg"]] for j in joints])
    dh[:, [1, 3]] *= degree
    mass = np.array([link["mass_kg"] for link in links], dtype=np.float64)
    inertia = np.array([_symmetric(link["inertia_kgm2"]) for link in links])
    link_names = ("base", *(link.get("name", f"link {i}") for i, link in enumerate(links, 1)))
    for link, m, about_com in zip(link_names[1:], mass, inertia, strict=True):
        _require_possible(link, m, about_com)
    return ArmDescription(
        name=name,
        joint_names=tuple(joint["name"] for joint in joints),
        dh=dh,
        q_min=column("q_min_deg", degree),
        q_max=column("q_max_deg", degree),
        qd_max=column("qd_max_deg_s", degree),
        qdd_max=column("qdd_max_deg_s2", degree),
        effort_max=column("effort_max_nm"),
        excite_min=column("excite_min_deg", degree),
        excite_max=column("excite_max_deg", degree),
        mass=mass,
        com=np.array([link["com_m"] for link in links]),
        inertia=inertia,
        gear_ratio=column("gear_ratio"),
        drive_gains=column("drive_gain_nm_a"),
        rate_hz=float(raw["rate_hz"]),
        payload_max_kg=float(raw["payload_max_kg"]),
        capsules=tuple(
            Capsule(c["link"], tuple(c["a_m"]), tuple(c["b_m"]), c["radius_m"])
            for c in raw["capsules"]
        ),
        sources=raw["sources"],
        link_names=link_names,
        joints_per_motor=np.array(raw.get("joints_per_motor", np.eye(len(joints))), np.float64),
        guessed=_words(raw.get("guessed", [])),
    )


def _words(raw: Any) -> tuple[str, ...]:
    if not isinstance(raw, list) or not all(isinstance(word, str) for word in raw):
        raise TypeError("`guessed` is a list of words, such as [qdd_max, capsules]")
    return tuple(raw)


def _symmetric(values: list[float]) -> FloatArray:
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=np.float64)


_ROUNDING = 0.05
"""How far principal moments may be from possible ones, as a share of the largest: makers and CAD
programs round inertias of small links to few digits."""


def _require_possible(link: str, mass: float, inertia: FloatArray) -> None:
    """Raise if no distribution of mass has a link's mass and inertia.

    Args:
        link: Its name.
        mass: [kg].
        inertia: (3, 3) about the centre of mass [kg·m²].

    Raises:
        ValueError: The mass is negative, a principal moment of inertia is, or is larger than the
            sum of the other two.
    """
    if not (np.isfinite(mass) and np.isfinite(inertia).all()):
        raise ValueError(f"{link}: mass_kg and inertia_kgm2 must be finite numbers")
    if mass < 0:
        raise ValueError(f"{link}: mass_kg is {mass:g}, but must not be negative")
    least, middle, largest = np.linalg.eigvalsh(inertia)
    if least < -_ROUNDING * abs(largest) or least + middle < largest * (1 - _ROUNDING):
        moments = ", ".join(f"{moment:.3g}" for moment in (least, middle, largest))
        raise ValueError(
            f"{link}: no body has the inertia_kgm2 that is given: its principal moments are "
            f"{moments} kg·m², and none may be negative or larger than the sum of the others"
        )


# The file of a custom arm: has its content changed?


def model_sha256(model: str) -> str:
    """Return the SHA-256 of the content of a custom arm's file, as this process has read it.

    Returns:
        Hexadecimal; empty for a built-in arm.

    Raises:
        SpecError: The file cannot be used.
    """
    return _digests(model)[0]


def _digests(model: str) -> tuple[str, str]:
    """Return the digests of the file's content and of its bytes, which old runs and models have."""
    if model in arm_names():
        return "", ""
    if is_description(model):
        arm = load_arm(model)
        return arm.sha256, arm.file_sha256
    try:
        content = Path(model).read_bytes()
        return urdf_sha256(content), sha256(content).hexdigest()
    except OSError as error:
        raise SpecError(
            f"{model}: cannot be read: {error.strerror}", hint="see whether it exists"
        ) from None


def require_same_arm(
    robot: Mapping[str, Any], source: Path, otherwise: str, *, gone: bool = False
) -> None:
    """Raise if the file of an arm has changed since a run or model was made with it.

    Args:
        robot: The robot in a run's start document, or the arm in a model's; one without a digest
            passes.
        source: The run or model, for the message.
        otherwise: What else the user can do.
        gone: A file that cannot be read passes as well: it cannot be mistaken for the arm.

    Raises:
        DataError: The file is gone, or its content has changed.
    """
    recorded, model = robot.get("model_sha256"), str(robot.get("model", ""))
    if not recorded:
        return
    try:
        digests = _digests(model)
    except SpecError as error:
        if gone:
            return
        raise DataError(error.message, hint=f"put {model} back, or {otherwise}") from None
    if recorded not in digests:
        raise DataError(
            f"{model} describes another arm than when {source} was made: its SHA-256 is now "
            f"{digests[0][:12]}…, and was {str(recorded)[:12]}…",
            hint=f"put the original file back, or {otherwise}",
        )


_REMARKS = ("guessed", "sources")
"""Keys of a description that say how its numbers are known."""

_LOOKS = ("visual", "collision", "material", "gazebo", "transmission")
"""Elements of a URDF that no model is made of."""


def description_sha256(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a description, as its YAML was read.

    Everything counts but `guessed` and `sources`. Comments, the order of keys and how numbers are
    written do not.
    """
    said = {key: value for key, value in document.items() if key not in _REMARKS}
    text = json.dumps(_with_floats(said), sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def urdf_sha256(content: bytes) -> str:
    """Return the SHA-256 of a URDF: of its joints and inertias as canonical XML, without looks.

    Of the bytes where they are no XML.
    """
    try:
        root = ET.fromstring(content)  # noqa: S314  a file of the user's own lab
    except (ET.ParseError, ValueError):
        return sha256(content).hexdigest()
    text = ET.canonicalize(ET.tostring(root, "unicode"), strip_text=True, exclude_tags=_LOOKS)
    return sha256(text.encode()).hexdigest()


def _with_floats(value: Any) -> Any:
    """Return the value with every number as a float: 250 is 250.0."""
    if isinstance(value, Mapping):
        return {str(key): _with_floats(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_with_floats(one) for one in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value if isinstance(value, str | float | bool | None) else str(value)
