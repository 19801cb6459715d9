"""Pictures of the arm at work: its real meshes, the table and the boxes, by TinyRenderer.

For people to look at, no part of a dataset: `rendering` leaves the arm out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from relevance.robot import panda_urdf
from relevance.scene import Camera, Scene
from relevance.simulation.bullet import Client, lens, pybullet

_JOINTS = (*range(7), 9, 10)
_SUN = (0.5, -0.9, 2.0)
_FLOOR = (0.80, 0.82, 0.85)
_THICKNESS = 0.03
_FINE = 2  # pixels drawn for each of the picture's, each way: TinyRenderer smooths no edge


def film_camera(scene: Scene, width: int, height: int) -> Camera:
    """One that stands opposite the robot, to its right, and sees all of it and of the table's part
    within its reach."""
    x, y, z = scene.robot.base
    c, s = math.cos(scene.robot.yaw), math.sin(scene.robot.yaw)

    def seen_from(forward: float, left: float, up: float) -> tuple[float, float, float]:
        return (x + c * forward - s * left, y + s * forward + c * left, z + up)

    return Camera(
        eye=seen_from(1.7, -1.25, 1.0),
        target=seen_from(0.3, 0.04, 0.26),
        width=width,
        height=height,
        fov=41.0,
    )


class Film(Client):
    """Draws a scene and its robot as they are at one moment; use as a context manager."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        super().__init__()
        self.camera = camera
        half = scene.robot.yaw / 2
        self._robot = pybullet.loadURDF(
            str(panda_urdf()),
            scene.robot.base,
            (0.0, 0.0, math.sin(half), math.cos(half)),
            useFixedBase=True,
            physicsClientId=self.client,
        )
        place = (0.0, 0.0, -_THICKNESS / 2)
        self._body((*scene.table.size, _THICKNESS), scene.table.color, place)
        self._boxes = {box.name: self._body(box.size, box.color) for box in scene.objects}

    def _body(
        self,
        size: tuple[float, ...],
        color: tuple[float, ...],
        position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> int:
        shape = pybullet.createVisualShape(
            pybullet.GEOM_BOX,
            halfExtents=[edge / 2 for edge in size],
            rgbaColor=[*color, 1.0],
            specularColor=[0.0, 0.0, 0.0],
            physicsClientId=self.client,
        )
        return pybullet.createMultiBody(
            baseMass=0.0,
            baseVisualShapeIndex=shape,
            basePosition=position,
            physicsClientId=self.client,
        )

    def frame(
        self, joints: np.ndarray, gripper: float, poses: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """A picture (H, W, 3) uint8, and where each box shows in it, (H, W) bool.

        joints (7,) rad, gripper: each finger joint, m; poses: T_world_box (4, 4) of every box.
        """
        values = [[value] for value in (*joints.tolist(), gripper, gripper)]
        pybullet.resetJointStatesMultiDof(self._robot, _JOINTS, values, physicsClientId=self.client)
        for name, T in poses.items():
            pybullet.resetBasePositionAndOrientation(
                self._boxes[name], T[:3, 3], _quaternion(T), physicsClientId=self.client
            )
        camera = self.camera
        width, height = _FINE * camera.width, _FINE * camera.height
        _, _, rgba, _, bodies = pybullet.getCameraImage(
            width,
            height,
            *lens(camera),
            lightDirection=_SUN,
            lightColor=(1.0, 1.0, 1.0),
            lightDistance=3.0,
            shadow=1,
            lightAmbientCoeff=0.6,
            lightDiffuseCoeff=0.4,
            lightSpecularCoeff=0.05,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        fine = np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[..., :3].copy()
        ids = np.asarray(bodies).reshape(height, width)
        fine[ids < 0] = np.rint(255 * np.array(_FLOOR))
        blocks = fine.reshape(camera.height, _FINE, camera.width, _FINE, 3)
        picture = np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
        ids = ids[::_FINE, ::_FINE]
        return picture, {name: ids == body for name, body in self._boxes.items()}


def _quaternion(T: np.ndarray) -> tuple[float, float, float, float]:
    """Of the rotation of a pose (4, 4), x, y, z, w."""
    from scipy.spatial.transform import Rotation  # a fifth of a second to import

    return tuple(Rotation.from_matrix(T[:3, :3]).as_quat())
