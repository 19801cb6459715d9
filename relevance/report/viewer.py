"""The plan viewer: a page on this machine on which a plan runs, in three dimensions.

viser serves the page and everything on it; nothing is asked of the network. It and yourdfpy are
the extra `view`.
"""

from __future__ import annotations

import importlib.util
import io
import math
import threading
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from typing import Any, Self

import numpy as np

from relevance.errors import RelevanceError
from relevance.report.shots import Shot, words
from relevance.report.style import RELEVANT
from relevance.robot import panda_urdf
from relevance.scene import Box
from relevance.simulation import film_camera

HOST = "127.0.0.1"
"""For whom the page is served: this machine only."""
_RATE = 30  # moments a second while it plays
_STEP = 0.02  # s that the slider can tell apart
_SQUARE = ((1, 1), (-1, 1), (-1, -1), (1, -1))
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)]
_EDGES += [(i, i + 4) for i in range(4)]
_THICKNESS = 0.03
_REST = 1.0  # s at the end before it plays again


def require_viser() -> None:
    """Raise RelevanceError unless the extra is installed (it is not imported here)."""
    for name in ("viser", "yourdfpy"):
        if importlib.util.find_spec(name) is None:
            raise RelevanceError(
                f"the viewer needs {name}, which is not installed, expected: "
                "pip install 'relevance[view]'"
            )


class Viewer:
    """A page that shows one of several plans for the same task; use as a context manager."""

    def __init__(self, shots: Sequence[Shot], *, port: int = 8080) -> None:
        """Serve it, on the port or the next that is free."""
        require_viser()
        import viser
        import viser.transforms
        import yourdfpy
        from viser.extras import ViserUrdf

        urdf = panda_urdf()

        def mesh(fname: str) -> str:
            return str(urdf.parent / fname.removeprefix("package://"))

        panda = yourdfpy.URDF.load(str(urdf), filename_handler=mesh)
        self.shots = {shot.name: shot for shot in shots}
        self.shot = shots[0]
        self.playing = False
        self._changing = threading.RLock()  # visitors' clicks come in threads of their own
        self._marked: object = None
        self._rotation = viser.transforms.SO3.from_matrix
        with redirect_stdout(io.StringIO()):  # its banner: the command says where the page is
            self._server = viser.ViserServer(HOST, port, label="relevance", verbose=False)
        self._draw_room()
        scene = self.shot.task.scene
        base = self._server.scene.add_frame(
            "/robot",
            show_axes=False,
            position=scene.robot.base,
            wxyz=viser.transforms.SO3.from_z_radians(scene.robot.yaw).wxyz,
        )
        self.arm = ViserUrdf(self._server, panda, root_node_name=base.name)
        self._boxes = {box.name: self._draw_box(box) for box in scene.objects}
        self._add_controls()
        self.show(0.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self._server.get_port()}"

    def run(self) -> None:
        """Let it play, until interrupted."""
        last = time.monotonic()
        while True:
            time.sleep(1 / _RATE)
            now = time.monotonic()
            with self._changing:
                if self.playing:
                    self.advance(now - last)
            last = now

    def advance(self, seconds: float) -> None:
        """Go on in time; after the end, from the start."""
        now = self._now + seconds
        if now > self.shot.motion.seconds + _REST:
            now = 0.0
        self.time.value = min(round(now, 2), _longest(self.shot))  # which shows it
        self._now = now

    def choose(self, name: str) -> None:
        """Show another of the plans, from its start."""
        with self._changing:
            self.shot, self._marked = self.shots[name], None
            for other, (_, outline) in self._boxes.items():
                outline.visible = other in self.shot.relevant
            self.time.value = 0.0
            self.time.max = _longest(self.shot)
            self.show(0.0)

    def show(self, seconds: float) -> None:
        """Show one moment of the plan."""
        with self._changing, self._server.atomic():
            self._now = seconds
            now = self.shot.motion.at(seconds)
            self.arm.update_cfg(np.array([*now.joints, now.gripper]))  # the other finger mimics
            for name, T in now.poses.items():
                frame, _ = self._boxes[name]
                frame.position = T[:3, 3]
                frame.wxyz = self._rotation(T[:3, :3]).wxyz
            if self._marked != now.step:
                self.steps.content = steps(self.shot, now.step)
                self._marked = now.step

    def _draw_room(self) -> None:
        """Light, camera, table and floor."""
        server, scene = self._server, self.shot.task.scene
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label("relevance view")
        camera = film_camera(scene, 400, 300)
        server.initial_camera.position = camera.eye
        server.initial_camera.look_at = camera.target
        server.initial_camera.fov = np.radians(40.0)
        server.scene.set_up_direction("+z")
        server.scene.add_box(
            "/table",
            color=scene.table.color,
            dimensions=(*scene.table.size, _THICKNESS),
            position=(0.0, 0.0, -_THICKNESS / 2),
        )

    def _draw_box(self, box: Box) -> tuple[Any, Any]:
        """The frame that a box goes with, and its outline."""
        scene = self._server.scene
        name = f"/boxes/{box.name.replace('/', ' ')}"
        frame = scene.add_frame(name, show_axes=False)
        scene.add_box(f"{name}/box", color=box.color, dimensions=box.size)
        x, y, z = box.size
        corners = np.array([[i * x, j * y, k * z] for k in (-1, 1) for i, j in _SQUARE]) / 2
        outline = scene.add_line_segments(
            f"{name}/outline",
            points=np.array([[corners[a], corners[b]] for a, b in _EDGES]),
            colors=np.frombuffer(bytes.fromhex(RELEVANT.removeprefix("#")), np.uint8),
            thickness=4.0,
            thickness_units="screen",
            visible=box.name in self.shot.relevant,
        )
        scene.add_label(
            f"{name}/name", box.name, position=(0.0, 0.0, z / 2), anchor="bottom-center"
        )
        return frame, outline

    def _add_controls(self) -> None:
        gui = self._server.gui
        gui.add_markdown(f"**{self.shot.task.goal}**")
        if len(self.shots) > 1:
            plans = gui.add_dropdown("plan", tuple(self.shots))
            plans.on_update(lambda _: self.choose(plans.value))
        self.play = gui.add_button("play")
        self.play.on_click(lambda _: self.toggle())
        longest = _longest(self.shot)
        self.time = gui.add_slider("seconds", 0.0, longest, _STEP, 0.0)
        self.time.on_update(self._slid)
        self.steps = gui.add_markdown("")
        gui.add_markdown("Outlined: the objects that matter for the goal.")

    def toggle(self) -> None:
        """Play or pause."""
        with self._changing:
            self.playing = not self.playing
            self.play.label = "pause" if self.playing else "play"

    def _slid(self, event: Any) -> None:
        self.show(float(self.time.value))


def steps(shot: Shot, current: int) -> str:
    """The actions as a Markdown list, the one under way marked, and what finding them took."""
    result = shot.result
    lines = [
        f"{n + 1}. **{words(action)}** ◀" if n == current else f"{n + 1}. {words(action)}"
        for n, action in enumerate(result.actions)
    ] or ["The goal is true already: nothing moves."]
    found = f"Found with {result.counts.work:,} units of work, {result.counts.nodes:,} nodes."
    return "\n".join([*lines, "", found])


def _longest(shot: Shot) -> float:
    """Where the slider ends, s: written short, and one of no length cannot be drawn."""
    return max(round(math.ceil(shot.motion.seconds / _STEP) * _STEP, 2), _STEP)
