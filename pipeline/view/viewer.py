"""The page of the viewer: scene, controls and playback. Only the folder `view` uses viser."""

from __future__ import annotations

import contextlib
import io
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

import numpy as np

from ...datasets.models.model import Model
from ...datasets.shapes.turns import quat_of_normal
from ...schemas import CgwmError, NotConvergedError, UsageError
from ..rendering.contact_glyphs import SLIDING_RGB, STICKING_RGB
from .door import Door, guarded, require_closed
from .motions import Motion
from .scene_at import SceneAt, background_from, radius_m, scene_at, shapes_of, viewpoint
from .scene_nodes import (
    add_camera,
    add_joint,
    add_marks,
    add_spheres,
    add_splats,
    add_surface,
    as_bytes,
    place_marks,
    vertical_angle_rad,
)

SPEEDS = {"as it was": 1.0, "3 times slower": 1 / 3, "10 times slower": 0.1}
_MOST_UPDATES_HZ = 30.0
FOLLOW_S = 0.5
"""Time between two looks at motions that go on [s]."""
_SEE_THROUGH = 0.12
"""Factor on the opacities of see-through bodies; it is small because several spheres lie behind each other."""
_OVERVIEW = "overview"
FIELD_OF_VIEW_RAD = 0.9
"""Vertical angle of view of the overview [rad]."""
_AMBIENT, _SUN = 2.2, 1.0
"""Light intensities that approximately preserve the colours of meshes; viser's defaults make them paler."""


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
        title: Title of the page.
        model: Model with bodies, background, ground and light.
        motions: Functions that make the motions, by name; the first that can be made is shown, the others are
            called when first chosen.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        playing: Play from the beginning.
        follow: Returns the motions that are new or longer than at its last call, the present one first: what is shown
            goes on to its end, and waits there for more.

    Raises:
        UsageError: If viser is not installed, or the address is not available.
        CgwmError: If no motion can be made.
    """

    def __init__(
        self,
        title: str,
        model: Model,
        motions: Mapping[str, Callable[[], Motion]],
        host: str,
        port: int,
        playing: bool = False,
        follow: Callable[[], Mapping[str, Callable[[], Motion]]] | None = None,
    ) -> None:
        viser = require_viser()
        port = _free_port(host, port)
        self._made, self._follow = dict(motions), follow
        self._kept: dict[str, Motion] = {}
        self._lock = threading.RLock()
        self._shapes = shapes_of(model)
        self._size_m = radius_m(model, self._shapes)
        self._first, self._motion = self._first_motion()
        self._present = self._first
        self._playing = playing and len(self._motion.times_s) > 1
        door = Door(host)
        with contextlib.redirect_stdout(io.StringIO()), guarded(door, host):  # its banner is not shown
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        try:
            require_closed(host, self.server.get_port())
        except BaseException:
            self.__exit__(None, None, None)
            raise
        place = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.url = f"http://{place}:{self.server.get_port()}/{door.secret}/"
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
        """Play while playback is on; ends only by an exception, such as KeyboardInterrupt."""
        looked_s = time.monotonic()
        while True:
            if self._follow is not None and time.monotonic() - looked_s > FOLLOW_S:
                self.follow()
                looked_s = time.monotonic()
            times_s = self._motion.times_s
            pace = SPEEDS[self._speed.value]
            step_s = float(times_s[-1] - times_s[0]) / max(1, len(times_s) - 1) / pace
            stride = max(1, math.ceil(1 / (_MOST_UPDATES_HZ * step_s))) if step_s > 0 else 1
            time.sleep(max(step_s * stride, 1 / _MOST_UPDATES_HZ))
            if self._playing and len(times_s) > 1:
                after = self._frame.value + stride
                # shows it, too; what goes on is not begun again at its end
                self._frame.value = after % len(times_s) if self._follow is None else min(after, len(times_s) - 1)

    def follow(self) -> None:
        """Take what has been added to the motions; the time that is shown stays."""
        added = {} if self._follow is None else dict(self._follow())
        if not added:
            return
        with self._lock:
            chosen, known, before = self._choice.value, list(self._made), self._present
            self._made |= added
            self._present = next(iter(added))
            for name in added:
                self._kept.pop(name, None)
            if list(self._made) != known:
                self._choice.options = list(self._made)
            if chosen == before != self._present:
                self._choice.value = self._present  # shows it, too
            elif chosen in added:
                shown_s = self._motion.times_s[min(self._frame.value, len(self._motion.times_s) - 1)]
                times_s = self._load(chosen).times_s
                self._begin(self._load(chosen), min(int(np.searchsorted(times_s, shown_s - 1e-9)), len(times_s) - 1))

    def _first_motion(self) -> tuple[str, Motion]:
        """Return the first motion that can be made, with its name: a simulation may diverge."""
        *others, last = self._made
        for name in others:
            with contextlib.suppress(NotConvergedError):
                return name, self._load(name)
        return last, self._load(last)

    def _load(self, name: str) -> Motion:
        if name not in self._kept:
            self._kept[name] = self._made[name]()
        return self._kept[name]

    # Scene

    def _add_scene(self, model: Model) -> None:
        scene, size = self.server.scene, self._size_m
        eye, target, up = viewpoint(model, self._motion, size)
        scene.set_up_direction(tuple(up))
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light/ambient", intensity=_AMBIENT)
        scene.add_light_directional("/light/sun", intensity=_SUN, position=tuple(eye + 20 * size * up))
        self._view = (eye, target, up)
        camera = self.server.initial_camera
        camera.position, camera.look_at, camera.up = self._view
        camera.fov = FIELD_OF_VIEW_RAD
        background = background_from(model, eye)
        self._background = None if background is None else add_splats(scene, "/background", background)
        ground = model.file.ground
        if background is None and ground is not None:
            place = np.asarray(ground.normal) * ground.offset_m
            side = 20 * size
            scene.add_grid(
                "/ground", side, side, cell_size=size, wxyz=quat_of_normal(np.asarray(ground.normal)), position=place
            )
        self._surfaces = [
            add_surface(scene, one, model.surface_meshes.get(one.name), size) for one in model.file.surfaces
        ]
        self._frames = [
            scene.add_frame(f"/bodies/{k}", show_axes=False, axes_length=1.5 * size, axes_radius=0.04 * size)
            for k in range(len(self._shapes))
        ]
        self._splats = [
            None if shape.splats is None else add_splats(scene, f"/bodies/{k}/splats", shape.splats)
            for k, shape in enumerate(self._shapes)
        ]
        self._spheres = [add_spheres(scene, f"/bodies/{k}/spheres", shape) for k, shape in enumerate(self._shapes)]
        bodies = [body.name for body in model.file.bodies]
        moving = [joint for one in model.file.articulations for joint in one.joints if joint.kind != "fixed"]
        self._kinds = {joint.name: joint.kind for joint in moving}
        self._joints = [add_joint(scene, f"/bodies/{bodies.index(joint.link)}/joint", joint, size) for joint in moving]
        self._cameras: dict[str, Any] = {}
        self._marks: list[Any] = []

    def _begin(self, motion: Motion, frame: int = 0) -> None:
        """Add what belongs to a motion as a whole (cameras, number of marks, controls), and show one of its frames."""
        with self._lock, self.server.atomic():
            self._motion = motion
            for handle in [*self._cameras.values(), *self._marks]:
                handle.remove()
            size = self._size_m
            self._cameras = {
                name: add_camera(self.server.scene, name, camera, 0.6 * size) for name, camera in motion.cameras.items()
            }
            most = max((len(rows["mode"]) for rows in motion.contacts), default=0)
            self._marks = add_marks(self.server.scene, most, size) if most else []
            self._show_kinds()
            last = max(1, len(motion.times_s) - 1)
            alone = len(motion.times_s) == 1
            self._frame.max, self._frame.disabled, self._play.disabled = last, alone, alone
            self._contacts.visible = self._arrow_note.visible = motion.contacts_known
            self._arrow_note.content = _legend(motion.largest_impulse_n_s)
            if self._frame.value != frame:
                self._frame.value = frame
            else:
                self._show(frame)

    def _show(self, frame: int) -> None:
        with self._lock, self.server.atomic():
            frame = min(frame, len(self._motion.times_s) - 1)
            now = scene_at(self._motion, frame, self._size_m)
            parts = zip(self._frames, self._splats, self._shapes, now.position_m, now.quat_wxyz, strict=True)
            for handle, splats, shape, position_m, quat_wxyz in parts:
                handle.position, handle.wxyz = position_m, quat_wxyz
                if splats is not None and shape.relit:
                    splats.rgbs = as_bytes(shape.colors_at(quat_wxyz))
            place_marks(self._marks, now.marks, self._contacts.value)
            if self._motion.image is not None and self._frusta.value:
                for name, handle in self._cameras.items():
                    handle.image = self._motion.image(name, frame)
            self._status.content = _words(now, frame, self._motion, self._kinds)

    # Controls

    def _add_controls(self) -> None:
        gui = self.server.gui
        names = list(self._made)
        self._choice = gui.add_dropdown("motion", names, initial_value=self._first)
        self._frame = gui.add_slider("frame", min=0, max=1, step=1, initial_value=0)
        self._status = gui.add_markdown("")
        self._play = gui.add_button("Pause" if self._playing else "Play", icon=None)
        aside = gui.add_panel()  # folded on narrow screens, which the controls would half cover
        gui.main_panel.dock_right()
        aside.dock_below(gui.main_panel)
        with aside.add_tab("Show"):
            pace = list(SPEEDS)[1 if self._follow is None else 0]
            self._speed = gui.add_dropdown("speed", list(SPEEDS), initial_value=pace)
            places = gui.add_button_group("look from", [_OVERVIEW, *self._motion.cameras])
            places.on_click(lambda event: self._guarded(lambda: self._look_from(event.client, places.value)))
            seen = any(handle is not None for handle in self._splats)
            self._contacts = gui.add_checkbox("contacts", True)
            looks = seen or not self._shapes  # without bodies, the background is all that there is
            self._looks = gui.add_checkbox("splats", looks, disabled=not seen and self._background is None)
            self._through = gui.add_checkbox("see-through bodies", False, disabled=not seen)
            self._colliding = gui.add_checkbox("collision spheres", not seen)
            self._axes = gui.add_checkbox("body frames", False)
            self._frusta = gui.add_checkbox("cameras", True)
            self._jointed = gui.add_checkbox("joints", True, visible=bool(self._joints))
            self._arrow_note = gui.add_html("")
        self._frame.on_update(lambda _: self._guarded(lambda: self._show(self._frame.value)))
        self._choice.on_update(lambda _: self._guarded(lambda: self._begin(self._load(self._choice.value))))
        self._play.on_click(lambda _: self._toggle())
        for box in (self._contacts, self._looks, self._colliding, self._axes, self._frusta, self._jointed):
            box.on_update(lambda _: self._guarded(self._refresh))
        self._through.on_update(lambda _: self._guarded(self._make_see_through))

    def _look_from(self, client: Any, place: str) -> None:
        """Move the view of one page to the overview or to a camera.

        Frusta are hidden at a camera, because its picture would hide the scene.
        """
        camera = self._motion.cameras.get(place)
        if client is None:
            return
        with client.atomic():
            if camera is None:
                client.camera.position, client.camera.look_at, client.camera.up_direction = self._view
                client.camera.fov = FIELD_OF_VIEW_RAD
                return
            forward = camera.T_world_cam[:3, 2]
            distance = float((self._view[1] - camera.center) @ forward)
            client.camera.position, client.camera.up_direction = camera.center, -camera.T_world_cam[:3, 1]
            client.camera.look_at = camera.center + max(distance, self._size_m) * forward
            client.camera.fov = vertical_angle_rad(camera)
        self._frusta.value = False

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
        for handle in self._joints:
            handle.visible = self._jointed.value

    def _make_see_through(self) -> None:
        share = _SEE_THROUGH if self._through.value else 1.0
        with self._lock:
            for handle, shape in zip(self._splats, self._shapes, strict=True):
                if handle is not None and shape.splats is not None:
                    handle.opacities = as_bytes(share * np.asarray(shape.splats.opacities)[:, None])

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do what a click asks for; show its errors on the page and keep the server running."""
        try:
            work()
        except CgwmError as error:
            self._status.content = f"**{error.found}**"
        except OSError as error:
            self._status.content = f"**Cannot be read: {error}**"


def _free_port(host: str, port: int) -> int:
    """Return the port if it is free, or a free one for 0; viser itself would silently take another port.

    Raises:
        UsageError: If the port is not available.
    """
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


def _words(now: SceneAt, frame: int, motion: Motion, kinds: Mapping[str, str]) -> str:
    sliding = int(now.marks.sliding.sum())
    parts = [f"{len(now.marks) - sliding} sticking"] * (len(now.marks) > sliding) + [f"{sliding} sliding"] * (
        sliding > 0
    )
    contacts = f"contacts: {', '.join(parts)}; largest impulse {now.largest_impulse_n_s:.2g} N s" if parts else ""
    values = [_joint_words(name, value, kinds.get(name, "hinge")) for name, value in now.joints.items()]
    joints = f"\n\njoints: {', '.join(values)}" if values else ""
    without = "no contact" if motion.contacts_known else "contacts were not recorded"
    count = len(motion.times_s)
    return f"**{now.time_s:.3f} s**, frame {frame + 1} of {count}\n\n{contacts or without}{joints}"


def _joint_words(name: str, value: float, kind: str) -> str:
    return f"{name} {math.degrees(value):.1f} deg" if kind == "hinge" else f"{name} {1e3 * value:.1f} mm"


def _legend(largest_n_s: float) -> str:
    dots = "".join(
        f'<div><span style="color: rgb{color}">&#9679;</span> contact, {word}</div>'
        for color, word in ((STICKING_RGB, "sticking"), (SLIDING_RGB, "sliding"))
    )
    longest = f", the longest {largest_n_s:.2g} N s" if largest_n_s > 0 else ""
    arrows = f"<div>&#8593; impulse on the body since the frame before{longest}</div>"
    return f'<div style="padding: 0 0.75em 0.5em; font-size: 0.8em; line-height: 1.6">{dots}{arrows}</div>'
