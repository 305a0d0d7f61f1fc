"""A fitted world model on disk: `model.json` and `fit.json`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from .articulations import ArticulationModel, require_links
from .base import FileModel
from .capture import Ground, Name, Pose, Shape, physical_inertia
from .described import NotDescribed
from .materials import pair_of, repeated
from .quantities import (
    ContactTime,
    DampingRatio,
    Deviation,
    FaceExponent,
    FacePoints,
    Friction,
    Gravity,
    Mass,
    Position3,
    RadiusFactor,
    Step,
    Vector3,
    unit_vector,
)
from .surfaces import Surface

MODEL_FORMAT = "cgwm-model/1"


Colour = Annotated[float, Field(ge=-1e6, le=1e6)]


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[1] < value[0]:
        raise ValueError(f"a range is [low, high]; found {list(value)}")
    return value


NonNegative = Annotated[float, Field(ge=0, le=1e30)]
Value = Annotated[float, Field(ge=-1e30, le=1e30)]
Interval = Annotated[tuple[Value, Value], AfterValidator(_ordered)]
Brightness = Annotated[float, Field(ge=0, le=1)]
Colour3 = tuple[Colour, Colour, Colour]
ROUNDING = 1e-6
"""Largest relative difference of numbers that are the same but for rounding."""


class FittedParameter(FileModel):
    """A fitted (or given) physical number."""

    name: str
    """For example `friction` or `cube.mass_kg`."""
    unit: str
    estimate: Value
    std_error: NonNegative | None = None
    """Standard error; none where the number was given or the data say nothing about it."""
    interval_95: Interval | None = None
    bounds: Interval | None = None
    prior: str | None = None
    state: Literal["fitted", "given", "on_bound", "not_observable", "derived"] = "fitted"
    note: str = ""
    """What it is confounded with, or the motion that would reveal it."""

    @model_validator(mode="after")
    def _within_bounds(self) -> FittedParameter:
        low, high = self.bounds or (self.estimate, self.estimate)
        rounding = ROUNDING * max(high - low, abs(low), abs(high))
        if not low - rounding <= self.estimate <= high + rounding:
            raise ValueError(
                f"parameter '{self.name}' is {self.estimate:g} {self.unit}, outside its bounds {low:g} to {high:g}"
            )
        return self


class Correlation(FileModel):
    """How the errors of parameters that were fitted together go together: with the standard errors, their posterior."""

    parameters: tuple[str, ...]
    """Names in `parameters`."""
    matrix: tuple[tuple[float, ...], ...]
    """Correlations of the fitted coordinates: logarithms of parameters whose bounds are positive, else values."""

    @model_validator(mode="after")
    def _square(self) -> Correlation:
        size = len(self.parameters)
        twice = repeated(self.parameters)
        if twice is not None:
            raise ValueError(f"the correlations name the parameter '{twice}' twice")
        if len(self.matrix) != size or any(len(row) != size for row in self.matrix):
            raise ValueError(f"the matrix of {size} parameters has {size} rows of {size} numbers")
        for i, row in enumerate(self.matrix):
            # of a parameter without any error the row is zero
            if min(abs(row[i] - 1), abs(row[i])) > ROUNDING:
                raise ValueError(f"the correlation of '{self.parameters[i]}' with itself is {row[i]:g}, not 1")
            for j, value in enumerate(row[:i]):
                self._require_correlation(i, j, value)
        return self

    def _require_correlation(self, i: int, j: int, value: float) -> None:
        """Refuse a correlation of two parameters that is none, or another one the other way around."""
        pair = f"the correlation of '{self.parameters[i]}' and '{self.parameters[j]}'"
        if abs(value) > 1 + ROUNDING:
            raise ValueError(f"{pair} is {value:g}; it lies between -1 and 1")
        if abs(value - self.matrix[j][i]) > ROUNDING:
            raise ValueError(f"{pair} is {value:g}, the other way around {self.matrix[j][i]:g}")


class HeldOutFall(FileModel):
    """How much better held-out episodes are predicted when parts are fitted, too."""

    parts: tuple[str, ...]
    """Names of the parts."""
    share: Value
    """Fall of the misfit, as a share of the misfit without them."""
    std_error: NonNegative
    """Its standard error, from the scatter between episodes."""


class FitChoice(FileModel):
    """What a fit to tracks estimates beside the contact, chosen by cross-validation inside the training split."""

    episodes: Annotated[int, Field(ge=2)]
    """Number of episodes of the cross-validation."""
    chosen: tuple[str, ...]
    """Parts that were chosen: centre_of_mass, second_moments, length_scale."""
    tested: tuple[HeldOutFall, ...]
    """Each set of parts that was compared."""
    sentence: str
    """The choice in words."""


class BodyModel(FileModel):
    """A body of the model. Files are names in the model's directory."""

    name: Name
    motion: Literal["free", "driven", "fixed", "link"]
    """link: of one of `articulations`."""
    mass_kg: Mass
    inertia_kg_m2: tuple[float, float, float, float, float, float]
    """xx yy zz xy xz yz about the centre of mass, body axes [kg m2]."""
    com_m: Position3
    """Centre of mass in the body frame [m]."""
    photo_pose: Pose = Pose()
    """T_world_body while the photos were taken."""
    shape: Shape | None = None
    """The shape that the capture gave, where it did."""
    splats: str | None = None
    """Visual spheres (PLY, body frame)."""
    collision: str | None = None
    """Colliding spheres (PLY, body frame); none: the visual ones collide."""
    collision_distance_m: Annotated[float, Field(ge=0, le=1e5)] | None = None
    """Largest distance between the colliding spheres' surface and the visual (or given) surface [m]."""
    material: Name | None = None
    """Material, by which its contacts with others have the laws of `pairs`; None for that of `contact`."""
    radius_factor: RadiusFactor = 2.0
    """Collision radius of a sphere in units of its Gaussian scale s."""
    convex: bool = False
    """Whether the body fills the convex hull of its colliding spheres; other bodies then touch that hull."""
    face_points: FacePoints = 0
    """Least number of points on each flat face by which the ground carries it as a plate; 0: by its corners alone."""
    face_exponent: FaceExponent = 0.0
    """Power of the distance from the middle of its face by which a point carries more [1]; 0: alike."""

    @field_validator("inertia_kg_m2")
    @classmethod
    def _physical(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        return physical_inertia(value)


class ContactParameters(FileModel):
    """The contact law's numbers; with the contact model `paper` those of a body on 16 rows, which fix K and D."""

    friction: Friction = 0.5
    """Coulomb coefficient [1]."""
    contact_time_s: ContactTime = 0.005
    """Natural contact time tau = sqrt(m_eff / K) [s]."""
    damping_ratio: DampingRatio = 0.3
    """zeta [1]; together with tau it fixes the restitution e(zeta)."""


class PairContact(ContactParameters):
    """The contact law's numbers of a pair of materials."""

    materials: tuple[Name, Name]
    """The two materials, in either order."""


class Solver(FileModel):
    """How the model is integrated."""

    contact_model: Literal["closed_form", "paper"] = "closed_form"
    """Law of contact: ours, or that of the ContactGaussian-WM paper with its distance between bodies."""
    step_s: Step = 0.001
    sweeps: Annotated[int, Field(ge=1, le=10_000)] = 10
    """Projected sweeps over the contacts; 1 is the closed form alone, more let contacts that touch at once agree."""


class EffectModel(FileModel):
    """An effect in the model, with the values of its parameters and constants."""

    name: str
    """A built-in effect, `effects/FILE.py:ClassName` for a file in the model's directory, or the name of an entry point
    of the group `cgwm.effects`; with `@group` or `@episode` behind it each session, or episode, has specific values."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """SHA-256 of the file; none for effects without one."""
    parameters: dict[str, Value] = {}
    """Where each unit has its own: the mean over units, which serves one that the fit has not seen."""
    own: dict[str, dict[str, Value]] = {}
    """By session or episode: its own values of parameters."""
    spread: dict[str, NonNegative] = {}
    """By parameter with own values: their standard deviation from unit to unit, of the prior that ties them."""


PositiveGain = Annotated[float, Field(gt=0, le=1000)]


class Exposure(FileModel):
    """Colour gain and offset of a camera against the model's colours: image = gain * model + offset."""

    gain_rgb: tuple[PositiveGain, PositiveGain, PositiveGain] = (1.0, 1.0, 1.0)
    offset_rgb: Colour3 = (0.0, 0.0, 0.0)
    duration_s: float = Field(default=0.0, ge=0)
    """How long a frame is exposed, about its time [s]; 0 is an instant, or too little motion to tell."""


class Light(FileModel):
    """The light that falls on bodies: the room's, brighter from above than from below, and one lamp far away.

    A white surface of unit normal n (world frame) has brightness 1 + sky n_z + max(0, lamp . n).
    """

    lamp: Colour3
    """Direction to the lamp, world frame, times its brightness relative to the room's mean [1]."""
    sky: float = Field(ge=-1, le=1)
    """How much brighter the room is from above than from its side, relative to its mean [1]."""


class GroundShadow(FileModel):
    """The shadow that bodies cast on the ground under one lamp far away."""

    to_lamp: Vector3
    """Unit vector to the lamp, world frame."""
    brightness_rgb: tuple[Brightness, Brightness, Brightness]
    """Brightness in the shadow over that outside, by colour channel [1]."""

    @field_validator("to_lamp")
    @classmethod
    def _unit(cls, value: Vector3) -> Vector3:
        return unit_vector(value, "the direction to the lamp")


class Viewpoint(FileModel):
    """A place to look from, world frame."""

    eye_m: Vector3
    target_m: Vector3
    """What is in the middle of the picture."""
    up: Vector3
    """Unit vector that points up in the picture."""

    @field_validator("up")
    @classmethod
    def _unit(cls, value: Vector3) -> Vector3:
        return unit_vector(value, "the direction up")


class Provenance(FileModel):
    """Where the model comes from."""

    capture: str
    input_sha256: dict[str, str] = {}
    versions: dict[str, str] = {}
    seed: int = 0
    parent: str | None = None
    """The model that this one started from, relative to the folder that this one lies in."""
    config: dict[str, Any] = {}


class ModelFile(FileModel):
    """`model.json`."""

    format: Literal["cgwm-model/1"] = MODEL_FORMAT
    gravity_m_s2: Gravity = (0.0, 0.0, -9.81)
    ground: Ground | None = None
    bodies: tuple[BodyModel, ...]
    articulations: tuple[ArticulationModel, ...] = ()
    """Jointed bodies, whose links are bodies."""
    surfaces: tuple[Surface, ...] = ()
    """Fixed surfaces besides the ground; height fields are stored as meshes."""
    contact: ContactParameters | None = None
    """None until the stage phys-geo has run; the law of all contacts that `pairs` does not have."""
    pairs: tuple[PairContact, ...] = ()
    """The laws of pairs of materials."""
    parameters: tuple[FittedParameter, ...] = ()
    correlations: tuple[Correlation, ...] = ()
    """Of parameters that were fitted together; between two of these blocks, none is known."""
    effects: tuple[EffectModel, ...] = ()
    solver: Solver = Solver()
    measurement_std: dict[str, Deviation] = {}
    """position_m and rotation_rad: the measurement noise, given or estimated."""
    choice: FitChoice | None = None
    """What the fit chose to estimate; None where its settings or data left nothing to choose."""
    not_described: NotDescribed | None = None
    """Why the model does not describe the motion that it was fitted to; None where it does."""
    scene: str | None = None
    """Background spheres (PLY, world frame), where there are any."""
    exposures: dict[str, Exposure] = {}
    """By video camera."""
    light: Light | None = None
    """Where the videos tell it; None leaves a body in the light of the photos, however it turns."""
    ground_shadow: GroundShadow | None = None
    """As found in the photos; None where none stands out."""
    first_view: Viewpoint | None = None
    """That of the photo in the middle of all; None without photos."""
    warnings: tuple[str, ...] = ()
    provenance: Provenance

    @property
    def tracked(self) -> list[str]:
        """Names of the bodies that physics moves: free ones, and links that joints or a free root move."""
        moved = {link for one in self.articulations for link in one.moving_links}
        return [body.name for body in self.bodies if body.motion == "free" or body.name in moved]

    @property
    def commanded(self) -> list[str]:
        """Names of the bodies whose tracks are commands: driven ones, and roots of driven articulations."""
        roots = {one.root for one in self.articulations if one.base == "driven"}
        return [body.name for body in self.bodies if body.motion == "driven" or body.name in roots]

    @field_validator("measurement_std")
    @classmethod
    def _known_measurements(cls, value: dict[str, float]) -> dict[str, float]:
        other = sorted(set(value) - {"position_m", "rotation_rad"})
        if other:
            raise ValueError(f"an unknown measurement '{other[0]}'; they are position_m and rotation_rad")
        return value

    @model_validator(mode="after")
    def _once(self) -> ModelFile:
        for what, names in (
            ("bodies have", (body.name for body in self.bodies)),
            ("bodies or surfaces have", (one.name for one in (*self.bodies, *self.surfaces))),
            ("articulations have", (one.name for one in self.articulations)),
            ("joints have", (joint.name for one in self.articulations for joint in one.joints)),
            ("parameters have", (parameter.name for parameter in self.parameters)),
            # one effect acts once, however its values are shared
            ("effects have", (effect.name.partition("@")[0] for effect in self.effects)),
            ("blocks of correlations have", (name for block in self.correlations for name in block.parameters)),
        ):
            twice = repeated(names)
            if twice is not None:
                raise ValueError(f"two {what} the name '{twice}'")
        again = repeated(" and ".join(f"'{name}'" for name in pair_of(*pair.materials)) for pair in self.pairs)
        if again is not None:
            raise ValueError(f"two pairs are of {again}; each pair of materials stands once, in either order")
        require_links(self.articulations, {body.name: body.motion for body in self.bodies})
        if self.pairs and self.contact is None:
            raise ValueError("pairs without contact: the law of all other contacts is missing")
        return self


class FitFile(FileModel):
    """`fit.json`: how the fit went, stage by stage."""

    format: Literal["cgwm-fit/1"] = "cgwm-fit/1"
    stages: dict[str, dict[str, Any]] = {}
    """Stage name to its record: loss by iteration, convergence, timings, held-out numbers."""
    warnings: tuple[str, ...] = ()
