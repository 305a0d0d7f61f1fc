"""The page of a diagnosis, and the command that follows it in every verdict."""

from pathlib import Path

import numpy as np
import pytest
from cgwm.pipeline.diagnose.report.next_command import next_command, successor
from cgwm.pipeline.diagnose.report.page import default_page, diagnosis_html, mark_of
from cgwm.pipeline.diagnose.report.pictures import (
    DrawnMotion,
    EffectPicture,
    ForceCurve,
    MissingForce,
    Pictures,
    binned_means,
    throw_of,
)
from cgwm.pipeline.report.page import page
from cgwm.pipeline.report.page_file import made_of, pages_beside, shows_the_same
from cgwm.pipeline.segments.flights.residual_wrench import motion_axes
from cgwm.schemas import (
    ContactLimit,
    DiagnoseResult,
    EffectParameterEstimate,
    LawTerm,
    NextExperiment,
    RankedEffect,
    ResidualLaw,
)
from helpers.diagnosis_data import world_with
from helpers.pages import Tags

NUMBERS = np.linspace(0.0, 1.0, 12)


def found(verdict: str = "missing_effect", selected: tuple[str, ...] = ("quadratic_drag",), **more) -> DiagnoseResult:
    estimate = EffectParameterEstimate(name="k", unit="1/m", estimate=0.4, std_error=0.01)
    ranking = (
        RankedEffect(effect="linear_drag", acts_in=("flight",), judged_in="flight", score_p=0.0, delta_bic=-40.0),
        RankedEffect(
            effect="quadratic_drag", acts_in=("flight",), judged_in="flight", score_p=0.0, delta_bic=-80.0,
            cv_error_before_m=0.0171, cv_error_after_m=0.0029, parameters=(estimate,),
        ),
    )  # fmt: skip
    limits = (ContactLimit(effect="adhesion", sizes={"F": 14.0}, units={"F": "N"}),)
    return DiagnoseResult(
        verdict=verdict, sentence="Missing: <it>.", selected=selected, ranking=ranking, contact_limits=limits,
        episodes=6, not_tested={"wind": "the model has no drag"}, **more,
    )  # fmt: skip


def drawn() -> Pictures:
    curves = tuple(ForceCurve(name, NUMBERS, 0.1 + 0 * NUMBERS) for name in ("along", "sideways", "across"))
    force = MissingForce(
        coordinate="speed", same_everywhere=False, share=0.5, x=NUMBERS, force=curves, torque=()
    )  # fmt: skip
    path = np.stack([NUMBERS, NUMBERS], 1)
    motions = DrawnMotion("with quadratic_drag", path), DrawnMotion("without it", 2 * path)
    return Pictures(force, force, (EffectPicture("quadratic_drag", "a throw", NUMBERS, motions, 0.01 * NUMBERS),), ())


def test_the_page_shows_what_decides_what_it_does_and_what_could_have_been_seen(tmp_path: Path) -> None:
    model, capture, place = tmp_path / "m0", tmp_path / "c", tmp_path / "diagnose-m0.html"
    made = diagnosis_html(found(), drawn(), place, model, capture, "train", "cgwm fit 'my c'")
    tags = Tags()
    tags.feed(made)
    assert tags.faults == [] and tags.open == [] and tags.addresses == ["m0", "c"]
    bars = made.index("quadratic_drag</span>"), made.index("linear_drag</span>")
    assert bars[0] < bars[1]
    for words in ("Missing: &lt;it&gt;.", "cgwm fit &#x27;my c&#x27;", "What quadratic_drag does", "10 mm apart",
                  "changes most clearly with the speed", "17.10 → 2.90", "k: 0.030 1/m", "F: 14 N",
                  "the model has no drag"):  # fmt: skip
        assert words in made, words
    place.write_text(made)
    assert shows_the_same(place, mark_of(place, model, capture, "train"))
    assert not shows_the_same(place, mark_of(place, model, capture, "test"))


def test_the_page_leads_to_the_pages_beside_it(tmp_path: Path) -> None:
    shown = {"both": "compare m0 m1", "other": "compare m00", "own": "diagnose m0", "test": "diagnose m0"}
    for name, (verb, *models) in ((name, words.split()) for name, words in shown.items()):
        place = tmp_path / f"{name}.html"
        place.write_text(page("<t>", [], made_of=made_of(place, verb, [tmp_path / model for model in models])))
    (tmp_path / "mine.html").write_text("m0")
    (tmp_path / "improve.html").touch()
    found = pages_beside(tmp_path / "own.html", [tmp_path / "m0"])
    assert [(kind, path.name) for kind, path in found] == [
        ("comparison", "both.html"), ("diagnosis", "test.html"), ("ladder of models", "improve.html"),
    ]  # fmt: skip


def test_the_page_is_beside_the_model_and_named_after_it() -> None:
    assert default_page(Path("a/m0")) == Path("a/diagnose-m0.html")
    assert default_page(Path("m0"), "test") == Path("diagnose-m0-test.html")


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (found(), "cgwm fit my c --from a/m0 --effects quadratic_drag --out a/m1"),
        (found("none_missing", ()), "cgwm compare a/m0 my c"),
        (found("unexplained", ()), "cgwm compare a/m0 my c"),
        (
            found("unexplained", (), residual_law=ResidualLaw(
                terms=(LawTerm(term="-u", coefficient=1, std_error=0.1, unit="1/s"),), left_chi2=1.0, where="speed")),
            "cgwm diagnose a/m0 my c --save-law a/m0_law.py",
        ),
        (
            found("unexplained", (), saved_law="l.py:ResidualLaw"),
            "cgwm fit my c --from a/m0 --effects l.py:ResidualLaw --out a/m1",
        ),
    ],
)  # fmt: skip
def test_every_verdict_is_followed_by_a_command(result: DiagnoseResult, words: str) -> None:
    assert " ".join(next_command(result, Path("a/m0"), Path("my c"))) == words


def test_the_next_model_has_a_number_that_is_free(tmp_path: Path) -> None:
    (tmp_path / "m1").mkdir()
    assert successor(tmp_path / "m0") == tmp_path / "m2"
    assert successor(tmp_path / "base") == tmp_path / "base-1"
    assert successor(tmp_path / "m0_throws7") == tmp_path / "m1_throws7"  # the 7 is that of the throws
    assert successor(tmp_path / "throws7_m0") == tmp_path / "throws7_m1"


def test_an_experiment_is_drawn_as_it_would_fly() -> None:
    state = {"position_m": [0.0, 0.0, 5.0], "quat_wxyz": [1.0, 0.0, 0.0, 0.0], "velocity_m_s": [0.0, -2.0, 3.0]}
    state["omega_body_rad_s"] = [0.0, 0.0, 0.0]
    throw = NextExperiment(what="throw it; hard", initial_state=state, separates=("a", "b"), expected_gain_nats=1.0)
    (drawn,) = throw_of(world_with("ball"), throw)
    t = np.linspace(0.0, 1.0, len(drawn.path))
    assert drawn.name == "throw it"
    np.testing.assert_allclose(drawn.path, np.stack([2 * t, 5 + 3 * t - 9.81 / 2 * t**2], 1), atol=1e-6)
    assert throw_of(world_with("ball"), None) == ()


def test_axes_of_a_motion_are_orthonormal_and_right_handed() -> None:
    axes = motion_axes(np.array([[1.0, 2, 0.5], [0, 0, 3], [0, 0, 0]]))
    np.testing.assert_allclose(axes[:2] @ axes[:2].transpose(0, 2, 1), np.tile(np.eye(3), (2, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes[:2]), 1.0)
    np.testing.assert_allclose(axes[0, 1, 2], 0.0, atol=1e-12)


def test_binned_means_follow_a_line_and_need_enough_points() -> None:
    means = binned_means(NUMBERS, 2 * NUMBERS, 0.1 + 0 * NUMBERS)
    assert len(means) == 4 and all(y == pytest.approx(2 * x) for x, y in means)
    assert binned_means(NUMBERS[:11], NUMBERS[:11], NUMBERS[:11]) == []
