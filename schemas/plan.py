"""A sampling plan, `plan.toml`: what the rollouts of a dataset are drawn from, and which of them are drawn again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, model_serializer, model_validator

from .base import FileModel, read_toml
from .field_texts import field_texts
from .toml_text import toml_key, toml_value

CUT_OFF = 3.0
"""A normal distribution is cut off at this many standard deviations, so that a plan has no outliers."""

Reach = Annotated[float, Field(ge=0, le=1e5)]
"""A distance that may be none [m]."""
Number = Annotated[float, Field(ge=-1e30, le=1e30)]
Range = tuple[Number, Number]
Angle = Annotated[float, Field(ge=-3600, le=3600)]
"""[deg]; ranges may pass any direction."""


class Distribution(FileModel):
    """What a number is drawn from. Short forms: a number is `fixed`, a list of two is `uniform`."""

    fixed: Number | None = None
    """Always this."""
    uniform: Range | None = None
    """From low to high, all alike."""
    log_uniform: Range | None = None
    """From low to high, above 0, all orders of magnitude alike."""
    normal: Range | None = None
    """Mean and standard deviation; cut off at three of them."""
    choice: Annotated[tuple[Number, ...], Field(min_length=1, max_length=100_000)] | None = None
    """One of these, all alike."""

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, value: Any) -> Any:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return {"fixed": value}
        if isinstance(value, list | tuple):
            if len(value) != 2:
                raise ValueError(f"a list is a range [low, high]; found {len(value)} values. Or {{ choice = [...] }}")
            return {"uniform": value}
        return value

    @model_validator(mode="after")
    def _one_kind(self) -> Distribution:
        kinds = list(type(self).model_fields)
        given = [name for name in kinds if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"takes one of {', '.join(kinds)}; found {' and '.join(given) or 'none'}")
        for name in ("uniform", "log_uniform"):
            limits = getattr(self, name)
            if limits is not None and limits[1] < limits[0]:
                raise ValueError(f"a range is [low, high]; found {list(limits)}")
        if self.log_uniform is not None and self.log_uniform[0] <= 0:
            raise ValueError(f"log_uniform lies above 0; found {list(self.log_uniform)}")
        if self.normal is not None and self.normal[1] < 0:
            raise ValueError(f"normal is [mean, standard deviation]; found {list(self.normal)}")
        return self

    @model_serializer
    def _as_written(self) -> Any:
        if self.fixed is not None:
            return self.fixed
        if self.uniform is not None:
            return list(self.uniform)
        return {name: value for name in type(self).model_fields if (value := getattr(self, name)) is not None}

    @property
    def support(self) -> Range:
        """The smallest and the largest value that can be drawn."""
        if self.fixed is not None:
            return self.fixed, self.fixed
        if self.normal is not None:
            mean, std = self.normal
            return mean - CUT_OFF * std, mean + CUT_OFF * std
        values = self.uniform or self.log_uniform or self.choice
        assert values is not None  # one kind is given
        return min(values), max(values)

    @property
    def varies(self) -> bool:
        """Whether two draws can differ."""
        low, high = self.support
        return high > low


class RejectionRules(FileModel):
    """Rollouts that are drawn again. A rule that is left out rejects nothing."""

    off_table_m: Annotated[float, Field(gt=0, le=1e8)] | None = None
    """A free body's middle gets farther than this from where the photos show it, measured along the ground [m]."""
    no_contact: bool = False
    """Nothing touches a free body; where a body is driven: no driven body touches a free one."""
    penetration_m: Annotated[float, Field(gt=0, le=1e8)] | None = None
    """A free body's spheres sink deeper than this into the ground or another body, at a frame [m]."""
    unrest_m_s: Annotated[float, Field(gt=0, le=1e8)] | None = None
    """A point of a free body's surface is faster than this at the end [m/s]."""
    unseen_share: Annotated[float, Field(ge=0, le=1)] | None = None
    """The middle of a free body is outside every camera's picture in more than this share of the frames."""
    attempts: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """Draws for one rollout, after which the plan is given up."""


class SamplingPlan(FileModel):
    """Distributions that rollouts are drawn from; what is left out follows from the bodies."""

    start: Literal["auto", "throw", "rest", "slide"] = "auto"
    """How free bodies begin: thrown through the air, resting as in the photos, or sliding on the ground. auto: at rest
    where a body is driven, else thrown."""
    orientation: Literal["any", "upright", "photo"] = "any"
    """Of thrown bodies: any rotation, as in the photos but turned about the vertical, or as in the photos."""
    height_m: Distribution | None = None
    """Gap between a thrown body's bounding sphere and the ground [m]; default 0.5 to 3 radii."""
    offset_m: Reach | None = None
    """Largest horizontal distance from the place in the photos [m]; default half a bounding radius, 0 at rest."""
    heading_deg: Distribution | None = None
    """Direction of the horizontal speed [deg], about the ground's normal, 0 = world x; default any."""
    horizontal_speed_m_s: Distribution | None = None
    """Initial horizontal speed of thrown and sliding bodies [m/s]; default up to that of a fall from three radii."""
    vertical_speed_m_s: Distribution | None = None
    """Initial vertical velocity of thrown bodies, positive upwards [m/s]; default minus to plus half of that."""
    spin_rad_s: Distribution | None = None
    """Initial angular speed, about a random axis, of sliding bodies about the vertical [rad/s]; default up to that
    speed divided by the radius."""

    push_speed_m_s: Distribution = Distribution(uniform=(0.1, 0.4))
    """Speed of a driven body along its path [m/s]."""
    push_heading_deg: Distribution | None = None
    """Its direction where it meets the object [deg], about the ground's normal, 0 = world x; default any."""
    push_curve_1_m: Distribution = Distribution(fixed=0.0)
    """Curvature of its path [1/m], level, positive to the left: 0 a straight line, 2 an arc of half a metre radius."""
    push_gap_m: Distribution = Distribution(uniform=(0.005, 0.03))
    """Gap between the bounding spheres of pusher and object at the start, along the path [m]."""
    push_length_m: Distribution | None = None
    """Length of its path, after which it stands still [m]; default: it goes on."""
    push_miss: Annotated[float, Field(ge=0, le=1)] = 0.4
    """Largest sideways miss of the pusher's path past the object's centre [bounding radii]."""

    parameter_spread: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Factor of the fit's standard errors: 1 draws from the posterior, 0 takes the estimates, 2 widens it twofold."""

    views: Annotated[int, Field(ge=1, le=16)] = 2
    """Number of cameras, evenly spread over `view_azimuth_deg`, looking at the bodies."""
    view_azimuth_deg: tuple[Angle, Angle] = (-50.0, 50.0)
    """First and last camera's direction as seen from the bodies [deg], about the ground's normal, 0 = from -y."""
    view_shift_deg: Distribution = Distribution(fixed=0.0)
    """Added to a camera's azimuth [deg]."""
    view_elevation_deg: Distribution = Distribution(fixed=30.0)
    """Cameras' elevation above the point that they look at [deg]. What varies differs by rollout and camera."""
    view_distance_m: Distribution | None = None
    """Cameras' distance from that point [m]; default: the sampled starts fill most of the image."""
    view_roll_deg: Distribution = Distribution(fixed=0.0)
    """Turn of a camera about its axis [deg]."""
    view_aim_m: Reach = 0.0
    """Largest distance of the point that a camera looks at from the middle of the starts [m]."""
    view_angle_deg: Distribution = Distribution(fixed=50.0)
    """Cameras' full vertical angle of view [deg]."""

    light_gain: Distribution = Distribution(fixed=1.0)
    """Brightness of a rollout's light, relative to the photos [1]; the same for all its cameras."""
    light_tint: Distribution = Distribution(fixed=1.0)
    """Factor of each colour channel of that light [1], drawn for each channel."""
    light_turn_deg: Distribution = Distribution(fixed=0.0)
    """Turn of the model's lamp about the ground's normal [deg]: shades the moving bodies; the background stays."""
    exposure_gain: Distribution = Distribution(fixed=1.0)
    """Factor of a camera's picture [1], by rollout and camera."""
    exposure_tint: Distribution = Distribution(fixed=1.0)
    """White balance: factor of each colour channel of a camera [1], drawn for each channel."""
    exposure_offset: Distribution = Distribution(fixed=0.0)
    """Added to a camera's picture [1: white]."""

    reject: RejectionRules = RejectionRules()
    """Rollouts that are drawn again."""
    parameters: dict[str, Distribution] = {}
    """Distributions of physical parameters by name, in place of the fit's posterior."""
    _source: str = PrivateAttr("the plan")

    @property
    def source(self) -> str:
        """Where the plan comes from, for messages: its file where it was read from one of its own."""
        return self._source

    @model_validator(mode="after")
    def _in_range(self) -> SamplingPlan:
        if self.view_azimuth_deg[1] < self.view_azimuth_deg[0]:
            raise ValueError(f"view_azimuth_deg is a range [low, high]; found {list(self.view_azimuth_deg)}")
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if value is None:
                continue
            first, last = value.support
            if not (low <= first and last <= high):
                limits = f"from {low:g} to {high:g}"
                raise ValueError(f"{name} has to lie {limits}; it reaches from {first:g} to {last:g}")
        return self

    @property
    def moving_views(self) -> bool:
        """Whether the cameras of two rollouts can differ."""
        varied = (self.view_shift_deg, self.view_elevation_deg, self.view_distance_m, self.view_roll_deg)
        return self.view_aim_m > 0 or any(d is not None and d.varies for d in (*varied, self.view_angle_deg))


_POSITIVE, _FAR, _FAST, _BRIGHT = 1e-6, 1e5, 1e5, 1e4
_LIMITS: dict[str, Range] = {
    "height_m": (0.0, _FAR),
    "heading_deg": (-3600.0, 3600.0),
    "horizontal_speed_m_s": (0.0, _FAST),
    "vertical_speed_m_s": (-_FAST, _FAST),
    "spin_rad_s": (0.0, _FAST),
    "push_speed_m_s": (0.0, _FAST),
    "push_heading_deg": (-3600.0, 3600.0),
    "push_curve_1_m": (-_FAR, _FAR),
    "push_gap_m": (0.0, _FAR),
    "push_length_m": (_POSITIVE, _FAR),
    "view_shift_deg": (-3600.0, 3600.0),
    "view_elevation_deg": (-85.0, 85.0),
    "view_distance_m": (_POSITIVE, _FAR),
    "view_roll_deg": (-3600.0, 3600.0),
    "view_angle_deg": (1.0, 150.0),
    "light_gain": (0.0, _BRIGHT),
    "light_tint": (0.0, _BRIGHT),
    "light_turn_deg": (-3600.0, 3600.0),
    "exposure_gain": (0.0, _BRIGHT),
    "exposure_tint": (0.0, _BRIGHT),
    "exposure_offset": (-1.0, 1.0),
}


def read_plan(path: Path) -> SamplingPlan:
    """Read a sampling plan.

    Raises:
        InputDataError: If it is missing, is no TOML, or does not fit the schema; with file, line and field.
    """
    plan = read_toml(path, SamplingPlan)
    plan._source = str(path)
    return plan


def plan_toml(plan: SamplingPlan, comments: bool = True) -> str:
    """Return a plan as TOML. With comments it is a template to edit: fields are explained, unset ones commented out."""
    lines = [f"# {_DOCUMENT}"] if comments else []
    texts = field_texts(SamplingPlan) if comments else {}
    rules = field_texts(RejectionRules) if comments else {}
    for name in SamplingPlan.model_fields:
        if name not in ("reject", "parameters"):
            lines += _entry(name, getattr(plan, name), texts.get(name))
    for table, entries, told in (
        ("reject", {name: getattr(plan.reject, name) for name in RejectionRules.model_fields}, rules),
        ("parameters", plan.parameters, {}),
    ):
        lines += ["", *([f"# {texts[table]}"] if comments else []), f"[{table}]"]
        for name, value in entries.items():
            lines += _entry(toml_key(name), value, told.get(name))
    return "\n".join(lines).strip() + "\n"


_DOCUMENT = (
    "A distribution is a number (fixed), a range [low, high] (uniform), or one of\n"
    "# { log_uniform = [low, high] }, { normal = [mean, std] } (cut off at 3 std), { choice = [a, b, c] }."
)


def _entry(name: str, value: Any, text: str | None) -> list[str]:
    if text is None:
        return [] if value is None else [f"{name} = {toml_value(value)}"]
    return ["", f"# {' '.join(text.split())}", f"# {name} =" if value is None else f"{name} = {toml_value(value)}"]
