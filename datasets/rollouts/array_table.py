"""The arrays of a rollout, declared once: the writer, docs/datasets.md and `cgwm validate` all take them from here."""

from __future__ import annotations

from collections.abc import Mapping

from .array_entry import ArrayEntry

_EXPOSED = "What the model shows, 0 to 1, times this, plus offset_rgb, cut off at 0 and 1, is the image."
_CAMERAS = "cameras in the order of their names"
_STATE = "for each body: position, quaternion w x y z, velocity (world), angular velocity (body)"
_FLOAT = {"dtype": "f8"}
_XYZ = {"dtype": "f8", "order": "x y z"}
_PER_FRAME = {"axes": "(T, B, 3)", **_XYZ}
_PER_CONTACT = {"axes": "(N,)", "unit": "1"}
_PER_CAMERA = {"presence": "cameras"}
_JOINTS = {"presence": "joints"}
_PICTURE = {"axes": "(T, H, W)", "frame": "image of camera {camera}", "order": "row, column", **_PER_CAMERA}
_PIXELS = {"axes": "(T, camera, body)", "unit": "px", "frame": "image", "dtype": "i4", "low": "0", **_PER_CAMERA}
_RGB = {"axes": "(3,)", "unit": "1", "order": "RGB", **_FLOAT, **_PER_CAMERA}


def _entry(name: str, text: str, *parts: Mapping[str, object], **more: object) -> ArrayEntry:
    values: dict[str, object] = {}
    for part in (*parts, more):
        values |= part
    return ArrayEntry(name=name, text=text, **values)  # pyright: ignore[reportArgumentType]


_TIMELINE = (
    _entry("time", "Time since the rollout's start.", _FLOAT, axes="(T,)", unit="s", note="Frame t is at t / rate."),
    _entry(
        "states",
        "MuJoCo's state of the attribute model_file (free bodies, joints; velocities linear world, angular body).",
        _FLOAT,
        axes="(T, D)",
        unit="SI",
        frame="world",
        order="time, qpos, qvel; quaternions w x y z",
    ),
    _entry(
        "actions",
        "{action_meaning}",
        _FLOAT,
        axes="(T, A)",
        unit="1",
        frame="world",
        order="x y z a driven body",
        low="-1",
        high="1",
        note="Velocity commands of driven bodies, divided by the plan's largest push speed; 0 if no body is driven.",
    ),
    _entry("rewards", "No task is defined: zero.", _FLOAT, axes="(T,)", unit="1", low="0", high="0"),
    _entry("dones", "1 at the last frame.", axes="(T,)", dtype="u1", unit="1", low="0", high="1"),
)
_BODIES = (
    _entry("bodies/names", "Body k has the value k + 1 in the masks.", axes="(B,)", dtype="S", note="k from 0."),
    _entry(
        "bodies/motions",
        "free, driven (its track is a command), fixed, or link of a jointed body.",
        axes="(B,)",
        dtype="S",
        words=("free", "driven", "fixed", "link"),
    ),
    _entry(
        "bodies/materials",
        "Material, by which pairs have their contact laws; empty: none.",
        axes="(B,)",
        dtype="S",
        presence="optional",
    ),
    _entry("bodies/pos", "Origin of the body frame.", _PER_FRAME, unit="m", frame="world"),
    _entry(
        "bodies/quat_wxyz",
        "Rotation of T_world_body.",
        _FLOAT,
        axes="(T, B, 4)",
        unit="1",
        frame="world",
        order="w x y z",
        unit_norm=True,
    ),
    _entry("bodies/vel", "Velocity of the body origin.", _PER_FRAME, unit="m/s", frame="world"),
    _entry("bodies/omega_body", "Angular velocity.", _PER_FRAME, unit="rad/s", frame="body"),
    _entry(
        "bodies/contact_force",
        "Mean force of all contacts on the body since the frame before; 0 at frame 0.",
        _PER_FRAME,
        unit="N",
        frame="world",
    ),
    _entry(
        "bodies/contact_torque",
        "Mean torque on free bodies about the centre of mass since the frame before, from the angular momentum "
        "({turning}); 0 at frame 0 and for other bodies.",
        _PER_FRAME,
        unit="N m",
        frame="world",
    ),
    _entry("bodies/mass", "Mass in this rollout.", _FLOAT, axes="(B,)", unit="kg", low="0", note="Effects included."),
    _entry("bodies/com", "Centre of mass in the body frame.", _XYZ, axes="(B, 3)", unit="m", frame="body"),
    _entry(
        "bodies/inertia",
        "About the centre of mass, body axes.",
        _FLOAT,
        axes="(B, 6)",
        unit="kg m2",
        frame="body",
        order="xx yy zz xy xz yz",
    ),
    _entry(
        "bodies/gravity",
        "Gravitational acceleration.",
        _XYZ,
        axes="(3,)",
        unit="m/s2",
        frame="world",
        note="Effects included.",
    ),
    _entry("bodies/visible_px", f"Pixels of the body in the mask; {_CAMERAS}.", _PIXELS),
    _entry("bodies/amodal_px", f"Pixels of the body in the image, hidden ones too; {_CAMERAS}.", _PIXELS),
    _entry(
        "bodies/visible_fraction",
        f"visible_px over amodal_px: how much of what is in the image is not hidden, 0 where nothing is; {_CAMERAS}.",
        _PIXELS,
        _FLOAT,
        unit="1",
        high="1",
    ),
)
_JOINT_ARRAYS = (
    _entry("joints/names", "Joints that move, of all jointed bodies.", _JOINTS, axes="(J,)", dtype="S"),
    _entry("joints/links", "Body that the joint carries.", _JOINTS, axes="(J,)", dtype="S"),
    _entry(
        "joints/kinds",
        "hinge (values in rad) or slide (in m).",
        _JOINTS,
        axes="(J,)",
        dtype="S",
        words=("hinge", "slide"),
    ),
    _entry(
        "joints/pos",
        "Value of the joint.",
        _JOINTS,
        _FLOAT,
        axes="(T, J)",
        unit="rad, m",
        frame="joint",
        order="joints",
    ),
    _entry(
        "joints/vel",
        "Its rate.",
        _JOINTS,
        _FLOAT,
        axes="(T, J)",
        unit="rad/s, m/s",
        frame="joint",
        order="joints",
    ),
)
_CONTACTS = (
    _entry(
        "contacts/offsets",
        "Rows offsets[t]:offsets[t + 1] of the other arrays belong to frame t.",
        axes="(T + 1,)",
        dtype="i8",
        unit="1",
        low="0",
        high="N",
    ),
    _entry("contacts/body_a", "Index into bodies/names.", _PER_CONTACT, dtype="i4", low="0", high="B - 1"),
    _entry(
        "contacts/body_b",
        "Index into bodies/names; -1 = the ground, -2 and below = the fixed surfaces of the model, in their order.",
        _PER_CONTACT,
        dtype="i4",
        low="-1024",
        high="B - 1",
    ),
    _entry(
        "contacts/pos_world",
        "Contact point.",
        _XYZ,
        axes="(N, 3)",
        unit="m",
        frame="world",
        note="Mean since the frame before.",
    ),
    _entry(
        "contacts/normal_world",
        "Unit normal from b to a.",
        _XYZ,
        axes="(N, 3)",
        unit="1",
        frame="world",
        unit_norm=True,
    ),
    _entry("contacts/distance", "Signed distance; negative = penetration.", _PER_CONTACT, _FLOAT, unit="m"),
    _entry(
        "contacts/impulse_world",
        "Impulse on body a since the frame before (frame 0: zero); body b gets its opposite.",
        _XYZ,
        axes="(N, 3)",
        unit="N s",
        frame="world",
    ),
    _entry(
        "contacts/force_world",
        "Mean force on body a since the frame before (frame 0: zero): the impulse over the time between the frames.",
        _XYZ,
        axes="(N, 3)",
        unit="N",
        frame="world",
    ),
    _entry(
        "contacts/mode",
        "0 = sticking, 1 = sliding (friction at its limit).",
        _PER_CONTACT,
        dtype="u1",
        low="0",
        high="1",
    ),
)
_PARAMETERS = (
    _entry(
        "parameters/{parameter}",
        "Value used in this rollout.",
        _FLOAT,
        axes="scalar",
        unit="{unit}",
        note="Attributes `estimate` and `std_error` of the fit.",
    ),
)
_CAMERA = (
    _entry(
        "cameras/{camera}/K",
        "Intrinsics; top-left pixel centre (0.5, 0.5).",
        _FLOAT,
        _PER_CAMERA,
        axes="(3, 3)",
        unit="px",
        frame="image",
        order="row",
    ),
    _entry(
        "cameras/{camera}/dist",
        "OpenCV distortion; empty: none.",
        _FLOAT,
        _PER_CAMERA,
        axes="(k,)",
        unit="1",
        order="k1 k2 p1 p2 k3",
    ),
    _entry(
        "cameras/{camera}/T_world_cam",
        "Camera to world; OpenCV axes (x right, y down, z forward).",
        _FLOAT,
        _PER_CAMERA,
        axes="(4, 4)",
        unit="m",
        frame="world",
        order="row",
    ),
    _entry("cameras/{camera}/width", "Image width.", _PER_CAMERA, axes="scalar", dtype="i8", unit="px", low="1"),
    _entry("cameras/{camera}/height", "Image height.", _PER_CAMERA, axes="scalar", dtype="i8", unit="px", low="1"),
    _entry("cameras/{camera}/gain_rgb", f"Exposure and light. {_EXPOSED}", _RGB),
    _entry("cameras/{camera}/offset_rgb", "Exposure: see gain_rgb.", _RGB),
)
_LIGHT = (
    _entry("light/gain_rgb", "Brightness relative to the photos; in the cameras' gain.", _RGB),
    _entry(
        "light/lamp",
        "Direction to the lamp times its brightness relative to the room's mean; shades the moving bodies.",
        _XYZ,
        axes="(3,)",
        unit="1",
        frame="world",
        presence="optional",
    ),
    _entry(
        "light/sky",
        "Brightness from above against the side.",
        _FLOAT,
        axes="scalar",
        unit="1",
        frame="world",
        low="-1",
        high="1",
        presence="optional",
    ),
)
_OBSERVATIONS = (
    _entry(
        "obs/object",
        "State of all bodies, robomimic's low-dim key.",
        _FLOAT,
        axes="(T, 13 B)",
        unit="SI",
        frame="world",
        order=_STATE,
    ),
    _entry(
        "obs/{camera}_image",
        "Rendered colour, 0 to 255.",
        _PICTURE,
        axes="(T, H, W, 3)",
        dtype="u1",
        unit="1",
        order="row, column, RGB",
        note="sRGB.",
    ),
    _entry(
        "obs/{camera}_depth",
        "Depth along the optical axis of what the mask names; 0 = no surface.",
        _PICTURE,
        dtype="f4",
        unit="m",
        low="0",
    ),
    _entry(
        "obs/{camera}_mask",
        "Visible instance: 0 = background, k = the k-th body.",
        _PICTURE,
        dtype="u1",
        unit="1",
        low="0",
        high="B",
    ),
    _entry(
        "obs/{camera}_amodal",
        "Amodal masks as bits: (pixel >> (k - 1)) & 1 is 1 where the k-th body would be seen if it were alone, hidden "
        "or not.",
        _PICTURE,
        dtype="u1 u2 u4 u8",
        unit="1",
        order="row, column; bit k - 1 of a pixel belongs to the k-th body",
        low="0",
        high="2^B - 1",
    ),
)
JPEG = _entry(
    "obs/{camera}_image",
    "Rendered colour, lossy: decode each row with any JPEG reader (cv2.imdecode), to height x width, RGB.",
    _PICTURE,
    axes="(T, longest)",
    dtype="u1",
    unit="1",
    order="bytes of a JPEG file, filled up with zeros",
    note='With `compression = "jpeg"`.',
)
"""The colour images of a dataset that is compressed with jpeg, in the place of the entry of the same name."""

ARRAYS: dict[str, ArrayEntry] = {
    entry.name: entry
    for part in (_TIMELINE, _BODIES, _JOINT_ARRAYS, _CONTACTS, _PARAMETERS, _CAMERA, _LIGHT, _OBSERVATIONS)
    for entry in part
}
"""The arrays of a rollout, by name."""


def names_in(group: str) -> list[str]:
    """Return the names of the documented arrays of a group, without the group."""
    return [entry.name.rpartition("/")[2] for entry in ARRAYS.values() if entry.group == group]


def turning(effects: Mapping[str, object] | None) -> str:
    """Return what turns a body, besides its inertia, in the words of `bodies/contact_torque`."""
    names = ", ".join(effects or ())
    return f"contacts, and what the effects {names} add" if names else "contacts alone turn them"


def table_rows() -> list[str]:
    """Return the table of docs/datasets.md, a line each."""
    rows = ["| where | shape, type | unit, frame | values | what |", "| --- | --- | --- | --- | --- |"]
    entries = [entry for name, entry in ARRAYS.items() for entry in ([entry, JPEG] if name == JPEG.name else [entry])]
    return rows + [f"| {' | '.join(_cells(entry))} |" for entry in entries]


def _fixed(text: str, other: str) -> str:
    """Return a unit or a frame, the other text where it depends on the array, and nothing for "-"."""
    return other if "{" in text else {"-": ""}.get(text, text)


def _cells(entry: ArrayEntry) -> tuple[str, ...]:
    """Return the cells of an array's row: place, shape and type, unit and frame, values, and what it is."""
    place = entry.name.replace("{", "<").replace("}", ">")
    what = " ".join(text for text in (entry.text, entry.note) if text and not text.startswith("{"))
    shape = f"{entry.axes} {' or '.join(entry.dtype.split())}"
    units = ", ".join(filter(None, (_fixed(entry.unit, "varies"), _fixed(entry.frame, "image")))) or "-"
    return f"`{place}`", shape, units, entry.values_text or "-", what.replace(" ({turning})", "")
