"""All that is known of the arm: its URDF, joints, limits, home, hand and what the hand can take.

The arm is a Franka Panda. Boxes stand for the meshes of its links; each is aligned with the axes
of its link's frame. Frames: `hand` is panda_hand (z out of the palm, fingers move along +-y).
"""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

ARM = 7
"""Joints of the arm."""
LINKS = ("panda_link5", "panda_link6", "panda_hand")
"""The links that come near the table: those whose boxes and frames the planner goes by."""
UPPER_LINKS = ("panda_link1", "panda_link2", "panda_link3", "panda_link4")
"""The links near the base, which only tall things can meet; their indices follow LINKS'."""
HAND = 2
"""Index of the hand in LINKS."""
HOME = np.array([0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398])
"""Franka's ready pose: hand down, high over the near part of the table, rad."""
PADDING = 0.001
"""Added to every box that stands for a link's mesh, m (pybullet inflates hulls by as much)."""
WAIST = 0.045
"""Where the hand is cut into two boxes, from its origin along its z, m."""
GRASPABLE_EDGE = 0.07
"""Longest footprint edge that the hand (opening 8 cm) takes with room to spare, m."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joint:
    """One step of the chain from the base to the hand."""

    child: str
    """Name of the link that it carries."""
    origin: np.ndarray
    """(4, 4): T_parent_child at angle 0, m."""
    revolute: bool
    """Whether it turns about its own z; otherwise it is fixed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panda:
    """What the URDF says of the arm."""

    chain: tuple[Joint, ...]
    """From the base to the hand."""
    lower: np.ndarray
    """(7,) rad."""
    upper: np.ndarray
    velocity: np.ndarray
    """(7,) rad/s."""
    arm: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    """Boxes around links: (index in LINKS, centre (3,), half extents (3,)) in that link's frame;
    the last two are the hand, which is narrower where the fingers are: that half comes first."""
    upper_arm: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    """The same for UPPER_LINKS."""
    foot: tuple[np.ndarray, np.ndarray]
    """Box (centre, half extents) around the link that does not move, in the base's frame."""
    shoulder: tuple[np.ndarray, np.ndarray]
    """The same around the first link, where joint 1, which turns it about the vertical, is at 0."""
    finger: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Boxes (low corner, high corner) of the left finger at opening 0, in the hand's frame."""
    finger_tip: float
    """Distance of the finger tips from the hand's origin, along its z, m."""
    palm: float
    """Distance of the palm from the hand's origin, along its z, m."""
    max_opening: float
    """Largest value of each of the two finger joints, m."""


def panda_urdf() -> Path:
    """The Panda's URDF that pybullet ships, found without importing its data package."""
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        raise RuntimeError("pybullet_data is not installed; it comes with pybullet")
    return Path(spec.origin).parent / "franka_panda" / "panda.urdf"


@cache
def panda() -> Panda:
    """Read the URDF and the meshes (once a process)."""
    path = panda_urdf()
    root = ElementTree.parse(path).getroot()
    joints = {_child(joint): joint for joint in root.iter("joint")}
    chain, limits = [], []
    for name in [*(f"panda_link{i}" for i in range(1, 9)), "panda_hand"]:
        joint = joints[name]
        revolute = joint.get("type") == "revolute"  # all of the Panda's turn about their own z
        chain.append(Joint(child=name, origin=_origin(joint), revolute=revolute))
        if revolute:
            limit = joint.find("limit")
            assert limit is not None
            limits.append([float(limit.get(key, "nan")) for key in ("lower", "upper", "velocity")])

    meshes = path.parent / "meshes" / "collision"
    turn7 = _origin(joints["panda_hand"])[:3, :3]
    shift7 = np.array([0.0, 0.0, _numbers(joints["panda_link8"], "xyz")[2]])
    link7 = (_vertices(meshes / "link7.obj") - shift7) @ turn7
    hand = _vertices(meshes / "hand.obj")
    arm = (
        (0, *_box(_vertices(meshes / "link5.obj"))),
        (1, *_box(_vertices(meshes / "link6.obj"))),
        (HAND, *_box(link7)),
        *((HAND, *_halves(_slice(hand, *ends))) for ends in ((WAIST, np.inf), (-np.inf, WAIST))),
    )
    mount = _numbers(joints["panda_leftfinger"], "xyz")
    finger = _vertices(meshes / "finger.obj") + mount
    middle = 0.5 * (finger[:, 2].min() + finger[:, 2].max())
    lower, upper, velocity = np.array(limits).T.copy()  # contiguous: a kernel for each layout else
    opening = joints["panda_leftfinger"].find("limit")
    assert opening is not None
    return Panda(
        chain=tuple(chain),
        lower=lower,
        upper=upper,
        velocity=velocity,
        arm=arm,
        upper_arm=tuple(
            (len(LINKS) + i, *_box(_vertices(meshes / f"{name.removeprefix('panda_')}.obj")))
            for i, name in enumerate(UPPER_LINKS)
        ),
        foot=_box(_vertices(meshes / "link0.obj")),
        shoulder=_box(_vertices(meshes / "link1.obj") + chain[0].origin[:3, 3]),
        finger=(_slice(finger, middle, np.inf), _slice(finger, -np.inf, middle)),
        finger_tip=float(finger[:, 2].max()),
        palm=float(hand[:, 2].max()),
        max_opening=float(opening.get("upper", "nan")),
    )


def _child(joint: ElementTree.Element) -> str:
    child = joint.find("child")
    assert child is not None
    return child.get("link", "")


def _numbers(joint: ElementTree.Element, key: str) -> np.ndarray:
    origin = joint.find("origin")
    text = origin.get(key, "0 0 0") if origin is not None else "0 0 0"
    return np.array([float(part) for part in text.split()])


def _origin(joint: ElementTree.Element) -> np.ndarray:
    roll, pitch, yaw = _numbers(joint, "rpy")
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    T = np.eye(4)
    T[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    T[:3, :3] = np.round(T[:3, :3], 12)
    T[:3, 3] = _numbers(joint, "xyz")
    return T


def _vertices(path: Path) -> np.ndarray:
    lines = (line.split() for line in path.read_text().splitlines() if line.startswith("v "))
    return np.array([[float(part) for part in line[1:4]] for line in lines])


def _box(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return _halves((vertices.min(0) - PADDING, vertices.max(0) + PADDING))


def _halves(corners: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    low, high = corners
    return (low + high) / 2, (high - low) / 2


def _slice(vertices: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounding box of the part of the convex hull between two heights."""
    # Here and not above: it takes most of a second to load, and only reading the URDF needs it.
    from scipy.spatial import ConvexHull

    inside = vertices[(vertices[:, 2] >= low) & (vertices[:, 2] <= high)]
    cuts = [inside]
    for plane in (low, high):
        if np.isfinite(plane):
            edges = ConvexHull(vertices).simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
            a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
            crosses = (a[:, 2] - plane) * (b[:, 2] - plane) < 0
            a, b = a[crosses], b[crosses]
            t = (plane - a[:, 2]) / (b[:, 2] - a[:, 2])
            cuts.append(a + t[:, None] * (b - a))
    part = np.vstack(cuts)
    return part.min(0) - PADDING, part.max(0) + PADDING
