"""The report of a demo: one page that needs nothing else, with the numbers that its JSON holds."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.cli import demo
from cgwm.pipeline.demo.page import ReportPictures, write_report
from cgwm.pipeline.demo.truth_tables import sphere_distance, true_parameters
from cgwm.pipeline.demo.verdict import targets_of, verdict_text
from cgwm.pipeline.rendering.contact_sheets import (
    FrameStrip,
    RolloutTile,
    _fitted,
    _window,
    small_png,
    telling,
    tiles,
)
from cgwm.pipeline.report.charts import Chart, Line, chart_svg, decades, interval_svg
from cgwm.pipeline.report.page import command, link, number, section, table
from cgwm.pipeline.report.page import page as whole
from cgwm.pipeline.report.plots import Bar, Plot, Series, bars, plot_svg
from cgwm.schemas import (
    BodyCheck,
    CalibrationCheck,
    ComparedParameter,
    DatasetSummary,
    DemoResult,
    EpisodeCurves,
    EpisodeErrors,
    ErrorCurve,
    ErrorSummary,
    EvalResult,
    FittedParameter,
    ImagesOnlyFit,
    Provenance,
    SplatCheck,
    read_json,
)
from helpers.pages import Tags


def evaluation(turn_deg: float = 7.25, frozen_m: float = 0.21) -> EvalResult:
    def summary(value: float) -> ErrorSummary:
        return ErrorSummary(mean=value, median=value, final=2 * value)

    def baseline(move_m: float, turn: float) -> dict:
        return {"translation_error_m": {"median": move_m, "final": move_m}, "rotation_error_deg": {"median": turn}}

    one = EpisodeErrors(
        episode="001",
        frames=26,
        duration_s=1.2,
        translation_error_m=0.00634,
        translation_final_m=0.011,
        rotation_error_deg=turn_deg,
        psnr_object_db=21.43,
    )
    return EvalResult(
        episodes=1,
        translation_error_m=summary(0.00634),
        rotation_error_deg=summary(turn_deg),
        psnr_object_db=summary(21.43),
        baselines={"frozen": baseline(frozen_m, 88.0), "ballistic": baseline(2.31, 121.0)},
        per_episode=(one,),
    )


def result(**changes: object) -> DemoResult:
    scored = evaluation()
    targets = targets_of(scored)
    friction = FittedParameter(
        name="friction", unit="1", estimate=0.2817, std_error=0.01, interval_95=(0.262, 0.3021), bounds=(0.01, 2.0)
    )
    stuck = FittedParameter(
        name="contact_time_s", unit="s", estimate=0.001, state="on_bound", note="<b>bold</b> & more"
    )
    curve = ErrorCurve(translation_error_m=(0.001, None, 0.02), rotation_error_deg=(0.5, 2.0, 9.0))
    numbers = {
        "scene": "fall",
        "seed": 3,
        "renderer": "raycast",
        "device": "cpu",
        "verdict": verdict_text(scored, targets, 0.1),
        "targets": targets,
        "evaluation": scored,
        "parameters": (
            ComparedParameter(parameter=friction, true_value=0.2702, covered=True),
            ComparedParameter(parameter=stuck, true_value=0.0034),
        ),
        "images_only": ImagesOnlyFit(outcome="not_converged", message="the search found nothing"),
        "calibration": CalibrationCheck(
            photos=48,
            photos_registered=47,
            video_cameras=2,
            video_cameras_registered=2,
            reprojection_error_px=0.44,
            center_error_median_m=0.000241,
            center_error_max_m=0.00105,
            scale_error=0.000193,
            self_check=True,
        ),
        "splats": SplatCheck(
            held_out_photos=6,
            psnr_db=26.5,
            psnr_object_db=26.6,
            mask_iou=0.977,
            scene_spheres=6000,
            bodies=(
                BodyCheck(
                    body="object",
                    visual_spheres=2500,
                    collision_spheres=256,
                    surface_error_mean_m=0.00175,
                    surface_error_95_m=0.00375,
                    surface_bias_m=0.0017,
                ),
            ),
        ),
        "dataset": DatasetSummary(
            dataset="dataset",
            shard="rollouts-0000-of-0001.h5",
            sha256="0" * 64,
            bytes=36_700_000,
            rollouts=8,
            frames=496,
            contacts=1031,
            cameras=("view0",),
            seconds=20.0,
            frames_per_s=24.8,
        ),
        "curves": (
            EpisodeCurves(
                episode="001",
                time_s=(0.0, 0.1, 0.2),
                warmup_end_s=0.1,
                first_contact_s=0.15,
                model=curve,
                frozen=curve,
                ballistic=curve,
            ),
        ),
        "seconds": {"calibrate": 41.5, "fit": 120.25},
        "peak_memory_bytes": 700 << 20,
        "paths": {"report": "report.html", "model": "model"},
        "warnings": ("fit: something <odd>",),
        "provenance": Provenance(capture="capture", input_sha256={"capture.toml": "ab" * 32}),
    }
    return DemoResult(**{**numbers, **changes})


def strip(frames: int = 12, size: tuple[int, int] = (120, 160)) -> FrameStrip:
    """Return a square that moves to the right for half of the time and then rests."""
    rng = np.random.default_rng(0)
    real = rng.integers(0, 255, (frames, *size, 3)).astype(np.uint8)
    masks = np.zeros((frames, *size), np.uint8)
    for k in range(frames):
        left = 20 + 8 * min(k, frames // 2)
        masks[k, 40:60, left : left + 20] = 1
    return FrameStrip(
        episode="001", camera="left", times_s=np.arange(frames) / 30, real=real, predicted=real[:, :, ::-1], masks=masks
    )


def pictures() -> ReportPictures:
    image = np.full((24, 32, 3), 90, np.uint8)
    depth = np.linspace(0, 2, 24 * 32, dtype=np.float32).reshape(24, 32)
    tile = RolloutTile(rollout=0, time_s=0.5, image=image, depth_m=depth, mask=(depth > 1).astype(np.uint8))
    return ReportPictures([strip()], [tile])


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("report")
    write_report(folder, result(), pictures())
    return folder, (folder / "report.html").read_text(encoding="utf-8")


def test_the_page_loads_nothing_from_elsewhere(page: tuple[Path, str]) -> None:
    folder, html = page
    tags = Tags()
    tags.feed(html)
    assert tags.faults == []
    assert tags.open == []
    files = [address for address in tags.addresses if not address.startswith("data:image/")]
    assert files == list(result().paths.values()) and len(files) < len(tags.addresses)
    assert all(address.startswith("data:image/") for address in re.findall(r"url\((.*?)\)", html))
    assert re.findall(r"https?://", html) == []
    assert "@import" not in html
    assert (folder / "report.html").stat().st_size < 10e6


@pytest.mark.parametrize(
    "words",
    [
        "6.3 mm",  # translation, rounded
        "7.2 deg",
        "21.4 dB",
        "210 mm",  # frozen
        "0.282",
        "0.262 to 0.302",
        "0.270",  # the true friction
        "on bound",
        "1 of 1 intervals contain the true value",
        "47 of 48",
        "0.24 mm",  # camera centres
        "+0.019 %",
        "0.977",
        "1.75 mm",
        "496 labelled images",
        "120.2 s",
        "0.68 GiB",
        "did not converge: the search found nothing",
        "ab" * 32,
    ],
)
def test_the_page_has_the_numbers(page: tuple[Path, str], words: str) -> None:
    assert words in page[1]


def test_what_files_say_is_no_html(page: tuple[Path, str]) -> None:
    assert "&lt;b&gt;bold&lt;/b&gt; &amp; more" in page[1]
    assert "something &lt;odd&gt;" in page[1]


def test_the_json_holds_the_same(page: tuple[Path, str]) -> None:
    assert read_json(page[0] / "report.json", DemoResult) == result()
    assert json.loads((page[0] / "report.json").read_text())["format"] == "cgwm-demo/1"


def test_the_verdict_is_honest() -> None:
    good = evaluation()
    assert verdict_text(good, targets_of(good), 0.1) == (
        "Having seen 0.1 s of a test episode, the model predicts the rest of the motion with errors of 6.3 mm and "
        "7.2 deg (medians). Rendered, the object agrees with the recorded frames to 21.4 dB PSNR. All targets are met "
        "(15 mm, 15 deg, 20 dB). Assuming that the object does not move gives an error of 210 mm."
    )
    bad = evaluation(turn_deg=16.3, frozen_m=0.008)
    targets = targets_of(bad)
    assert [target.met for target in targets] == [True, False, True]
    text = verdict_text(bad, targets, 0.1)
    assert "Target missed: rotation error 16.3 deg (target: below 15 deg)." in text
    assert "hardly better than assuming that the object does not move, with an error of 8.0 mm." in text


def test_a_figure_without_a_value_misses_its_target() -> None:
    blind = evaluation().model_copy(update={"psnr_object_db": None})
    targets = targets_of(blind)
    assert [target.met for target in targets] == [True, True, False]
    assert "PSNR within the object – (target: at least 20 dB)" in verdict_text(blind, targets, 0.1)


def test_the_summary_of_the_command() -> None:
    fitted = ImagesOnlyFit(outcome="fitted", evaluation=evaluation(turn_deg=30.0))
    lines = demo._summary(result(images_only=fitted), Path("out/demo")).splitlines()
    assert lines[0].startswith("Having seen 0.1 s of a test episode")
    assert lines[1:5] == [
        "  medians over the test episodes    model    frozen  ballistic  target",
        "  translation error                6.3 mm  210.0 mm  2310.0 mm  < 15.0 mm, met",
        "  rotation error                  7.2 deg  88.0 deg  121.0 deg  < 15.0 deg, met",
        "  PSNR within the object          21.4 dB         -          -  >= 20.0 dB, met",
    ]
    assert [line.split() for line in lines if "friction" in line] == [
        ["friction", "0.282", "0.262", "to", "0.302", "0.27", "1"]
    ]
    assert "Physics from the video frames alone: 6.3 mm and 30.0 deg (medians; without a target)." in lines
    assert lines[-1] == "Report: out/demo/report.html"


def test_true_values_go_by_the_names_of_the_model() -> None:
    from cgwm.datasets.synthetic.truth import TrueContact, TrueObject, TruthFile
    from cgwm.schemas import CamerasFile, Scale

    truth = TruthFile(
        scene="fall",
        seed=0,
        object=TrueObject(family="box", mass_kg=0.5, com_m=(0, 0, 0.01), inertia_kg_m2=(1, 1, 1, 0, 0, 0)),
        contact=TrueContact(friction=0.3, natural_time_s=0.004, damping_ratio=0.0, impedance=0.95, timestep_s=0.001),
        cameras=CamerasFile(scale=Scale(kind="metric"), cameras={}),
        gain_rgb={},
        episodes={},
    )
    true = true_parameters(truth)
    assert true["restitution"] == pytest.approx(1.0)  # a spring without damping gives all speed back
    assert true["stiffness_n_m"] == pytest.approx(0.5 / 0.004**2)
    assert true["object.com_z_m"] == 0.01


def test_distance_to_spheres() -> None:
    points = np.array([[2.0, 0, 0], [0, 0, 0], [0, 0.75, 0]])
    gap = sphere_distance(points, np.array([[0.0, 0, 0], [3.0, 0, 0]]), np.array([0.5, 0.25]))
    np.testing.assert_allclose(gap, [0.75, -0.5, 0.25])


def test_tiles_show_where_the_object_moves() -> None:
    real, predicted = tiles(strip(), 96)
    assert real.shape == predicted.shape == (12, 72, 96, 3)
    yellow = (np.abs(predicted.astype(int) - (255, 214, 10)).sum(-1) < 90).sum((1, 2))
    assert (yellow > 20).all()  # the outline of the mask, in every frame


def test_more_frames_are_shown_while_the_object_moves() -> None:
    chosen = telling(strip(), 5)
    assert chosen[0] == 0
    assert chosen[-1] == 11
    assert sum(k <= 6 for k in chosen) >= 4


def test_a_picture_is_made_to_fit() -> None:
    noisy = np.random.default_rng(0).integers(0, 255, (200, 300, 3)).astype(np.uint8)
    data = small_png(noisy, 60_000)
    assert len(data) <= 60_000
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None


def test_a_picture_of_another_shape_lies_in_the_middle_of_its_tile() -> None:
    tile = _fitted(np.zeros((10, 40, 3), np.uint8), (80, 60))
    dark = tile.sum(-1) == 0
    rows, columns = np.nonzero(dark)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (20, 39, 0, 79)
    assert dark[20:40].all() and (tile[~dark] == 255).all()


def test_the_window_holds_what_moves_with_a_margin() -> None:
    masks = np.zeros((2, 120, 160), np.uint8)
    masks[0, 40:60, 30:40], masks[1, 50:70, 50:60] = 1, 1
    frames = np.zeros((2, 120, 160, 3), np.uint8)
    strip = FrameStrip(episode="0", camera="c", times_s=np.arange(2.0), real=frames, predicted=frames, masks=masks)
    left, top, width, height = _window(strip)
    assert (width, height) == (56, 42)  # 30 by 30 pixels and a fifth at each side, at 4:3
    assert (left + width / 2, top + height / 2) == (45, 55)


def test_charts_break_where_values_are_missing() -> None:
    chart = Chart(
        title="error [mm]",
        times_s=[0.0, 0.1, 0.2, 0.3],
        lines=[Line("model", "model", [1.0, None, 10.0, 1000.0])],
        low=1.0,
        high=100.0,
    )
    (path,) = re.findall(r'<path class="line model" d="(.*?)"', chart_svg(chart))
    heights = [float(y) for y in re.findall(r"[ML][\d.]+ ([\d.]+)", path)]
    assert path.count("M") == 2
    assert heights[0] > heights[1] > heights[2]  # up is more; what is off the scale stays on its rim
    assert heights[2] == pytest.approx(26.0)


def test_scales_hold_all_values() -> None:
    assert decades([], 0.1) == (0.1, 1.0)
    assert decades([0.004, 5.0], 0.1) == (0.1, 10.0)


def test_the_interval_is_drawn_with_the_truth() -> None:
    svg = interval_svg(2.0, (1.0, 3.0), 0.0)
    assert 'class="true" x1="6.0"' in svg
    assert 'class="bar" x1="42.0" x2="114.0"' in svg


def test_numbers() -> None:
    assert [number(x) for x in (121003.7, 0.0936, 1e-19, 9.996, 0.0999999)] == [
        "121000",
        "0.0936",
        "0",
        "10.0",
        "0.100",
    ]


def test_a_page_lists_its_contents_and_each_entry_leads_to_a_section() -> None:
    made = whole("t", ["<h1>t</h1>", *(section(name, "x") for name in ("One", "Two & three", "Four"))])
    anchors = re.findall(r'<a href="#([^"]+)">', made)
    assert anchors == ["one", "two-three", "four"]
    assert all(f'<h2 id="{anchor}">' in made for anchor in anchors)
    assert made.index("<nav") < made.index("<section>")
    assert "<nav" not in whole("t", [section("One", "x"), section("Two", "x")])


def test_a_wide_table_names_the_column_of_each_cell_and_a_narrow_one_does_not() -> None:
    assert table(["a", "b", "c", "d"], [["1", "2", "3", "4"]]).count("data-label") == 4
    assert "data-label" not in table(["a", "b", "c"], [["1", "2", "3"]])
    assert 'class="wide sortable"' in table(["a", "b", "<c>", "d"], [["1"] * 4], sorts=True)


def test_links_are_relative_to_the_page_and_commands_are_text(tmp_path: Path) -> None:
    assert link("m & 0", tmp_path / "a b" / "m0", tmp_path / "p" / "x.html") == '<a href="../a%20b/m0">m &amp; 0</a>'
    assert command("cgwm fit <x>") == "<pre><code>cgwm fit &lt;x&gt;</code></pre>"


def test_a_plot_places_its_points_and_interrupts_lines_where_nothing_is_known() -> None:
    line = Series(name="l", points=[(0, 0), (1, 1), (2, float("nan")), (3, 3), (4, 4)])
    made = plot_svg(Plot(title="t", x="x", series=[line], equal=True))
    path = re.search(r'stroke-width:2" d="([^"]+)"', made)
    assert path is not None
    (x0, y0), (x1, y1), (x3, y3), _ = [tuple(map(float, p.split())) for p in re.split("[ML]", path[1])[1:]]
    assert path[1].count("M") == 2
    assert (x3 - x0, y0 - y3) == pytest.approx((3 * (x1 - x0), 3 * (y0 - y1)), abs=0.3)
    assert x1 - x0 == pytest.approx(y0 - y1, abs=0.2)
    assert plot_svg(Plot(title="t", x="x", series=[Series(name="l", points=[])])) == ""


def test_bars_are_in_proportion_and_none_is_negative() -> None:
    made = bars(
        [Bar(name="a", value=4, words="4"), Bar(name="b", value=1, words="1"), Bar(name="c", value=-1, words="-1")]
    )
    assert re.findall(r"width:([\d.]+)%", made) == ["100.0", "25.0", "0.0"]
