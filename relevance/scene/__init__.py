"""What a tabletop is: boxes, table, camera, light, robot, and the goals asked of it.

World frame: origin at the centre of the table's top face, x forward (away from the
robot), y to the robot's left, z up. SI units (m, rad) throughout. A scene that exists is a
scene that was checked: unknown fields, NaN, overlapping, floating and off-table boxes, and boxes
in the robot are refused with the field's name. Directions are the robot's.

Compiled loops over boxes are in `relevance.scene.geometry`, imported by that name alone: reading
a scene loads no compiler.
"""

from relevance.scene.boxes import (
    TEXTURES,
    THINNEST,
    Box,
    Camera,
    Color,
    Light,
    Robot,
    Table,
    Texture,
    footprint_gap,
)
from relevance.scene.checks import SceneError
from relevance.scene.contacts import CONTACT_TOLERANCE
from relevance.scene.looks import lab, lookalikes
from relevance.scene.plans import Action, Phase, Pose
from relevance.scene.predicates import (
    FAMILIES,
    GAP,
    PREDICATES,
    Goal,
    Predicate,
    Rectangle,
    Region,
    asked_of,
    goal_holds,
    group_of,
)
from relevance.scene.projection import camera_up, pinhole, project, vertices
from relevance.scene.reading import read_scenes, scene_from_json, scene_to_json
from relevance.scene.scenes import Scene

__all__ = [
    "CONTACT_TOLERANCE",
    "FAMILIES",
    "GAP",
    "PREDICATES",
    "TEXTURES",
    "THINNEST",
    "Action",
    "Box",
    "Camera",
    "Color",
    "Goal",
    "Light",
    "Phase",
    "Pose",
    "Predicate",
    "Rectangle",
    "Region",
    "Robot",
    "Scene",
    "SceneError",
    "Table",
    "Texture",
    "asked_of",
    "camera_up",
    "footprint_gap",
    "goal_holds",
    "group_of",
    "lab",
    "lookalikes",
    "pinhole",
    "project",
    "read_scenes",
    "scene_from_json",
    "scene_to_json",
    "vertices",
]
