"""A motion in the browser, by viser: the one module that speaks to it.

viser's splats are marked experimental. They were chosen over point clouds and instanced spheres because they move with
their body's frame without being sent again, are sorted together with the background, and look like the renderer's.
"""

from __future__ import annotations

import contextlib
import io
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from ...datasets.models import Model
from ...datasets.ply import Splats
from ...schemas import CgwmError, UsageError
from .contact_marks import SLIDING_RGB, STICKING_RGB, ContactMarks
from .motions import Motion
from .scene_at import BodyShape, SceneAt, background_from, radius_m, scene_at, shapes_of, viewpoint

if TYPE_CHECKING:
    from ...datasets.cameras import Camera

SPEEDS = {"as it was": 1.0, "3 times slower": 1 / 3, "10 times slower": 0.1}
_MOST_UPDATES_HZ = 30.0
_LARGEST_HALF_SIGMA = 200.0
"""viser sends covariances as half-precision floats, which end at 65504: the largest sphere of a group, in its unit."""
_SEE_THROUGH = 0.12
"""Of the opacities: several spheres lie behind each other everywhere."""
_FIELD_OF_VIEW_RAD = 0.9
_POINT_RADIUS = 0.1
"""Of a contact [radii of the largest free body]."""
_SPHERE_RGB = (120, 190, 120)
_AMBIENT, _SUN = 0.9, 0.9
"""Light in which what is no splat has about its own colour; viser's own makes it paler."""


def require_viser() -> Any:
    """Return the package viser.

    Raises:
        UsageError: If it is not installed.
    """
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UsageError("'cgwm view' needs the package viser.", todo="pip install 'cgwm[view]'.") from None
    return viser


class Viewer:
    """A page with a time slider that shows one of several motions of a model.

    Args:
        title: What is shown.
        model: Its bodies, background, ground and light.
        motions: What can be chosen, by name; each is made when it is chosen first, and the first at once.
        host: Address to listen at.
        port: Port to listen at; 0 takes a free one.

    Raises:
        UsageError: If viser is not installed, or the address cannot be had.
        CgwmError: If the first motion cannot be made.
    """

    def __init__(
        self, title: str, model: Model, motions: Mapping[str, Callable[[], Motion]], host: str, port: int
    ) -> None:
        viser = require_viser()
        port = _free_port(host, port)
        self._made = {name: make for name, make in motions.items()}
        self._kept: dict[str, Motion] = {}
        self._lock = threading.RLock()
        self._shapes = shapes_of(model)
        self._size_m = radius_m(model, self._shapes)
        self._motion = self._load(next(iter(motions)))
        with contextlib.redirect_stdout(io.StringIO()):  # its banner; our URL is the one line that is printed
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        self.url = f"http://{'localhost' if host in ('0.0.0.0', '::') else host}:{self.server.get_port()}"
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._add_scene(model)
        self._add_controls()
        self._begin(self._motion)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def run(self) -> None:
        """Play whenever that is asked for; returns only by an exception, such as KeyboardInterrupt."""
        while True:
            times_s = self._motion.times_s
            pace = SPEEDS[self._speed.value]
            step_s = float(times_s[-1] - times_s[0]) / max(1, len(times_s) - 1) / pace
            stride = max(1, math.ceil(1 / (_MOST_UPDATES_HZ * step_s))) if step_s > 0 else 1
            time.sleep(max(step_s * stride, 1 / _MOST_UPDATES_HZ))
            if self._playing and len(times_s) > 1:
                self._frame.value = (self._frame.value + stride) % len(times_s)  # shows it, too

    def _load(self, name: str) -> Motion:
        if name not in self._kept:
            self._kept[name] = self._made[name]()
        return self._kept[name]

    # What stands in the scene

    def _add_scene(self, model: Model) -> None:
        scene, size = self.server.scene, self._size_m
        eye, target, up = viewpoint(model, self._motion, size)
        scene.set_up_direction(tuple(up))
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light/ambient", intensity=_AMBIENT)
        scene.add_light_directional("/light/sun", intensity=_SUN, position=tuple(eye + 20 * size * up))
        camera = self.server.initial_camera
        camera.position, camera.look_at, camera.up = eye, target, up
        camera.fov = _FIELD_OF_VIEW_RAD
        background = background_from(model, eye)
        self._background = None if background is None else _add_splats(scene, "/background", background)
        ground = model.file.ground
        if background is None and ground is not None:
            place = np.asarray(ground.normal) * ground.offset_m
            side = 20 * size
            scene.add_grid("/ground", side, side, cell_size=size, wxyz=_turn_from_z(ground.normal), position=place)
        self._frames = [
            scene.add_frame(f"/bodies/{k}", show_axes=False, axes_length=1.5 * size, axes_radius=0.04 * size)
            for k in range(len(self._shapes))
        ]
        self._splats = [
            None if shape.splats is None else _add_splats(scene, f"/bodies/{k}/splats", shape.splats)
            for k, shape in enumerate(self._shapes)
        ]
        self._spheres = [_add_spheres(scene, f"/bodies/{k}/spheres", shape) for k, shape in enumerate(self._shapes)]
        self._cameras: dict[str, Any] = {}
        self._marks: list[Any] = []

    def _begin(self, motion: Motion) -> None:
        """Put what belongs to a motion, and not to a moment of it, into the scene."""
        with self._lock, self.server.atomic():
            self._motion = motion
            for handle in [*self._cameras.values(), *self._marks]:
                handle.remove()
            size = self._size_m
            self._cameras = {
                name: _add_camera(self.server.scene, name, camera, 0.6 * size)
                for name, camera in motion.cameras.items()
            }
            most = max((len(rows["mode"]) for rows in motion.contacts), default=0)
            self._marks = _add_marks(self.server.scene, most, size) if most else []
            self._show_kinds()
            last = max(1, len(motion.times_s) - 1)
            alone = len(motion.times_s) == 1
            self._frame.max, self._frame.disabled, self._play.disabled = last, alone, alone
            self._arrow_note.content = _legend(motion.largest_impulse_n_s)
            if self._frame.value != 0:
                self._frame.value = 0
            else:
                self._show(0)

    def _show(self, frame: int) -> None:
        with self._lock, self.server.atomic():
            frame = min(frame, len(self._motion.times_s) - 1)
            now = scene_at(self._motion, frame, self._size_m)
            for k, handle in enumerate(self._frames):
                handle.position, handle.wxyz = now.position_m[k], now.quat_wxyz[k]
                if self._splats[k] is not None and self._shapes[k].relit:
                    self._splats[k].rgbs = _bytes(self._shapes[k].colors_at(now.quat_wxyz[k]))
            _place_marks(self._marks, now.marks, self._contacts.value)
            if self._motion.image is not None and self._frusta.value:
                for name, handle in self._cameras.items():
                    handle.image = self._motion.image(name, frame)
            self._status.content = _words(now, frame, len(self._motion.times_s))

    # What can be pressed

    def _add_controls(self) -> None:
        gui = self.server.gui
        names = list(self._made)
        self._choice = gui.add_dropdown("motion", names, initial_value=names[0])
        self._frame = gui.add_slider("frame", min=0, max=1, step=1, initial_value=0)
        self._status = gui.add_markdown("")
        self._play = gui.add_button("Play", icon=None)
        self._playing = False
        self._speed = gui.add_dropdown("speed", list(SPEEDS), initial_value="3 times slower")
        seen = any(handle is not None for handle in self._splats)
        with gui.add_folder("Show"):
            self._contacts = gui.add_checkbox("contacts", True)
            self._looks = gui.add_checkbox("splats", seen, disabled=not seen and self._background is None)
            self._through = gui.add_checkbox("see-through bodies", False, disabled=not seen)
            self._colliding = gui.add_checkbox("collision spheres", not seen)
            self._axes = gui.add_checkbox("body frames", False)
            self._frusta = gui.add_checkbox("cameras", True)
        self._arrow_note = gui.add_html("")
        self._frame.on_update(lambda _: self._guarded(lambda: self._show(self._frame.value)))
        self._choice.on_update(lambda _: self._guarded(lambda: self._begin(self._load(self._choice.value))))
        self._play.on_click(lambda _: self._toggle())
        for box in (self._contacts, self._looks, self._colliding, self._axes, self._frusta):
            box.on_update(lambda _: self._guarded(self._refresh))
        self._through.on_update(lambda _: self._guarded(self._make_see_through))

    def _toggle(self) -> None:
        self._playing = not self._playing
        self._play.label = "Pause" if self._playing else "Play"

    def _refresh(self) -> None:
        with self._lock:
            self._show_kinds()
            self._show(self._frame.value)

    def _show_kinds(self) -> None:
        for handle in [*self._splats, self._background]:
            if handle is not None:
                handle.visible = self._looks.value
        for handle in self._spheres:
            if handle is not None:
                handle.visible = self._colliding.value
        for handle in self._frames:
            handle.show_axes = self._axes.value
        for handle in self._cameras.values():
            handle.visible = self._frusta.value

    def _make_see_through(self) -> None:
        share = _SEE_THROUGH if self._through.value else 1.0
        with self._lock:
            for handle, shape in zip(self._splats, self._shapes, strict=True):
                if handle is not None and shape.splats is not None:
                    handle.opacities = _bytes(share * np.asarray(shape.splats.opacities)[:, None])

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do what a click asks for; what it raises stands on the page, and the server goes on."""
        try:
            work()
        except CgwmError as error:
            self._status.content = f"**{error.found}**"
        except OSError as error:
            self._status.content = f"**Cannot be read: {error}**"


def _free_port(host: str, port: int) -> int:
    """Return a port that is free at an address; viser would silently take another one than was asked for."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise UsageError(
                f"{host}, port {port}: {reason}.", todo="choose another one: --port 0 takes any that is free."
            ) from None
        return int(trial.getsockname()[1])


def _add_splats(scene: Any, name: str, splats: Splats) -> Any:
    sigma = np.asarray(splats.scales, np.float64)
    unit = _LARGEST_HALF_SIGMA / float(sigma.max(initial=1e-9))
    return scene.add_gaussian_splats(
        name,
        centers=np.asarray(splats.means, np.float64) * unit,
        covariances=np.eye(3)[None] * (sigma * unit)[:, None, None] ** 2,
        rgbs=_bytes(np.asarray(splats.colors)),
        opacities=_bytes(np.asarray(splats.opacities)[:, None]),
        scale=1 / unit,
    )


def _add_spheres(scene: Any, name: str, shape: BodyShape) -> Any:
    if not len(shape.radii_m):
        return None
    return _add_balls(scene, name, shape.centers_m, shape.radii_m, np.array(_SPHERE_RGB, np.uint8))


def _add_balls(scene: Any, name: str, centers_m: NDArray[Any], radii_m: NDArray[Any], colors: NDArray[np.uint8]) -> Any:
    import trimesh  # comes with viser  # pyright: ignore[reportMissingImports]

    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    return scene.add_batched_meshes_simple(
        name,
        vertices=np.asarray(ball.vertices, np.float32),
        faces=np.asarray(ball.faces, np.uint32),
        batched_wxyzs=np.tile(np.array([1.0, 0, 0, 0]), (len(radii_m), 1)),
        batched_positions=centers_m,
        batched_scales=radii_m,
        batched_colors=colors,
        lod="off",
    )


def _add_camera(scene: Any, name: str, camera: Camera, scale_m: float) -> Any:
    pose = camera.T_world_cam
    return scene.add_camera_frustum(
        f"/cameras/{name}",
        fov=2 * math.atan(0.5 * camera.height / float(camera.K[1, 1])),
        aspect=camera.width / camera.height,
        scale=scale_m,
        thickness=0.03 * scale_m,
        color=(40, 44, 52),
        format="jpeg",
        jpeg_quality=85,
        wxyz=_quat_of(pose[:3, :3]),
        position=pose[:3, 3],
    )


def _add_marks(scene: Any, count: int, size_m: float) -> list[Any]:
    """Add as many points and arrows as a motion has contacts at once: of equal number, they move without flicker."""
    nowhere, colors = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.uint8)
    points = _add_balls(scene, "/contacts/points", nowhere, np.full(count, _POINT_RADIUS * size_m), colors)
    arrows = scene.add_arrows(
        "/contacts/impulses",
        np.stack([nowhere, nowhere], axis=1),
        colors,
        shaft_radius=0.04 * size_m,
        head_radius=0.1 * size_m,
        head_length=0.25 * size_m,
    )
    return [points, arrows]


def _place_marks(handles: list[Any], marks: ContactMarks, wanted: bool) -> None:
    for handle in handles:
        handle.visible = wanted and len(marks) > 0
    if not handles or not len(marks):
        return
    points, arrows = handles
    # The last contact stands in for those that are not there.
    chosen = np.minimum(np.arange(len(arrows.points)), len(marks) - 1)
    points.batched_positions, points.batched_colors = marks.points_m[chosen].astype(np.float32), marks.colors[chosen]
    arrows.points, arrows.colors = marks.segments_m[chosen].astype(np.float32), marks.colors[chosen]


def _words(now: SceneAt, frame: int, count: int) -> str:
    sliding = int(now.marks.sliding.sum())
    parts = [f"{len(now.marks) - sliding} sticking"] * (len(now.marks) > sliding) + [f"{sliding} sliding"] * (
        sliding > 0
    )
    contacts = f"contacts: {', '.join(parts)}; largest impulse {now.largest_impulse_n_s:.2g} N s" if parts else ""
    return f"**{now.time_s:.3f} s**, frame {frame + 1} of {count}\n\n{contacts or 'no contact'}"


def _legend(largest_n_s: float) -> str:
    dots = "".join(
        f'<div><span style="color: rgb{color}">&#9679;</span> contact, {word}</div>'
        for color, word in ((STICKING_RGB, "sticking"), (SLIDING_RGB, "sliding"))
    )
    longest = f", the longest {largest_n_s:.2g} N s" if largest_n_s > 0 else ""
    arrows = f"<div>&#8593; impulse on the body since the frame before{longest}</div>"
    return f'<div style="padding: 0 0.75em 0.5em; font-size: 0.8em; line-height: 1.6">{dots}{arrows}</div>'


def _bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    return (np.clip(values, 0.0, 1.0) * 255).round().astype(np.uint8)


def _quat_of(rotation: NDArray[Any]) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def _turn_from_z(normal: Any) -> NDArray[np.float64]:
    """Return the quaternion w x y z (4,) of the shortest turn that takes z to a unit normal (3,)."""
    x, y, z = normal
    if z < -1 + 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quat = np.array([1 + z, -y, x, 0.0])
    return quat / np.linalg.norm(quat)
