"""The viewer: where things are at a moment, what is refused, and the page in a browser."""

import importlib.util
import os
import re
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from cgwm.cli import main
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.models.model import read_model, write_model
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.datasets.rollouts.replay import Replay
from cgwm.pipeline.geometry.viewpoint import look_at
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.view import open_replays, open_view
from cgwm.pipeline.view import viewer as viewing
from cgwm.pipeline.view.client_page import with_whole_corners
from cgwm.pipeline.view.door import Door
from cgwm.pipeline.view.motions import can_move, own_motion, recorded_motion, still
from cgwm.pipeline.view.scene_at import LONGEST_ARROW, background_from, radius_m, scene_at, shapes_of, viewpoint
from cgwm.pipeline.view.viewer import FIELD_OF_VIEW_RAD
from cgwm.schemas import Light, SamplingPlan, Surface, SynthesizeConfig, UsageError, Viewpoint
from helpers.browser import Page, chromium
from helpers.forked import Forked
from helpers.small_model import HALF, small_model, write_small_model
from helpers.tray import bowl, in_tray

CONFIG = SynthesizeConfig(rollouts=2, duration_s=0.5, width=64, height=48, device="cpu", seed=5)
VISER = importlib.util.find_spec("viser") is not None
needs_viser = pytest.mark.skipif(not VISER, reason="viser is not installed: pip install 'cgwm[view]'")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("view")
    plan = SamplingPlan(parameter_spread=0.0)
    config = CONFIG.model_copy(update={"plan": plan})
    synthesize(write_small_model(folder / "model"), folder / "dataset", config)
    return folder / "dataset"


@pytest.fixture(scope="module")
def red_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A red cube before a white background."""
    folder = tmp_path_factory.mktemp("red")
    model = small_model()
    splats = replace(model.body_splats["cube"], colors=np.tile([0.9, 0.05, 0.05], (400, 1)))
    write_model(folder / "model", replace(model, body_splats={"cube": splats}, scene=None))
    synthesize(folder / "model", folder / "dataset", CONFIG)
    return folder / "dataset"


# Where things are


# In the suite: scenes of the model's own motion are tested below.
@pytest.mark.evidence
def test_a_recorded_moment_is_what_lies_in_the_file(dataset: Path) -> None:
    reader = RolloutReader(dataset)
    motion = recorded_motion(reader, 1)
    impulse = np.linalg.norm(reader.read(1, "contacts/impulse_world"), axis=1)
    assert motion.largest_impulse_n_s == impulse.max() > 0
    offsets = reader.read(1, "contacts/offsets")
    row = int(impulse.argmax())
    frame = int(np.searchsorted(offsets, row, side="right")) - 1
    now = scene_at(motion, frame, 0.1)
    np.testing.assert_array_equal(now.position_m, reader.read(1, "bodies/pos")[frame])
    np.testing.assert_array_equal(now.quat_wxyz, reader.read(1, "bodies/quat_wxyz")[frame])
    assert now.time_s == reader.read(1, "time")[frame] and now.largest_impulse_n_s == impulse.max()
    own = row - offsets[frame]
    np.testing.assert_array_equal(now.marks.points_m[own], reader.read(1, "contacts/pos_world")[row])
    # The largest impulse has the longest arrow, along the impulse.
    arrow = now.marks.tips_m[own] - now.marks.points_m[own]
    np.testing.assert_allclose(
        arrow, LONGEST_ARROW * 0.1 * reader.read(1, "contacts/impulse_world")[row] / impulse[row]
    )
    assert motion.image is not None
    np.testing.assert_array_equal(motion.image("view1", frame), reader.read(1, "obs/view1_image")[frame])
    np.testing.assert_array_equal(motion.cameras["view1"].K, reader.read(1, "cameras/view1/K"))


def test_a_models_own_motion_is_what_synthesis_draws_at_the_estimate(dataset: Path) -> None:
    # Another seed and duration than the dataset's: made again with those that the viewer takes.
    model = read_model(dataset / "model")
    config = SynthesizeConfig(rollouts=2, width=16, height=16, device="cpu", plan=SamplingPlan(parameter_spread=0.0))
    synthesize(dataset / "model", dataset.parent / "again", config)
    made, drawn = own_motion(model, 1), recorded_motion(RolloutReader(dataset.parent / "again"), 1)
    np.testing.assert_allclose(made.position_m, drawn.position_m, atol=1e-12)
    np.testing.assert_array_equal(made.times_s, drawn.times_s)
    assert sum(len(rows["mode"]) for rows in made.contacts) > 0
    for own, recorded in zip(made.contacts, drawn.contacts, strict=True):
        for key in ("pos_world", "impulse_world", "mode"):
            np.testing.assert_allclose(own[key], recorded[key], atol=1e-12)


def test_bodies_are_what_collides_and_what_is_seen() -> None:
    model = small_model(driven=True)
    cube, tip = shapes_of(model)
    assert (cube.name, tip.name) == ("cube", "tip")
    np.testing.assert_array_equal(cube.centers_m, model.collision["cube"].means)
    np.testing.assert_array_equal(cube.radii_m, model.collision["cube"].scales * model.body("cube").radius_factor)
    assert not cube.relit
    np.testing.assert_array_equal(cube.colors_at(np.array([1.0, 0, 0, 0])), model.body_splats["cube"].colors)
    assert 0.9 * HALF < radius_m(model, [cube, tip]) < np.sqrt(3) * HALF
    bare = small_model(visible=False)
    assert shapes_of(bare)[0].splats is None and background_from(bare, np.zeros(3)) is None


def test_a_body_that_turns_is_shaded_anew() -> None:
    model = small_model()
    normals = np.tile([0.0, 0.0, 1.0], (400, 1))
    splats = replace(model.body_splats["cube"], normals=normals)
    file = model.file.model_copy(update={"light": Light(lamp=(0.0, 0.0, 0.5), sky=0.0)})
    (shape,) = shapes_of(replace(model, file=file, body_splats={"cube": splats}))
    up, down = np.array([1.0, 0, 0, 0]), np.array([0.0, 1.0, 0, 0])
    assert shape.relit
    np.testing.assert_allclose(shape.colors_at(up), splats.colors)
    # Facing the lamp a surface has brightness 1.5, turned away 1.
    np.testing.assert_allclose(shape.colors_at(down), splats.colors / 1.5, rtol=1e-6)


def test_the_start_is_that_of_the_photos_and_needs_no_physics(tmp_path: Path) -> None:
    model = small_model()
    motion = still(model)
    now = scene_at(motion, 0, 0.1)
    np.testing.assert_array_equal(now.position_m, [[0, 0, HALF]])
    assert len(now.marks) == 0 and motion.largest_impulse_n_s == 0 and motion.cameras == {}
    assert can_move(model)
    assert not can_move(replace(model, file=model.file.model_copy(update={"contact": None})))
    assert not can_move(replace(model, collision={}))


def test_the_first_look_is_at_the_body(dataset: Path) -> None:
    model, motion = read_model(dataset / "model"), recorded_motion(RolloutReader(dataset), 0)
    for one in (motion, still(model)):
        eye, target, up = viewpoint(model, one, 0.08)
        np.testing.assert_array_equal(up, [0, 0, 1])
        assert np.linalg.norm(target - one.position_m[:, 0].mean(0)) < 0.3
        assert eye[2] > target[2] and np.linalg.norm(eye - target) > 0.2


@needs_viser
def test_photos_without_bodies_are_seen_as_in_the_middle_one(tmp_path: Path) -> None:
    seen = Viewpoint(eye_m=(1, 2, 3), target_m=(1, 5, 3), up=(0, 0.6, 0.8))
    model = small_model()
    file = model.file.model_copy(update={"bodies": (), "contact": None, "parameters": (), "first_view": seen})
    write_model(tmp_path / "model", replace(model, file=file, body_splats={}, collision={}))
    with open_view(tmp_path / "model", port=0) as viewer:
        for found, wanted in zip(viewer._view, (seen.eye_m, seen.target_m, seen.up), strict=True):
            np.testing.assert_array_equal(found, wanted)
        assert viewer._looks.value and viewer._background is not None
    older = replace(model, file=file.model_copy(update={"first_view": None}), body_splats={}, collision={})
    assert np.isfinite(viewpoint(older, still(older), 0.1)).all()


# What is refused


def refused(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    out, err = capfd.readouterr()
    assert (ended.value.code, out) == (2, "")
    return err


def test_a_missing_viser_is_one_clear_message(
    dataset: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    err = refused(capfd, "view", dataset)
    assert err == "'cgwm view' needs the package viser.\nNext: pip install 'cgwm[view]'.\n"


@needs_viser
def test_motions_that_go_on_are_followed() -> None:
    def moved(frames: int, first: int = 0) -> Replay:
        times = 0.1 * np.arange(first, first + frames)
        place, turn = np.zeros((frames, 1, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1, 1))
        place[:, 0, 0] = times
        return Replay(times_s=times, position_m=place, quat_wxyz=turn)

    more = [{"seed 0": moved(6, 2)}, {}, {"seed 1": moved(2), "seed 0": moved(9)}]
    with open_replays("run", small_model(), {"seed 0": moved(4)}, port=0, more=lambda: more.pop(0)) as viewer:
        viewer._frame.value = 3
        viewer.follow()
        assert (viewer._frame.value, viewer._frame.max) == (1, 5)  # the same moment, as two frames are gone
        assert "**0.300 s**, frame 2 of 6" in viewer._status.content
        viewer.follow()
        assert (viewer._frame.value, viewer._frame.max) == (1, 5)
        viewer.follow()
        assert (viewer._choice.value, viewer._choice.options) == ("seed 1", ("seed 0", "seed 1"))
        assert "frame 1 of 2" in viewer._status.content


@needs_viser
def test_fixed_surfaces_are_in_the_scene(tmp_path: Path) -> None:
    shape, mesh = bowl()
    others = [
        {"name": "post", "pose": {"position_m": (0.1, 0.2, 0.3)}, "cylinder": {"radius_m": 0.1, "half_length_m": 0.2}},
        {"name": "sheet", "rectangle": {"half_extents_m": (0.1, 0.2)}},
        {"name": "floor", "half_space": {}},
        {"name": "block", "box": {"half_extents_m": (0.1, 0.2, 0.3)}},
    ]
    write_model(tmp_path / "model", in_tray((shape, *map(Surface.model_validate, others)), mesh))
    with open_view(tmp_path / "model", port=0) as viewer:
        nodes = {node.name: node for node in viewer._surfaces}
        assert set(nodes) == {f"/surfaces/{name}" for name in ("bowl", "post", "sheet", "floor", "block")}
        np.testing.assert_allclose(nodes["/surfaces/post"].position, (0.1, 0.2, 0.3))
        np.testing.assert_allclose(np.abs(nodes["/surfaces/block"].vertices).max(0), (0.1, 0.2, 0.3), rtol=1e-6)
        post = np.asarray(nodes["/surfaces/post"].vertices)
        np.testing.assert_allclose([np.linalg.norm(post[:, :2], axis=1).max(), post[:, 2].max()], (0.1, 0.2), rtol=1e-6)
        assert len(nodes["/surfaces/bowl"].faces) == len(mesh.faces)


@needs_viser
def test_what_cannot_be_looked_at_is_refused(dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert "no such directory" in refused(capfd, "view", tmp_path / "nothing")
    assert "neither a dataset nor a model" in refused(capfd, "view", tmp_path)
    (tmp_path / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    assert ": a capture.\nAllowed: a directory with dataset.json or model.json." in refused(capfd, "view", tmp_path)
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "model.json").write_text("{}")
    assert "model.json" in refused(capfd, "view", broken)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        err = refused(capfd, "view", dataset, "--port", port)
    assert f"127.0.0.1, port {port}: " in err and "--port 0" in err


# The door

LOCAL = "127.0.0.1:8080"


@pytest.mark.parametrize(
    ("path", "hosts", "origins", "opens"),
    [
        ("/SECRET/", [LOCAL], [], True),
        ("/SECRET", [LOCAL], [f"http://{LOCAL}"], True),
        ("/SECRET/?websocket=ws://x", ["localhost:9000"], ["http://localhost:9000"], True),  # through an SSH tunnel
        ("/SECRET/", ["[::1]:8080"], ["http://[::1]:8080"], True),
        ("/", [LOCAL], [], False),
        ("/secret/", [LOCAL], [], False),
        ("/x/SECRET", [LOCAL], [], False),
        ("/?SECRET", [LOCAL], [], False),
        ("/\u00e9", [LOCAL], [], False),
        ("/SECRET/", [LOCAL], ["http://evil.example"], False),
        ("/SECRET/", [LOCAL], ["null"], False),
        ("/SECRET/", [LOCAL], ["http://127.0.0.1:9999"], False),  # another server of this machine
        (
            "/SECRET/",
            ["evil.example:8080"],
            ["http://evil.example:8080"],
            False,
        ),  # a name that leads here
        ("/SECRET/", ["localhost.evil.example"], [], False),
        ("/SECRET/", [], [], False),
        ("/SECRET/", [LOCAL, LOCAL], [], False),
    ],
)
def test_only_the_page_itself_gets_an_answer(path: str, hosts: list[str], origins: list[str], opens: bool) -> None:
    door = Door("127.0.0.1")
    reason = door.refusal(path.replace("SECRET", door.secret), hosts, origins)
    assert (reason == "") == opens, reason


def test_a_server_for_the_network_answers_to_every_name_but_not_without_the_secret() -> None:
    door = Door("0.0.0.0")
    assert door.refusal(f"/{door.secret}/", ["lab.example:8080"], ["http://lab.example:8080"]) == ""
    assert door.refusal("/", ["lab.example:8080"], ["http://lab.example:8080"])
    assert door.refusal(f"/{door.secret}/", ["lab.example:8080"], ["http://evil.example"])
    assert len({Door("0.0.0.0").secret for _ in range(9)}) == 9


@needs_viser
def test_the_scene_is_not_for_other_pages(dataset: Path) -> None:
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    protocol = f"viser-v{viser.__version__}"
    with open_view(dataset, port=0) as viewer:
        page = viewer.url.replace("http://", "ws://").rstrip("/")
        bare = page.rpartition("/")[0]
        for address, origin in ((bare, None), (f"{bare}/x", None), (page, "http://evil.example"), (bare, bare)):
            with pytest.raises(InvalidStatus) as refusal:
                connect(address, origin=origin, subprotocols=[protocol])
            assert refusal.value.response.status_code == 403
        own = bare.replace("ws://", "http://")
        for origin in (None, own):
            with connect(page, origin=origin, subprotocols=[protocol], max_size=None) as client:
                assert len(client.recv(timeout=30)) > 0
        for address, status in ((viewer.url, 200), (own, 403), (f"{viewer.url}../../etc/passwd", 404)):
            assert http_status(address) == status
        assert http_status(viewer.url, {"Host": "evil.example"}) == 403


def http_status(address: str, headers: dict[str, str] | None = None) -> int:
    try:
        with urlopen(Request(address, headers=headers or {}), timeout=30) as answer:
            return answer.status
    except HTTPError as error:
        return error.code


@needs_viser
def test_a_viser_that_cannot_be_guarded_is_not_used(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewing, "guarded", lambda door, host: nullcontext())
    with pytest.raises(UsageError, match="cannot be kept from showing the scene"):
        open_view(dataset, port=0)


# In the browser


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Callable[[Path], str]]:
    """Start `cgwm view` on a free port; yield a function that returns its URL; end it by Ctrl-C, cleanly."""
    started: list[Forked] = []

    def serve(thing: Path) -> str:
        process = Forked("view", thing, "--port", "0", "--no-open", before=lambda: os.chdir(tmp_path))
        started.append(process)
        end = time.monotonic() + 60
        while not process.printed()[0].endswith("\n"):
            assert process.poll() is None and time.monotonic() < end, process.printed()
            time.sleep(0.02)
        line = process.printed()[0]
        found = re.fullmatch(r"Showing .* at (http://127\.0\.0\.1:\d+/[\w-]{32}/) \(Ctrl-C ends it\)\.\n", line)
        assert found, process.printed()
        return found[1]

    yield serve
    for process in started:
        with process:
            first = process.printed()[0]
            process.send_signal(signal.SIGINT)
            done = process.ended(30)
            assert (done.returncode, done.stdout, done.stderr) == (0, first, "")


def red(page: Page) -> np.ndarray:
    """Return the places (N, 2), x and y [px], of all red pixels."""
    picture = page.screenshot().astype(int)
    return np.argwhere((picture[..., 0] > 120) & (picture[..., 1:].max(-1) < 80))[:, ::-1] + 0.5


def eventually(page: Page, right: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Return the red pixels once they are right; software WebGL shows what it was told only after a while."""
    for _ in range(120):
        found = red(page)
        if right(found):
            return found
        page.run("new Promise(done => setTimeout(done, 500))")
    raise AssertionError(f"{len(found)} red pixels about {found.mean(0) if len(found) else None} to the end")


def expected(page: Page, dataset: Path, frame: int) -> tuple[np.ndarray, float]:
    """Return where the first look shows the cube's middle (2,) [px], and about how many pixels its face has."""
    model, motion = read_model(dataset / "model"), recorded_motion(RolloutReader(dataset), 0)
    eye, target, up = viewpoint(model, motion, radius_m(model, shapes_of(model)))
    width, height = page.run("(c => [c.clientWidth, c.clientHeight])(document.querySelector('canvas'))")
    focal = 0.5 * height / np.tan(0.5 * FIELD_OF_VIEW_RAD)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(width=width, height=height, K=K, distortion=np.zeros(0), T_world_cam=look_at(eye, target, up))
    pixel, depth = camera.project(motion.position_m[frame, :1])
    return pixel[0], float((2 * HALF * focal / depth[0]) ** 2)


def is_cube(found: np.ndarray, middle: np.ndarray, area: float) -> bool:
    """Tell whether these pixels are about as many as the cube's, and their mean about its middle."""
    return 0.5 * area < len(found) < 3 * area and bool(np.linalg.norm(found.mean(0) - middle) < 0.2 * np.sqrt(area))


def click(page: Page, label: str) -> None:
    """Click a checkbox or a button by its label."""
    found = page.run(
        f"""(() => {{
          const named = [...document.querySelectorAll("label, button")].filter(e => e.innerText.trim() === "{label}");
          const element = named.length && (document.getElementById(named[0].htmlFor) || named[0]);
          if (element) element.click();
          return Boolean(element);
        }})()"""
    )
    assert found, f"nothing is called {label}"


@needs_viser
def test_the_page_of_this_viser_is_changed_and_no_other() -> None:
    import viser

    page = (Path(viser.__file__).parent / "client/build/index.html").read_bytes()
    assert len(with_whole_corners(page)) > len(page)
    assert with_whole_corners(b"const code=1;") == b"const code=1;"


@needs_viser
def test_the_slider_moves_the_splats(red_dataset: Path, tmp_path: Path, served: Callable[[Path], str]) -> None:
    url = served(red_dataset)
    with chromium(tmp_path) as page:
        page.open(url)
        page.until_it_says("frame 1 of 16")
        click(page, "cameras")  # their pictures show the cube, too
        page.run("document.querySelector('[role=slider]').focus()")
        places = []
        for frame in (0, 6):
            page.press("ArrowRight", 39, times=frame)
            page.until_it_says(f"frame {frame + 1} of 16")
            click(page, "overview")  # the arrow keys turn viser's camera, too, the further the slower the machine
            middle, area = expected(page, red_dataset, frame)
            # The splats are where the file says that the cube is: that is neither a blank canvas nor a still one.
            eventually(page, lambda found: is_cube(found, middle, area))  # noqa: B023  called at once
            places.append(middle)
        assert np.linalg.norm(places[1] - places[0]) > 0.5 * np.sqrt(area)
        click(page, "splats")
        eventually(page, lambda found: len(found) == 0)
        click(page, "Play")
        page.until("document.body.innerText.includes('Pause') && !document.body.innerText.includes('frame 7 of 16')")
        assert page.errors == []


@needs_viser
def test_a_model_opens_in_motion(red_dataset: Path, tmp_path: Path, served: Callable[[Path], str]) -> None:
    url = served(red_dataset / "model")
    with chromium(tmp_path) as page:
        page.open(url)
        page.until("document.body.innerText.includes('Pause') && / of 31/.test(document.body.innerText)")
        click(page, "Pause")
        page.run("[...document.querySelectorAll('input')].find(e => e.value === 'rollout 0').click()")
        page.until("[...document.querySelectorAll('[role=option]')].some(e => e.innerText === 'as in the photos')")
        page.run(
            "[...document.querySelectorAll('[role=option]')].find(e => e.innerText === 'as in the photos').click()"
        )
        page.until_it_says("frame 1 of 1")
        resting = eventually(page, lambda found: len(found) > 100).mean(0)
        page.run("[...document.querySelectorAll('input')].find(e => e.value === 'as in the photos').click()")
        page.until("[...document.querySelectorAll('[role=option]')].some(e => e.innerText === 'rollout 0')")
        page.run("[...document.querySelectorAll('[role=option]')].find(e => e.innerText === 'rollout 0').click()")
        page.until_it_says("frame 1 of 31")
        eventually(page, lambda found: len(found) > 100 and bool(np.linalg.norm(found.mean(0) - resting) > 20))
        page.resize(400, 800)  # as narrow as a phone: what is shown is chosen behind one line, below the scene
        page.until("!document.body.innerText.includes('collision spheres')")
        label = "[...document.querySelectorAll('label')].find(e => e.innerText === 'motion')"
        assert page.run(f"{label}.getBoundingClientRect().top") > 0.65 * 800
        page.run("[...document.querySelectorAll('*')].filter(e => e.innerText?.trim() === 'Show').at(-1).click()")
        page.until_it_says("collision spheres")
        assert page.errors == []
