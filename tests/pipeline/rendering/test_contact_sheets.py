"""Pictures of reports: colours of masks, the window in which an object moves, outlines, and small files."""

import base64
import re
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from cgwm.pipeline.demo.episode_section import _tile
from cgwm.pipeline.rendering.contact_sheets import (
    MAX_SIDE,
    TILE_WIDTH,
    FrameStrip,
    _outline,
    _window,
    columns_and_rows,
    compared,
    depth_colors,
    jpeg_uri,
    label_colors,
    png_uri,
    separated,
    small_png,
    sprite,
    telling,
    tiles,
)


def test_bodies_have_colours_of_their_own_and_the_background_none() -> None:
    colors = label_colors(np.arange(6, dtype=np.uint8)[None])[0]
    assert len({tuple(color) for color in colors[:5]}) == 5
    assert (colors[5] == colors[1]).all() and colors[0].sum() < 128


def test_the_window_is_centred_on_what_moves_with_a_margin() -> None:
    masks = np.zeros((2, 120, 160), np.uint8)
    masks[0, 40:60, 70:80] = 1
    masks[1, 50:70, 80:100] = 2  # together rows 40 to 70, columns 70 to 100
    frames = np.zeros((2, 120, 160, 3), np.uint8)
    strip = FrameStrip(episode="a", camera="c", times_s=np.arange(2.0), real=frames, predicted=frames, masks=masks)
    left, top, width, height = _window(strip)
    assert abs(left + width / 2 - 85) <= 1 and abs(top + height / 2 - 55) <= 1
    assert 1.2 * 30 <= height <= 1.5 * 30 and abs(width / height - 4 / 3) < 0.05


def test_an_outline_lies_on_the_edge_of_the_mask() -> None:
    frame, mask = np.zeros((60, 60, 3), np.uint8), np.zeros((60, 60), np.uint8)
    mask[20:40, 20:40] = 1
    _outline(frame, mask)
    drawn = frame.sum(-1) > 0
    assert drawn[20, 20:40].all() and drawn[20:40, 39].all()
    assert not drawn[23:37, 23:37].any() and not drawn[:17].any()


@pytest.mark.parametrize("count", [1, 15, 32])
def test_many_frames_fit_into_a_texture_and_each_is_shown_at_its_place(count: int) -> None:
    frames = np.broadcast_to(np.arange(count, dtype=np.uint8)[:, None, None, None], (count, 198, TILE_WIDTH, 3))
    picture, (columns, rows) = sprite(frames), columns_and_rows(count, TILE_WIDTH)
    assert max(picture.shape) <= MAX_SIDE
    for frame in range(count):
        found = re.search(r"position:([0-9.]+)% ([0-9.]+)%", _tile("f0", frame, count, "real"))
        assert found is not None
        # as browsers place a picture of so many tiles: 0 % is its first one, 100 % its last
        across, down = (
            round(float(share) / 100 * (of - 1)) for share, of in zip(found.groups(), (columns, rows), strict=True)
        )
        shown = picture[198 * down : 198 * (down + 1), TILE_WIDTH * across : TILE_WIDTH * (across + 1)]
        assert shown.shape == (198, TILE_WIDTH, 3) and (shown == frame).all()


def test_a_small_picture_keeps_its_brightness() -> None:
    rng = np.random.default_rng(0)
    image = np.clip(cv2.GaussianBlur(rng.normal(100, 200, (80, 80, 3)), (0, 0), 3), 0, 255).astype(np.uint8)
    data = small_png(image, 5000)
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert len(data) <= 5000 and found is not None
    assert abs(float(found.mean()) - float(image.mean())) < 3


def test_noise_becomes_a_smaller_picture_of_the_same_shape() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    data = small_png(noise, 2000)
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert len(data) <= 2000 and found is not None
    assert 20 < found.shape[1] < 90 and abs(found.shape[1] / found.shape[0] - 1.5) < 0.1


def test_errors_are_means_of_the_channels_in_tiles_with_margins() -> None:
    photos = [np.zeros((30, 40, 3), np.uint8), np.zeros((40, 20, 3), np.uint8)]
    renders = [photo.copy() for photo in photos]
    renders[1][..., 2] = 96  # 32 on average, half of what saturates
    sheet = compared(photos, renders, width=40)
    assert sheet.shape == (3 * 30 + 8, 2 * 40 + 4, 3)
    error = sheet[-30:, 44:]
    magma = cv2.applyColorMap(np.full((1, 1), 128, np.uint8), cv2.COLORMAP_MAGMA)[0, 0, ::-1]
    assert (error[:, 12:27] == magma).all()  # 15 of 40 pixels wide, as 20 of 40 are at a height of 30
    assert (error[:, :12] == 255).all() and (error[:, 27:] == 255).all()


@pytest.mark.parametrize("late", [True, False])
def test_frames_are_chosen_where_the_object_moves(late: bool) -> None:
    masks = np.zeros((12, 20, 60), np.uint8)
    for k in range(12):
        left = 4 * (max(0, k - 6) if late else min(k, 5))
        masks[k, 5:15, left : left + 10] = 1
    frames = np.zeros((12, 20, 60, 3), np.uint8)
    strip = FrameStrip(episode="a", camera="c", times_s=np.arange(12.0), real=frames, predicted=frames, masks=masks)
    chosen = telling(strip, 5)
    assert chosen[0] == 0 and chosen[-1] == 11 and sum((k > 6) == late for k in chosen) >= 3 + (not late)


def test_separated_bodies_are_bright_on_a_dimmed_background_four_in_a_row() -> None:
    photo, mask = np.full((30, 40, 3), 90, np.uint8), np.zeros((30, 40), bool)
    mask[8:22, 10:30] = True
    sheet = separated([photo] * 5, [mask] * 5, width=80)
    assert sheet.shape == (2 * 60 + 4, 4 * 80 + 3 * 4, 3)  # as high as a photo at this width
    assert sheet[30, 40].tolist() == [90, 90, 90] and sheet[4, 4].tolist() == [30, 30, 30]
    assert sheet[64 + 30, 40].tolist() == [90, 90, 90] and (sheet[64:, 84:] == 255).all()


def test_near_depths_are_bright_and_what_has_no_surface_is_black() -> None:
    depth = np.array([[0.0, 0.5, 1.0, 1.5, 2.0, 9.0]], np.float32)
    shown = depth_colors(depth, 1.0, 2.0)
    viridis = cv2.applyColorMap(np.array([[255, 255, 127, 0, 0]], np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    assert shown[0, 0].tolist() == [0, 0, 0]
    np.testing.assert_array_equal(shown[0, 1:], viridis[0])
    assert depth_colors(depth, 1.0, 1.0)[0, 1].tolist() == viridis[0, 0].tolist()  # all of one depth


@pytest.mark.parametrize(("made", "kind", "error"), [(jpeg_uri, "jpeg", 6), (png_uri, "png", 0)])
def test_a_picture_in_a_page_is_read_back_in_its_colours(made: Callable, kind: str, error: int) -> None:
    picture = np.full((16, 24, 3), [200, 120, 40], np.uint8)
    uri = made(picture)
    assert uri.startswith(f"data:image/{kind};base64,")
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    read = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(read, picture, atol=error)


def test_the_true_outline_is_drawn_on_predictions_where_it_is_known_and_wanted() -> None:
    frames, masks = np.full((2, 120, 160, 3), 90, np.uint8), np.zeros((2, 120, 160), np.uint8)
    masks[:, 40:80, 60:110] = 1
    known = FrameStrip(episode="a", camera="c", times_s=np.arange(2.0), real=frames, predicted=frames, masks=masks)
    marked = {outlined: tiles(known, outlined=outlined) for outlined in (True, False)}
    plain = tiles(replace(known, masks=None))
    assert (marked[True][0] == 90).all() and (marked[True][1] != 90).any()
    assert all((pictures == 90).all() for pictures in (*marked[False], *plain))
