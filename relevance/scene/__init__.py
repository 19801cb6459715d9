"""What a tabletop is: boxes, table, camera, light, robot, and the goals asked of it.

World frame: origin at the centre of the table's top face, x forward (away from the
robot), y to the robot's left, z up. SI units (m, rad) throughout. A scene that exists is a
scene that was checked: unknown fields, NaN, overlapping, floating and off-table boxes are
refused with the field's name.
"""

from relevance.scene.boxes import (
    TEXTURES,
    Box,
    Camera,
    Color,
    Light,
    Robot,
    SceneError,
    Table,
    Texture,
    footprint_gap,
)
from relevance.scene.plans import Action, Phase, Pose
from relevance.scene.predicates import (
    FAMILIES,
    GAP,
    PREDICATES,
    Goal,
    Predicate,
    Rectangle,
    goal_holds,
)
from relevance.scene.scenes import (
    CONTACT_TOLERANCE,
    Scene,
    read_scenes,
    scene_from_json,
    scene_to_json,
)

__all__ = [
    "CONTACT_TOLERANCE",
    "FAMILIES",
    "GAP",
    "PREDICATES",
    "TEXTURES",
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
    "Robot",
    "Scene",
    "SceneError",
    "Table",
    "Texture",
    "footprint_gap",
    "goal_holds",
    "read_scenes",
    "scene_from_json",
    "scene_to_json",
]
