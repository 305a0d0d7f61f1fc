"""What has to be refused: models, custom effects, plans, throws, settings, options."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

from .edits import SYNTH, Edit, Row, field, kind_of, model_json, nothing, text, twice, written
from .refused import DEEP, DIGITS

FILE = "model/model.json"
VALIDATE = ("validate", "model")


def rows() -> Iterator[Row]:
    """Yield the tables."""
    for name, edit in MODELS:
        if name not in UNKNOWN:
            yield Row(f"{name}: validate", "models", "model", edit, VALIDATE)
        yield Row(f"{name}: synthesize", "models", "model", edit, SYNTH)
    for words in TRUST:
        yield Row(f"no consent: {words}", "trust", "custom effect", nothing, tuple(words.split()))
    for name, edit, words in FORGED:
        yield Row(name, "trust", "custom effect", edit, tuple(words.split()))
    for name, edit in PLANS:
        words = ("synthesize", "model", "--plan", "plan.toml", *SYNTH[2:])
        yield Row(f"plan: {name}", "plans", "plan", edit, words)
    for name, edit in THROWS:
        words = tuple("diagnose model capture --split look --throws throws.toml".split())
        yield Row(f"throws: {name}", "plans", "throws", edit, words)
    for setting in SETTINGS:
        verb = ("synthesize", "model") if setting.startswith("synthesize") else ("fit", "capture")
        subject = "model" if setting.startswith("synthesize") else "tracks"
        yield Row(f"--set {setting[:60]}", "settings", subject, nothing, (*verb, "--out", "OUT", "--set", setting))
    for name, edit, words in FILES:
        yield Row(f"settings: {name}", "settings", "settings of synthesize", edit, tuple(words.split()))
    for subject, words in OPTIONS:
        yield Row(f"option: {words}", "settings", subject, nothing, tuple(words.split()))


def _parameter(index: int, name: str, raw: str) -> tuple[str, Edit]:
    return f"parameter {index}: {name} = {raw[:30]}", field(FILE, f"parameters {index} {name}", raw)


def _body(name: str, raw: str) -> tuple[str, Edit]:
    return f"body: {name} = {raw[:30]}", field(FILE, f"bodies 0 {name}", raw)


def _effect(raw: str) -> tuple[str, Edit]:
    return f"effects: {raw[:70]}", field(FILE, "effects", raw)


def _correlations(matrix: str, names: str = '["friction", "damping_ratio"]') -> Edit:
    return field(FILE, "correlations", f'[{{"parameters": {names}, "matrix": {matrix}}}]')


MODELS: tuple[tuple[str, Edit], ...] = (
    ("measurement_std that is negative", field(FILE, "measurement_std", '{"position_m": -0.001}')),
    ("measurement_std of zero", field(FILE, "measurement_std", '{"position_m": 0.0}')),
    ("measurement_std of something unknown", field(FILE, "measurement_std", '{"smell": 1.0}')),
    _parameter(0, "estimate", "0.9"),  # disagrees with contact
    _parameter(0, "estimate", "5.0"),  # outside of its bounds
    _parameter(0, "std_error", "-0.1"),
    _parameter(0, "bounds", "[2.0, 0.01]"),
    _parameter(0, "interval_95", "[0.6, 0.2]"),
    _parameter(0, "name", '"nothing"'),
    _parameter(0, "state", '"guessed"'),
    _parameter(2, "estimate", "9.0"),  # another mass than the body's
    ("a parameter twice", twice(FILE, "parameters 0", "")),
    ("an effect twice", twice(FILE, "effects 0", "")),
    ("correlations that are asymmetric", _correlations("[[1.0, -0.5], [0.5, 1.0]]")),
    ("a correlation of 2", _correlations("[[1.0, 2.0], [2.0, 1.0]]")),
    ("a correlation with itself of 0.5", _correlations("[[0.5, 0.0], [0.0, 1.0]]")),
    ("correlations of one parameter twice", _correlations("[[1.0, 1.0], [1.0, 1.0]]", '["friction", "friction"]')),
    ("correlations of something unknown", _correlations("[[1.0, 0.1], [0.1, 1.0]]", '["friction", "nothing"]')),
    _body("com_m", "[5.0, 0.0, 0.0]"),
    _body("mass_kg", "0.0"),
    _body("mass_kg", "true"),
    _body("mass_kg", '"0.37"'),
    _body("mass_kg", "null"),
    _body("mass_kg", "1e30"),
    _body("inertia_kg_m2", "[-1.0, 1.0, 1.0, 0, 0, 0]"),
    _body("inertia_kg_m2", "[1.0, 1.0, 9.0, 0, 0, 0]"),
    _body("inertia_kg_m2", "[1e6, 1e6, 1e6, 0, 0, 0]"),
    _body("radius_factor", "0.0"),
    _body("radius_factor", "-2.0"),
    _body("radius_factor", "1e9"),
    _body("collision", '"nowhere.ply"'),
    _body("splats", '"../../etc/passwd"'),
    _body("splats", '"/dev/zero"'),
    _body("name", '"tip"'),
    _body("name", '"cu\\u001bbe"'),
    ("no bodies", field(FILE, "bodies", "[]")),
    ("null bodies", field(FILE, "bodies", "null")),
    ("friction of 1e308", model_json(lambda m: (m["contact"].update(friction=1e308), m["parameters"].pop(0)))),
    ("friction that is negative", model_json(lambda m: (m["contact"].update(friction=-0.4), m["parameters"].pop(0)))),
    ("contact_time_s of 0", field(FILE, "contact contact_time_s", "0.0")),
    ("contact_time_s of 1e9", field(FILE, "contact contact_time_s", "1e9")),
    (
        "damping_ratio of 1e308",
        model_json(lambda m: (m["contact"].update(damping_ratio=1e308), m["parameters"].pop(1))),
    ),
    ("contact of null under parameters of it", field(FILE, "contact", "null")),
    ("step_s of 1e-9", field(FILE, "solver step_s", "1e-9")),
    ("step_s of 0", field(FILE, "solver step_s", "0.0")),
    ("step_s of 1e9", field(FILE, "solver step_s", "1e9")),
    ("sweeps of 1e9", field(FILE, "solver sweeps", "1000000000")),
    ("sweeps of true", field(FILE, "solver sweeps", "true")),
    ("sweeps of 5000 digits", field(FILE, "solver sweeps", DIGITS)),
    ("gravity up", field(FILE, "gravity_m_s2", "[0.0, 0.0, 9.81]")),
    ("gravity of -981", field(FILE, "gravity_m_s2", "[0.0, 0.0, -981.0]")),
    ("gravity of NaN", field(FILE, "gravity_m_s2", "[NaN, 0.0, -9.81]")),
    ("ground's normal of zeros", field(FILE, "ground normal", "[0.0, 0.0, 0.0]")),
    ("ground's normal down", field(FILE, "ground normal", "[0.0, 0.0, -1.0]")),
    _effect('[{"name": "nothing", "parameters": {}}]'),
    _effect('[{"name": "quadratic_drag", "parameters": {"smell": 1.0}}]'),
    _effect('[{"name": "quadratic_drag", "parameters": {"k": -1.0}}]'),
    _effect('[{"name": "quadratic_drag", "parameters": {"k": 1e308}}]'),
    _effect('[{"name": "os:system", "parameters": {}}]'),
    _effect('[{"name": "/tmp/x.py:X", "parameters": {}}]'),
    ("a lamp of 1e30", field(FILE, "light lamp", "[0.0, 0.0, 1e30]")),
    ("an exposure of a negative gain", field(FILE, "exposures left gain_rgb", "[-1.0, 1.0, 1.0]")),
    ("a key twice", twice(FILE, "solver", '{"step_s": 0.001}')),
    ("deep nesting", field(FILE, "warnings", DEEP)),
    ("no solver's field of that name", field(FILE, "solver stepp_s", "0.001")),
    ("spheres of NaN", lambda root: _floats(root, "nan")),
    ("spheres of a negative radius", lambda root: _floats(root, "-1")),
    ("a manifest that is a device", kind_of(FILE, "/dev/zero")),
    ("spheres that are a named pipe", kind_of("model/cube.collision.ply", "fifo")),
)


def _floats(root: Path, value: str) -> None:
    from .mutations import apply

    apply(root, {"op": "floats", "file": "model/cube.collision.ply", "every": 1, "value": value})


UNKNOWN = ("no bodies", *(name for name, _ in MODELS if '"nothing", "param' in name or "os:system" in name))
"""What `validate` cannot judge: a model of a scene alone, effects that a package may bring which is not installed."""

TRUST = (
    "synthesize model --out OUT --rollouts 1",
    "synthesize model --print-plan",
    "eval model capture",
    "compare model capture --out OUT.html",
    "export model --to mjcf --out OUT.xml",
    "fit capture --from model --out OUT --stage phys-geo",
    "diagnose model capture --split look",
)
"""Commands that would run the effect of a stranger's model."""


def _named(name: str) -> Edit:
    return text(FILE, "effects/lift.py:MyEffect", name)


def _evil(root: Path) -> None:
    source = root / "model" / "effects" / "lift.py"
    source.write_text(source.read_text() + "\n# another content\n")


def _rehashed(root: Path) -> None:
    _evil(root)
    digest = hashlib.sha256((root / "model/effects/lift.py").read_bytes()).hexdigest()
    data = json.loads((root / FILE).read_text())
    data["effects"][0]["sha256"] = digest
    (root / FILE).write_text(json.dumps(data))


FORGED: tuple[tuple[str, Edit, str], ...] = (
    (
        "another content than the hash, with consent",
        _evil,
        "synthesize model --out OUT --rollouts 1 --trust-effects model",
    ),
    ("another content than the hash: validate", _evil, "validate model"),
    ("another content and hash, without consent", _rehashed, "eval model capture"),
    ("an effect outside of the model", _named("/tmp/x.py:MyEffect"), "validate model"),
    ("an effect above the model", _named("../lift.py:MyEffect"), "validate model"),
    ("a hash that is none", field(FILE, "effects 0 sha256", '"abc"'), "validate model"),
    ("no hash", field(FILE, "effects 0 sha256", "null"), "synthesize model --out OUT --rollouts 1"),
    ("an effect that is a link outside", kind_of("model/effects/lift.py", "/etc/hostname"), "validate model"),
    ("consent to nothing", nothing, "synthesize model --out OUT --rollouts 1 --trust-effects nothing"),
    ("consent to another hash", nothing, f"synthesize model --out OUT --rollouts 1 --trust-effects {'0' * 64}"),
)

_P = "plan.toml"
PLANS: tuple[tuple[str, Edit], ...] = (
    ("a range upside down", field(_P, "height_m", "[0.2, 0.1]")),
    ("a negative height", field(_P, "height_m", "[-0.2, 0.1]")),
    ("three numbers", field(_P, "height_m", "[0.1, 0.2, 0.3]")),
    ("log_uniform from 0", field(_P, "exposure_gain", "{ log_uniform = [0.0, 1.0] }")),
    ("no choice", field(_P, "spin_rad_s", "{ choice = [] }")),
    ("two kinds", field(_P, "spin_rad_s", "{ choice = [1.0], fixed = 1.0 }")),
    ("true as a number", field(_P, "height_m", "true")),
    ("a text as a number", field(_P, "parameter_spread", '"2"')),
    ("NaN", field(_P, "light_gain", "nan")),
    ("a negative spread", field(_P, "parameter_spread", "-1.0")),
    ("a spread of 1e308", field(_P, "parameter_spread", "1e308")),
    ("heights of 1e300", field(_P, "height_m", "[1e300, 1e301]")),
    ("speeds of 1e30", field(_P, "horizontal_speed_m_s", "[1e30, 1e31]")),
    ("no views", field(_P, "views", "0")),
    ("10^9 views", field(_P, "views", "1000000000")),
    ("an unknown parameter", field(_P, "parameters", '{ "cube.smell" = 1.0 }')),
    ("a negative mass", field(_P, "parameters", '{ "cube.mass_kg" = -1.0 }')),
    ("deep nesting", field(_P, "height_m", DEEP)),
    ("5000 digits", field(_P, "views", DIGITS)),
    ("a named pipe", kind_of(_P, "fifo")),
    ("a device", kind_of(_P, "/dev/zero")),
)

_H = "throws.toml"
THROWS: tuple[tuple[str, Edit], ...] = (
    ("a negative speed", field(_H, "throws 0 speed_m_s", "[-1.0]")),
    ("no speed", field(_H, "throws 0 speed_m_s", "[]")),
    ("a speed of 1e30", field(_H, "throws 0 speed_m_s", "[1e30]")),
    ("a negative height", field(_H, "throws 0 height_m", "[-0.5]")),
    ("an unknown axis", field(_H, "throws 0 spin_axis", '["sideways"]')),
    ("a duration of 1e9", field(_H, "throws 0 duration_s", "1e9")),
    ("true as a number", field(_H, "throws 0 height_m", "[true]")),
    ("10^8 throws", field(_H, "throws 0 elevation_deg", str([0.001 * k for k in range(10_000)]))),
    ("no throws", field(_H, "throws", "[]")),
    ("deep nesting", field(_H, "throws", DEEP)),
    ("a named pipe", kind_of(_H, "fifo")),
)

SETTINGS = (
    *("phys-geo.step_s=0", "phys-geo.step_s=-1", "phys-geo.step_s=1e-9", "phys-geo.step_s=nan", "phys-geo.step_s=true"),
    *("phys-geo.population=1", "phys-geo.population=1000000000", "phys-geo.generations=1000000000", "phys-geo.seed=-1"),
    *("phys-geo.iterations=0", "phys-geo.warmup_s=-1", "phys-geo.effects=nothing"),
    *(
        "phys-geo.smell=1",
        "phys-geo.supervise=smell",
        "phys-geo.device=gpu",
        "smell.x=1",
        "phys-geo",
        "=",
        "phys-geo.=1",
    ),
    *("synthesize.width=15", "synthesize.width=1000000000", "synthesize.width=32.5", "synthesize.duration_s=1e9"),
    *(
        "synthesize.duration_s=-1",
        "synthesize.duration_s=nan",
        "synthesize.frame_rate_hz=1e12",
        "synthesize.frame_rate_hz=0",
    ),
    *(
        "synthesize.rollouts=0",
        "synthesize.rollouts=1000000000000",
        "synthesize.batch=0",
        "synthesize.batch=1000000000000",
    ),
    *("synthesize.shards=0", "synthesize.compression=best", "synthesize.seed=-1", f"synthesize.seed={DIGITS}"),
    *(f"synthesize.plan={DEEP[:3000]}", "synthesize.rollouts=true", 'synthesize.width="32"'),
)

_S = "synthesize.toml"
_WITH = "synthesize model --out OUT --no-preview --config synthesize.toml"
FILES: tuple[tuple[str, Edit, str], ...] = (
    ("an unknown stage", written(_S, "[smell]\nx = 1\n"), _WITH),
    ("an unknown key", field(_S, "synthesize smell", "1"), _WITH),
    ("a key twice", written(_S, "[synthesize]\nseed = 0\nseed = 1\n"), _WITH),
    ("true as a count", field(_S, "synthesize rollouts", "true"), _WITH),
    ("a text as a number", field(_S, "synthesize duration_s", '"0.1"'), _WITH),
    ("10^12 rollouts", field(_S, "synthesize rollouts", "1000000000000"), _WITH),
    ("deep nesting", field(_S, "synthesize width", DEEP), _WITH),
    ("a device", kind_of(_S, "/dev/zero"), _WITH),
    ("a folder", kind_of(_S, "directory"), _WITH),
    ("no such file", kind_of(_S, "removed"), _WITH),
)

OPTIONS = (
    ("model", "synthesize model --out OUT --rollouts 1000000000000"),
    ("model", "synthesize model --out OUT --rollouts 0"),
    ("model", "synthesize model --out OUT --shard 3/2"),
    ("model", "synthesize model --out OUT --shard x"),
    ("model", "synthesize model --out OUT --shards 1000000000000"),
    ("model", "synthesize model --out OUT --seed -1"),
    ("model", "synthesize model --out nowhere/OUT/\x1b[31m/x --plan nowhere.toml"),
    ("model", "export model --to mjcf --out OUT.xml --duration inf"),
    ("model", "export model --to mjcf --out OUT.xml --duration 1e12"),
    ("model", "export model --to smell --out OUT"),
    ("model", "export model --to usd --out OUT"),
    ("model", "export model --to urdf --out OUT --duration 0.1"),
    ("model", "export model --to sdf --out OUT --duration 0.1"),
    ("model", "export model --to bop --out OUT"),
    ("dataset", "export dataset --to bop --out OUT --cameras nothing"),
    ("dataset", "export dataset --to nerfstudio --out OUT --rollout 99"),
    ("dataset", "export dataset --to bop --out OUT --split nothing"),
    ("dataset", "export dataset --to bop --out OUT --every 0"),
    ("dataset", "validate dataset --sample 0"),
    ("dataset", "validate dataset --sample -5"),
    ("dataset", "eval model dataset --split nothing"),
    ("tracks", "eval model capture --warmup-s -1"),
    ("tracks", "eval model capture --warmup-s nan"),
    ("tracks", "eval model capture --split nothing"),
    ("tracks", "compare model capture --split nothing --out OUT.html"),
    ("tracks", "diagnose model capture --split nothing"),
    ("tracks", "diagnose model capture --split look --candidates nothing"),
    ("tracks", "fit capture --out OUT --effects quadratic_drag,quadratic_drag --from model"),
    ("tracks", "fit capture --out OUT --effects quadratic_drag@group,quadratic_drag --from model"),
    ("tracks", "fit capture --out OUT --effects nothing --from model"),
    ("tracks", "fit capture --out OUT --split nothing"),
    ("tracks", "fit capture --out OUT --from nowhere"),
    ("csv", "import csv csv --out OUT --train 0"),
    ("csv", "import csv csv --out OUT --train 99"),
    ("csv", "import csv csv --out OUT --columns time=x,px=x"),
    ("csv", "import csv csv --out OUT --body ../up"),
    ("csv", "import csv csv --out OUT --body \x1b[31m"),
    ("csv", "import csv csv --out OUT --topic /pose"),
)
