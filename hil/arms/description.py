"""Descriptions of arms, and detection of changes in the description file of a custom arm.

A built-in arm is described in `hil/arms/<name>.yaml`. A custom arm is described in a YAML file of
the same form as a built-in arm, or in a URDF. Runs and models store a digest of the file of a
custom arm (`model_sha256`). `require_same_arm` checks this digest, so that a run or model is not
used with a different arm.
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
    """Collision body: all points within `radius` of the segment from `a` to `b`.

    Attributes:
        link: Index of the link: 0 for the fixed base, 1…n for the links in their DH frames.
        a, b: Ends of the axis in the link's frame [m].
        radius: Radius of the capsule [m].
    """

    link: int
    a: tuple[float, float, float]
    b: tuple[float, float, float]
    radius: float


@dataclass(frozen=True, slots=True, eq=False)
class ArmDescription:
    """Published data of an arm, in SI units and standard (distal) DH convention.

    `load_arm` returns the same object to all callers; the arrays of the object are therefore
    read-only.

    Attributes:
        name: Key of a built-in arm, e.g. `ur5`, or the path of the description of a custom arm.
        joint_names: Names of the n joints.
        dh: (n, 4) DH parameters, in rows of a [m], alpha [rad], d [m], theta offset [rad].
        q_min, q_max: (n,) lower and upper position limits [rad].
        qd_max, qdd_max: (n,) velocity limits [rad/s] and acceleration limits [rad/s²].
        effort_max: (n,) joint torque limits [N·m].
        excite_min, excite_max: (n,) default position range of the excitation [rad].
        mass: (n,) nominal link masses [kg].
        com: (n, 3) nominal centres of mass, each in the DH frame of its link [m].
        inertia: (n, 3, 3) nominal inertia of each link about its centre of mass, in DH axes
            [kg·m²].
        gear_ratio: (n,) motor revolutions per joint revolution.
        drive_gains: (n,) joint torque per motor current [N·m/A].
        rate_hz: State and command rate of the controller [Hz].
        payload_max_kg: Rated payload [kg].
        capsules: Collision bodies of the base and the links.
        sources: Texts that state the source of the numbers, by topic.
        link_names: (n + 1,) names of the base and the links, for messages.
        joints_per_motor: (n, n) matrix of joint angles per motor angle behind the gears. The matrix
            `joints_per_motor` is not the identity if a motor also moves a neighbouring joint.
        guessed: Names of the quantities that are guessed; guessed values are accurate enough only
            for a mock.
        sha256: Digest of the description of a custom arm (`description_sha256`); empty for a
            built-in arm.
        file_sha256: Digest of the bytes of the description file of a custom arm.
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
    """Return whether `model` of a robot is the path of a description file, not a built-in name."""
    return model.casefold().endswith((".yaml", ".yml"))


def is_described(model: str) -> bool:
    """Return whether an arm is built in or described by a description file.

    Built-in arms and arms of a description file have collision bodies, whereas an arm from a URDF
    has none.
    """
    return model in arm_names() or is_description(model)


def load_arm(name: str) -> ArmDescription:
    """Return the built-in arm `name`, or the arm of the description file `name`.

    Each description file is parsed once per process.

    Raises:
        SpecError: The arm does not exist, or its description is invalid.
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
            hint=f"built-in arms: {', '.join(arm_names())}; the path of a URDF is accepted too",
        )
    for value in (getattr(arm, field.name) for field in fields(arm)):
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return arm


def _of_file(path: Path) -> ArmDescription:
    """Return the arm of a description file, which has the form of the YAML files in this folder."""
    from hil.core import look_into

    hint = "`hil new own-urdf` writes a description from a URDF; example: hil/arms/ur5.yaml"
    try:
        raw = path.read_bytes()
        document = look_into(raw.decode("utf-8"))
    except (OSError, ValueError) as error:
        raise SpecError(
            f"{path}: cannot be read as an arm description: {error}", hint=hint
        ) from None
    try:
        arm, digest = arm_from_dict(str(path), document), description_sha256(document)
        return replace(arm, sha256=digest, file_sha256=sha256(raw).hexdigest())
    except KeyError as error:
        raise SpecError(
            f"{path}: the arm description lacks the key {error.args[0]!r}", hint=hint
        ) from None
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SpecError(f"{path}: is not a valid arm description: {error}", hint=hint) from None


def arm_from_dict(name: str, raw: dict[str, Any]) -> ArmDescription:
    """Return an arm from the parsed content of its description file.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: The content is not a valid description of
            an arm.
    """
    joints, links = raw["joints"], raw["links"]

    def column(key: str, scale: float = 1.0) -> FloatArray:
        return np.array([joint[key] for joint in joints], dtype=np.float64) * scale

    if (column("drive_gain_nm_a") == 0).any():
        raise ValueError("a drive_gain_nm_a is 0; write null if it is unknown")
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
        raise TypeError("`guessed` must be a list of strings, such as [qdd_max, capsules]")
    return tuple(raw)


def _symmetric(values: list[float]) -> FloatArray:
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=np.float64)


_ROUNDING = 0.05
"""Tolerance for principal moments of inertia, as a share of the largest moment.

Manufacturers and CAD programs round the inertias of small links to few digits.
"""


def _require_possible(link: str, mass: float, inertia: FloatArray) -> None:
    """Raise if the mass and inertia of a link are physically inconsistent.

    Args:
        link: Name of the link for the error message.
        mass: Mass [kg].
        inertia: (3, 3) inertia about the centre of mass [kg·m²].

    Raises:
        ValueError: The mass or a principal moment of inertia is negative, or a principal moment is
            larger than the sum of the other two.
    """
    if not (np.isfinite(mass) and np.isfinite(inertia).all()):
        raise ValueError(f"{link}: mass_kg and inertia_kgm2 must be finite numbers")
    if mass < 0:
        raise ValueError(f"{link}: mass_kg is {mass:g}, but must not be negative")
    least, middle, largest = np.linalg.eigvalsh(inertia)
    if least < -_ROUNDING * abs(largest) or least + middle < largest * (1 - _ROUNDING):
        moments = ", ".join(f"{moment:.3g}" for moment in (least, middle, largest))
        raise ValueError(
            f"{link}: inertia_kgm2 is not physically consistent: its principal moments are "
            f"{moments} kg·m², and none may be negative or larger than the sum of the others"
        )


# Changes in the description file of a custom arm


def model_sha256(model: str) -> str:
    """Return the SHA-256 of the content of a custom arm's file as this process has read it.

    Returns:
        Hexadecimal digest of the content; empty for a built-in arm.

    Raises:
        SpecError: The description file is missing or invalid.
    """
    return _digests(model)[0]


def _digests(model: str) -> tuple[str, str]:
    """Return the digest of the content of the file and the digest of its bytes.

    Runs and models of older versions of hil contain the digest of the bytes instead of the digest
    of the content.
    """
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
            f"{model}: cannot be read: {error.strerror}", hint="check that the file exists"
        ) from None


def require_same_arm(
    robot: Mapping[str, Any], source: Path, otherwise: str, *, gone: bool = False
) -> None:
    """Raise if the file of an arm has changed since a run or model was made with it.

    Args:
        robot: Robot entry of a run's start document, or of a model; a robot entry without a digest
            is accepted.
        source: Path of the run or model for the error message.
        otherwise: Alternative remedy for the user, which the error message contains.
        gone: Whether a description file that cannot be read is accepted too.

    Raises:
        DataError: The description file cannot be read, or its content has changed.
    """
    recorded, model = robot.get("model_sha256"), str(robot.get("model", ""))
    if not recorded:
        return
    try:
        digests = _digests(model)
    except SpecError as error:
        if gone:
            return
        raise DataError(error.message, hint=f"restore {model}, or {otherwise}") from None
    if recorded not in digests:
        raise DataError(
            f"{model} has changed since {source} was made: its SHA-256 is now {digests[0][:12]}…, "
            f"it was {str(recorded)[:12]}…",
            hint=f"restore the original file, or {otherwise}",
        )


_REMARKS = ("guessed", "sources")
"""Keys of a description that state how its numbers were obtained; the digest ignores them."""

_LOOKS = ("visual", "collision", "material", "gazebo", "transmission")
"""Elements of a URDF that no robot model uses; the digest ignores them."""


def description_sha256(document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a parsed YAML description.

    The digest of a description depends on everything except `guessed` and `sources`. Comments, the
    order of keys and the notation of numbers do not change the digest.
    """
    said = {key: value for key, value in document.items() if key not in _REMARKS}
    text = json.dumps(_with_floats(said), sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def urdf_sha256(content: bytes) -> str:
    """Return the SHA-256 of the joints and inertias of a URDF, in canonical XML.

    Visual and collision geometry do not change the digest. If the content is not valid XML, the
    digest is computed from the bytes.
    """
    try:
        root = ET.fromstring(content)  # noqa: S314  a file of the user's own lab
    except (ET.ParseError, ValueError):
        return sha256(content).hexdigest()
    text = ET.canonicalize(ET.tostring(root, "unicode"), strip_text=True, exclude_tags=_LOOKS)
    return sha256(text.encode()).hexdigest()


def _with_floats(value: Any) -> Any:
    """Return the value with every number in it as a float: 250 is 250.0."""
    if isinstance(value, Mapping):
        return {str(key): _with_floats(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_with_floats(one) for one in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value if isinstance(value, str | float | bool | None) else str(value)
