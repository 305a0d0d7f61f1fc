"""docs/thresholds.md says what the code says: every threshold that it names exists, with the value that it states.

Thresholds of a diagnosis are fields of two objects, from which their tables are written; no other number decides there.
"""

import ast
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from cgwm.pipeline.trajectories.thresholds import NOT_KNOWN, Threshold

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import thresholds_page  # noqa: E402  the tool that writes the page

PAGE = (ROOT / "docs" / "thresholds.md").read_text(encoding="utf-8")
CODE = re.compile(r"`([^`]+)`")


def rows(first: str) -> Iterator[list[str]]:
    """Yield the cells of all tables whose first column has this title."""
    inside = False
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if not line.startswith("|"):
            inside = False
        elif cells[0] == first:
            inside = True
        elif inside and not line.startswith("| ---"):
            yield cells


STATED = [
    (cells[1].strip("`"), name, value)
    for cells in rows("threshold")
    for name, value in zip(CODE.findall(cells[0]), CODE.findall(cells[2]), strict=True)
]
"""Module, constant and value of every threshold."""


TABLE = {f"{group}.{one.name}": one for group, some in thresholds_page.groups().items() for one in some}
"""Thresholds of a diagnosis, by group.field."""
NUMERICS = {
    "contact/friction_pyramid.FLATTEST": "keeps an ellipse from degenerating",
    "flight/group_values.ZERO": "rounding of a value at its bound",
    "flight/form_fit.LEAST_SHARE": "keeps a matrix solvable",
    "flight/form_fit.SINGULAR": "keeps a matrix solvable",
    "evidence/evidence.NEARLY": "rounding of a value at its bound",
    "next_experiment/contact_information.LEAST_STEP_S": "resolution of simulated motions",
    "next_experiment/contact_information.WEAK_SHARE": "keeps a matrix solvable",
    "flight/coupled_effects.ITERATIONS": "bounds the duration of a refit",
    "evidence/cross_validation.ITERATIONS": "bounds the duration of a fit",
    "evidence/cross_validation.KNOWN_SHARE": "defines the held-out error: the share of an episode that fits its start",
    "episodes.MAX_EPISODES": "bounds the duration; the report says which episodes were used",
    "next_experiment/experiments.FLAT_DEG, FAST_M_S, SLOW_M_S": "words that describe a throw",
    "next_experiment/experiments.MOST_THROWS": "bounds the duration",
    "next_experiment/fisher_information.LEAST_STEP_S": "resolution of simulated throws",
    "next_experiment/fisher_information.MOST_CONTACTS": "bounds the duration",
    "law_export.LIMIT": "bounds of a parameter in a file that is written",
    "report/page._MM": "millimetres in a metre",
    "report/page.BARS": "number of bars in a chart",
    "report/pictures.FRAMES": "points of a drawn line",
    "report/pictures.SHOWN_S": "length of a drawn motion",
    "report/pictures.SLIDE": "the motion that is drawn for an effect in contact",
    "contact/rebound_by_slip.WEAK": "width of a prior of a nuisance",
    "flight/own_accelerations.QUARTER_TURN": "a matrix",
    "flight/own_tilt.PIECE_S, LONGEST_S": "length of the motion that is looked at",
    "contact/candidate_fit.SIGNED_SIZES": "where fits begin",
    "contact/candidate_fit.SIZES": "where fits begin",
    "contact/candidate_fit.STATE_ITERATIONS": "end of a descent",
    "contact/candidate_fit.WIDE": "width of a prior that does not count",
    "evidence/robust_fit.FALL": "end of a descent",
    "evidence/robust_fit.ITERATIONS": "end of a descent",
    "evidence/robust_fit.MOST_NUMBERS": "size of a batch",
    "evidence/robust_fit.STEPS": "lengths of a step that are tried",
    "next_experiment/hand_motions.FLAT_DEG": "what the words of a proposed motion ask for",
    "next_experiment/hand_motions.INSIDE": "tolerance of a geometric test",
    "next_experiment/hand_motions.MOST_AHEAD_M": "where a proposed motion begins",
    "next_experiment/hand_motions.SAME_FACE": "tolerance of a geometric test",
    "next_experiment/motions.SIZES": "which sizes motions are chosen for",
    "next_experiment/surface_motions.SPEEDS_M_S": "which motions are proposed",
    "next_experiment/surface_motions.DURATION_S, RATE_HZ": "which motions are proposed",
    "next_experiment/surface_motions.MOST_RIVALS, MOST_MOTIONS": "bounds the duration; how many motions are asked for",
    "next_experiment/surface_motions.LEAST_S": "which motions are proposed",
    "next_experiment/motions.MOST_MOTIONS": "how many motions are asked for at a time",
    "next_experiment/motions.WORTH_TELLING": "which effects a proposal names",
    "sparse_regression.EXPONENTS": "grid of a search",
}
"""Numbers of modules in `pipeline/diagnose` outside of the table, each with the reason why it decides no verdict."""
SEGMENT_NUMERICS = {
    "length of a warning": ("prepare.NAMED",),
    "names of components": ("impulse_errors.KINDS",),
    "keeps a covariance solvable where nothing is used": ("impacts/flat.KNOWN_M_S",),
    "end of a descent": (
        "first_contact_fit.ITERATIONS, TOLERANCE",
        "impacts/fit.ITERATIONS, FALL",
        "impulse_errors.ROUNDS",
        "input_checks.ENVELOPE_ITERATIONS",
        "mixed_model.ROUNDS",
        "random_effects.FIRST_ITERATIONS, ITERATIONS",
        "segment_fit.ITERATIONS",
        "segment_fit.FALL",
        "segment_fit.FALL_SHARE",
        "segment_states.FALL, MAX_DAMPING",
        "sliding/fit.HELD_ITERATIONS",
        "segment_states.THOROUGH_STARTS, THOROUGH_ITERATIONS",
        "segment_states.SEARCHES, SEARCH_ITERATIONS",
        "sliding/descent.ITERATIONS, MAX_DAMPING, FALL, FALL_SHARE",
        "sliding/residuals.SWEEPS",
        "sliding/segments.LIFTS",
        "sliding/support.TOGETHER",
        "sliding/variant_fits.FIRST_ITERATIONS",
        "sliding/variant_fits.MOST_PASSES",
        "sliding/variant_fits.STALLED",
        "flights/variance_components.STEPS",
        "flights/variance_components.LONGEST, ENOUGH",
        "flights/variance_components.LEAST_INFORMATION",
        "flights/variance_components.POLICY",
    ),
    "start of a descent, or lengths of a step that are tried": (
        "impacts/fit.SHARES",
        "impulse_errors.FIRST_SHARE, LEAST_SHARE",
        "flights/variance_components.STARTS_S",
        "impacts/fit.WEIGH_AGAIN",
        "segment_states.DRAWS, STARTS",
        "segment_states.DRAW_SPREAD",
        "segments.START_FRAMES",
        "sliding/descent.DAMPINGS",
        "sliding/fit.FACTORS",
        "sliding/fit.START_FRAMES",
        "sliding/fit.START_FRICTION",
        "sliding/variant_fits.GRIP",
    ),
    "step of differences": (
        "impacts/fit.STEP",
        "impacts/fit.TWIST_STEPS",
        "impulse_errors.SHARE",
        "segments.PARAMETER_STEP",
        "sliding/residuals.PARAMETER_STEP",
        "sliding/residuals.STATE_STEPS",
    ),
    "resolution of a simulation": (
        "impact_law.REACH_M, REACH_STEPS",
        "impact_law.SLICES",
        "impact_law.STEPS, STEP",
        "segments.CONTACT_STEP_S",
        "segments.FLIGHT_STEP_S, FLIGHT_STEP_NOISE_M",
        "segments.LEAST_STEP_S",
        "sliding/residuals.TIME_S",
        "sliding/residuals.SURFACE_TIME_S",
        "sliding/segments.SINKS",
    ),
    "size of a batch, or of a sample": (
        "described_motion.MAX_EPISODES",
        "first_contact_fit.MAX_WINDOWS",
        "linearization.PART_ROLLOUTS",
        "flights/slow_errors.FLIGHTS",
        "flights/contrasts.FRAMES",
        "sliding/variant_fits.MANY",
    ),
    "keeps a matrix regular": (
        "mixed_model.LEAST_SHARE",
        "random_effects.STATE_INFORMATION",
        "flights/repeated_forces.PRIOR_STD",
        "flights/residual_wrench.WEAK_STD",
        "flights/contrasts.KEPT",
        "flights/contrasts.LEAST_MOVE",
        "flights/restricted_likelihood.LEAST_WHITE",
        "flights/variance_components.LEAST_STD",
        "segment_fit.LEAST_WEIGHT",
        "sliding/descent.WEAK",
    ),
    "length of the motion that is looked at": (
        "described_motion.WARMUP_S",
        "first_contact_fit.AFTER_S",
        "first_contact_fit.CONTACT_S",
        "first_contact_fit.LEAD_FRAMES",
        "random_effects.REST_S",
        "flights/residual_wrench.BINS",
        "flights/residual_wrench.WINDOW_S",
        "sliding/segments.SIDE_S, SIDE_FRAMES",
        "flights/repeated_forces.USUAL_BINS",
        "flights/variance_components.FASTEST_S, FAST_S, SLOW_S",
        "flights/slow_errors.SPACING, FINER, THINNED",
        "flights/slow_errors.SHORTEST",
        "flights/slow_errors.LEAST_COUNT",
        "flights/slow_errors.COMMON_S",
    ),
    "defines a held-out score": ("held_out_gain.FOLDS",),
    "width of a prior of a nuisance, or size of a sample of flights": (
        "impacts/restitution.DRAG_PRIOR",
        "impacts/restitution.LIFT_MEAN",
        "impacts/restitution.NOISE_PRIOR",
        "impacts/restitution.SHAKEN_MEAN, MUCH_SHAKEN",
        "impacts/restitution.GROUND_STD, CONTACT_PRIOR",
        "impacts/restitution.SCATTER_PRIOR",
        "impacts/restitution.SHAKEN_S",
        "impacts/restitution.MOST_FLIGHTS",
        "impacts/restitution.MOST_FRAMES",
    ),
    "error of a contact law in a fit of effects; widens intervals": ("first_contact_fit.MODEL_ERROR",),
}
"""Numbers of modules in `pipeline/segments` outside of the table, by the reason why they decide no verdict."""


TRACK_NUMERICS = {
    "end of a descent, or its grid": (
        "correlated_noise.REMEMBERED",
        "smoothing_filter.CUTOFFS_HZ",
        "smoothing_filter.HIGHEST",
        "smoothing_filter.PARABOLAS",
        "smoothing_filter.LASTING",
        "smoothing_filter.ROUNDING",
        "time_errors.TRIED_S",
        "time_errors.FACTORS",
        "time_errors.BINS",
        "frame_times.IN_PHASE, NEAR",
        "frame_times.MOST_DOUBLINGS",
        "time_errors.FAR",
        "correlated_noise.FAR",
        "correlated_noise.ROBUST_SCALE",
        "correlated_noise.MOST_CORRELATED",
        "flight_noise.MOST_CORRELATED",
        "flight_noise.STEPS",
        "state_uncertainty.MAX_STEP",
        "state_uncertainty.DAMPINGS",
        "state_uncertainty.POLICY",
        "state_uncertainty.ROBUST_SCALE",
        "residuals.SMOOTH_STEPS",
        "residuals.STATE_STEPS",
    ),
    "window of an estimate, and the polynomial in it": (
        "bursts.DEGREES",
        "bursts.GROUNDED_S",
        "bursts.KEPT, ROUNDING",
        "bursts.LEAST_FREE",
        "bursts.LEAST_TURNED",
        "correlated_noise.LONGEST_S",
        "correlated_noise.LEAST_DEGREE, MOST_DEGREE",
        "correlated_noise.CIRCLE_LEFT",
        "correlated_noise.LARGEST_TURN",
        "correlated_noise.LEAST",
        "flight_noise.WINDOW",
        "time_errors.FRAMES, DEGREES",
        "flight_noise.DEGREE",
        "flight_noise.SLOW_DEGREE",
        "track_noise.WINDOW",
        "track_noise.LONG_FRAMES, LONG_S",
    ),
    "width of a prior, or size of a state": (
        "residuals.STATE_SIZE",
        "residuals.SPIN_STD_RAD_S",
        "residuals.STATE_PRIOR_STD",
        "track_noise.MAD_TO_STD",
    ),
    "bounds the duration or the resolution": (
        "innovations.RESOLUTION_S",
        "innovations.MOST_NUMBERS",
        "smoothing_filter.GRID, LAGS",
        "state_uncertainty.MAX_ITEMS",
        "observations.START_FRAMES",
        "initial_state.MIN_FRAMES",
    ),
    "listed on the page: they refuse an input or begin a prediction, and decide no verdict": (
        "initial_state.FLIGHT_MARGIN_M",
        "initial_state.LINE_MISFIT",
        "initial_state.LINE_SPREAD",
        "initial_state.HELD",
        "rolling_start.NEAR_M",
        "rolling_start.TOGETHER_M",
        "rolling_start.STAYS_SHARE",
        "rolling_start.SPIN_SHARE, SPIN_LEAST_RAD_S",
        "rolling_start.PASSES",
        "observations.LONGEST_STEP_S",
        "track_noise.FLOOR_M, FLOOR_RAD",
    ),
}
"""Numbers of modules in `pipeline/trajectories` outside of the table, by the reason why they decide no verdict."""


def file_of(module: str) -> Path:
    return ROOT / module if module.startswith(("datasets/", "schemas/")) else ROOT / "pipeline" / module


def constants(path: Path) -> dict[str, ast.expr]:
    """Return what a module assigns to names at its top level, without importing it."""
    found = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            found[ast.unparse(node.target)] = node.value
        elif isinstance(node, ast.Assign):
            for target in node.targets:
                both = (target, node.value)
                several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
                pairs = zip(*(one.elts for one in both), strict=True) if several else [both]
                found |= {ast.unparse(name): value for name, value in pairs}
    return found


def evaluated(expression: str | ast.expr) -> object:
    """Return the value of a literal, or of arithmetic with functions of `math`."""
    node = ast.parse(expression, mode="eval").body if isinstance(expression, str) else expression
    names = {one.id for one in ast.walk(node) if isinstance(one, ast.Name)}
    assert names <= {"math"}, f"{ast.unparse(node)} is no literal"
    return eval(ast.unparse(node), {"__builtins__": {}, "math": math})


def fault(module: str, name: str, value: str) -> str | None:
    """Return what is wrong with a stated constant; None where nothing is."""
    path = file_of(module)
    if not path.is_file() or name not in constants(path):
        others = [
            str(other.relative_to(ROOT)) for other in (ROOT / "pipeline").rglob("*.py") if name in constants(other)
        ]
        return f"{path.relative_to(ROOT)} has no {name}; it is in: {', '.join(others) or 'no module'}"
    found = evaluated(constants(path)[name])
    return None if found == evaluated(value) else f"{name} of {module} is {found}, the page states {value}"


def test_the_constants_have_the_stated_values() -> None:
    assert [found for one in STATED if (found := fault(*one))] == []


def test_a_wrong_value_is_found() -> None:
    module, name, value = STATED[0]
    assert f"the page states {value} + 1" in (fault(module, name, f"{value} + 1") or "")


def test_a_threshold_is_listed_once() -> None:
    places = [(module, name) for module, name, _ in STATED]
    assert len(STATED) + len(TABLE) > 220
    assert len(set(places)) == len(places)


def test_every_cell_is_filled() -> None:
    assert all(len(cells) == 6 and all(cells) for first in ("threshold", "name") for cells in rows(first))


def test_the_page_is_written_from_the_table() -> None:
    assert thresholds_page.page(PAGE) == PAGE, "run 'python benchmarks/thresholds_page.py'"
    assert sorted(cells[0].strip("`") for cells in rows("name")) == sorted(TABLE)


@pytest.mark.parametrize("one", TABLE.values(), ids=TABLE)
def test_what_is_not_known_of_a_threshold_is_said(one: Threshold) -> None:
    assert one.unit and one.decides and one.calibrated_on and one.error_rates
    if one.false_alarms is not None:
        alarms, nulls = one.false_alarms
        assert 0 <= alarms < nulls
        assert one.calibrated_on != NOT_KNOWN


def test_every_threshold_of_the_table_is_read() -> None:
    sources = (
        path for room in ("diagnose", "segments", "trajectories") for path in (ROOT / "pipeline" / room).rglob("*.py")
    )
    text = "\n".join(path.read_text(encoding="utf-8") for path in sources)
    reads = set(re.findall(r"(?:limits|LIMITS|thresholds|THRESHOLDS\.\w+)\.(\w+)", text))
    assert {name.partition(".")[2] for name in TABLE} <= reads


def module_numbers(source: str) -> Iterator[str]:
    """Yield the names to which a module assigns numbers at its top level, dictionaries and lists of objects aside."""
    for node in ast.parse(source).body:
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        if value is None or isinstance(value, ast.Dict):
            continue
        objects = isinstance(value, ast.Tuple) and any(isinstance(one, ast.Call) for one in value.elts)
        literals = [one.value for one in ast.walk(value) if isinstance(one, ast.Constant)]
        if not objects and any(isinstance(one, int | float) for one in literals):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            yield ast.unparse(target).strip("()")


@pytest.mark.parametrize(
    ("room", "allowed"),
    [
        ("diagnose", set(NUMERICS)),
        ("segments", {name for names in SEGMENT_NUMERICS.values() for name in names}),
        ("trajectories", {name for names in TRACK_NUMERICS.values() for name in names}),
    ],
)
def test_no_number_outside_of_the_table_decides_a_verdict(room: str, allowed: set[str]) -> None:
    folder = ROOT / "pipeline" / room
    found = {
        f"{path.relative_to(folder).with_suffix('').as_posix()}.{name}"
        for path in sorted(folder.rglob("*.py"))
        for name in module_numbers(path.read_text(encoding="utf-8"))
    }
    assert found == allowed


def test_numbers_of_a_module_are_found() -> None:
    assert list(module_numbers("LEAST = 3\nA, B = 1.0, -2\nNAME = 'x'\nC: float = 2 * log(3)")) == [
        "LEAST",
        "A, B",
        "C",
    ]


def test_decisions_name_listed_thresholds_and_their_tables() -> None:
    known = set(TABLE) | {name for _, name, _ in STATED} | {f"{Path(module).stem}.{name}" for module, name, _ in STATED}
    headings = re.findall(r"^## (.+)$", PAGE, re.M)
    anchors = {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}
    decisions = list(rows("decision"))
    assert len(decisions) > 10
    for _, thresholds, link in decisions:
        assert set(CODE.findall(thresholds)) <= known
        assert link.partition("(#")[2].rstrip(")") in anchors
    named = next(thresholds for decision, thresholds, _ in decisions if "drag" in decision)
    assert "`flight.alpha`" in named
