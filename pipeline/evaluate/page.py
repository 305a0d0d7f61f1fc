"""The page of an evaluation: figures by episode, silhouettes over time, and frames as filmed and as predicted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...datasets.capture.capture import Capture
from ...schemas import EpisodeErrors, ErrorSummary, EvalResult, FilmedErrors
from ..rendering.contact_sheets import contact_sheet, jpeg_uri, telling, tiles
from ..report.page import cautions, facts, fixed, page, paragraph, section, table, text
from ..report.page_file import links_beside, made_of
from ..report.plots import Plot, Series, legend, plot_svg
from .evaluation import Evaluation
from .frame_strips import strips_of

COLUMNS = 8
"""Number of frames of a camera that are shown."""
MOST_EPISODES = 6
"""Maximum number of episodes with frames."""
BY_IMAGES = (
    "Poses were found in the videos with the model's shape and colours and the calibrated cameras; predictions begin "
    "with the first of them and are compared with the others. An error of the physics is in the figures; an error of "
    "shape, scale or cameras is in the predictions and in the poses alike, and is not. The distance of triangulated "
    "centroids takes nothing but masks and cameras from the videos, and is that of the middles of the silhouettes, "
    "which is not the body's origin. In brackets: 95 %."
)


def mark_of(place: Path, model: Path, target: Path, split: str) -> str:
    """Return by what the page of an evaluation is recognised, see `page_file.made_of`."""
    return made_of(place, "eval", [model, target], split)


def evaluation_html(
    evaluation: Evaluation, capture: Capture, place: Path, model: Path, split: str, mark: str = ""
) -> str:
    """Return the HTML page of an evaluation.

    Args:
        evaluation: The evaluation, with the frames of its videos.
        capture: The capture.
        place: Where the page will lie.
        model: The model's directory.
        split: The split that was predicted.
        mark: By what the page is recognised, see :func:`mark_of`.
    """
    result = evaluation.result
    body = [
        f"<h1>cgwm eval · {text(model.name)} · split {text(split)} of {text(capture.root.name)}</h1>",
        _cards(result),
        cautions(result.warnings),
        section("Episodes", _episodes(result), paragraph(BY_IMAGES, "soft") if result.reference == "images" else ""),
        *_over_time(result.per_episode),
        *_frames(evaluation, capture),
        section("Files", facts(links_beside(place, [model], capture.root))),
    ]
    return page(f"cgwm eval: {model.name}", [part for part in body if part], made_of=mark)


def _cards(result: EvalResult) -> str:
    figures: tuple[tuple[str, ErrorSummary | None, float, str], ...] = (
        ("translation", result.translation_error_m, 1e3, "mm"),
        ("rotation", result.rotation_error_deg, 1.0, "deg"),
        ("PSNR within the object", result.psnr_object_db, 1.0, "dB"),
        ("overlap with the masks", result.mask_iou, 100.0, "%"),
        ("triangulated centroids", result.centroid_error_m, 1e3, "mm"),
    )
    cards = [
        f'<div class="card"><div>{name}: median</div>'
        f'<div class="value">{fixed(one.median, 1, scale)} {unit}</div></div>'
        for name, one, scale, unit in figures
        if one is not None
    ]
    return f'<div class="cards">{"".join(cards)}</div>'


def _episodes(result: EvalResult) -> str:
    header = ["episode", "translation [mm]", "at the end [mm]", "rotation [deg]", "centroids [mm]", "IoU [%]"]
    header += ["centroids [px]", "outlines [px]", "PSNR object [dB]", "SSIM [%]"]
    rows = [
        [
            text(one.episode),
            fixed(one.translation_error_m, 1, 1e3) + _span(one.translation_interval_95_m, 1e3),
            fixed(one.translation_final_m, 1, 1e3),
            fixed(one.rotation_error_deg, 1) + _span(one.rotation_interval_95_deg, 1.0),
            fixed(one.centroid_error_m, 1, 1e3) + _span(one.centroid_interval_95_m, 1e3),
            fixed(one.mask_iou, 1, 100.0),
            fixed(one.centroid_error_px, 1),
            fixed(one.outline_error_px, 1),
            fixed(one.psnr_object_db, 1),
            fixed(one.ssim, 1, 100.0),
        ]
        for one in result.per_episode
    ]
    shown = [k for k in range(len(header)) if k == 0 or any(row[k] != "–" for row in rows)]
    return table(
        [header[k] for k in shown], [[row[k] for k in shown] for row in rows], range(1, len(shown)), sorts=True
    )


def _span(interval: tuple[float, float] | None, scale: float) -> str:
    return "" if interval is None else f" ({fixed(interval[0], 1, scale)} to {fixed(interval[1], 1, scale)})"


def _over_time(episodes: Sequence[EpisodeErrors]) -> list[str]:
    """Return the section of the silhouettes over time; none without masks."""
    filmed = [one for one in episodes if one.filmed][:MOST_EPISODES]
    if not filmed:
        return []
    pieces = []
    for one in filmed:
        overlap = [_series(video, k, video.mask_iou) for k, video in enumerate(one.filmed)]
        away = [_series(video, k, video.centroid_error_px) for k, video in enumerate(one.filmed)]
        pieces.append(plot_svg(Plot(title=f"{one.episode}: IoU of silhouette and mask", x="time [s]", series=overlap)))
        pieces.append(
            plot_svg(Plot(title=f"{one.episode}: centroids apart [px]", x="time [s]", series=away, zero=True))
        )
        pieces.append(legend(overlap))
    return [section("Silhouettes over time", *pieces)]


def _series(video: FilmedErrors, number: int, values: Sequence[float | None]) -> Series:
    points = [
        (time, float("nan") if value is None else value)
        for time, value in zip(video.time_s, values, strict=True)
        if time is not None
    ]
    return Series(name=video.camera, points=points, color=f"m{number % 6}")


def _frames(evaluation: Evaluation, capture: Capture) -> list[str]:
    """Return the section of the frames; none without videos."""
    pieces = []
    for strip in strips_of(evaluation.episodes[:MOST_EPISODES], capture):
        chosen = telling(strip, COLUMNS)
        real, predicted = (frames[np.array(chosen)] for frames in tiles(strip))
        sheet = jpeg_uri(contact_sheet([real, predicted]))
        words = f"{strip.episode}, {strip.camera}: above as filmed, below as predicted"
        pieces.append(f'<figure><img src="{sheet}" alt="{text(words)}" style="width:100%">')
        outline = "; the outline is that of the mask" if strip.masks is not None else ""
        pieces.append(f"<figcaption>{text(words + outline)}.</figcaption></figure>")
    return [section("Frames", *pieces)] if pieces else []
