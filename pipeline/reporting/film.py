"""The section with the frames: real above predicted, as a sheet and as a film."""

from __future__ import annotations

from collections.abc import Sequence

from .page import paragraph, section, text
from .pictures import FrameStrip, jpeg_uri, sprite, telling, tiles

SHEET_COLUMNS = 6


def film_section(strips: Sequence[FrameStrip]) -> tuple[str, str]:
    """Return the section with the frames, and the style rules that hold its pictures, each of them once."""
    if not strips:
        return "", ""
    rules, pieces = [], []
    for episode in dict.fromkeys(strip.episode for strip in strips):
        own = [strip for strip in strips if strip.episode == episode]
        names = [f"f{len(rules) + k}" for k in range(2 * len(own))]
        for k, strip in enumerate(own):
            for name, frames in zip(names[2 * k : 2 * k + 2], tiles(strip), strict=True):
                size = f"background-size:{len(frames) * 100}% 100%"
                rules.append(f".{name}{{background-image:url({jpeg_uri(sprite(frames), 72)});{size}}}")
        pieces += [f"<h3>Test episode {text(episode)}</h3>", _player(own, names), _sheet(own, names)]
    words = (
        "Above, what the cameras recorded; below, what the model predicts from the first 0.1 s of the pose track, "
        "rendered from its spheres. The yellow outline is where the object really was. Cut to where the object moves."
    )
    return section("Real above predicted", paragraph(words), *pieces), "\n" + "\n".join(rules)


def _tile(name: str, frame: int, count: int, label: str) -> str:
    place = 100 * frame / (count - 1) if count > 1 else 0
    return (
        f'<div class="tile {name}" role="img" aria-label="{text(label)}" style="background-position:{place:.3f}% 0">'
        "</div>"
    )


def _sheet(strips: Sequence[FrameStrip], names: Sequence[str]) -> str:
    """Return rows of frames at even times, for each camera real above predicted."""
    count = min(len(strip.real) for strip in strips)
    chosen = [k for k in telling(strips[0], SHEET_COLUMNS) if k < count]
    cells = ["<span></span>", *(f'<span class="time">{strips[0].times_s[k]:.2f} s</span>' for k in chosen)]
    cells += ["<span></span>"] * (SHEET_COLUMNS - len(chosen))
    for k, strip in enumerate(strips):
        cells += ['<span class="gap"></span>'] if k else []
        for kind, name in zip(("real", "predicted"), names[2 * k : 2 * k + 2], strict=True):
            cells.append(f"<span>{text(strip.camera)},<br>{kind}</span>")
            cells += [_tile(name, frame, count, f"{kind}, {strip.times_s[frame]:.2f} s") for frame in chosen]
            cells += ["<span></span>"] * (SHEET_COLUMNS - len(chosen))
    return f'<div class="scroll"><div class="sheet">{"".join(cells)}</div></div>'


def _player(strips: Sequence[FrameStrip], names: Sequence[str]) -> str:
    """Return all frames side by side, with a slider."""
    count = min(len(strip.real) for strip in strips)
    times = ",".join(f"{time:.2f}" for time in strips[0].times_s[:count])
    views = "".join(
        f"<div>{_tile(names[2 * k + j], 0, count, kind)}{text(strip.camera)}, {kind}</div>"
        for k, strip in enumerate(strips)
        for j, kind in enumerate(("real", "predicted"))
    )
    return (
        f'<div data-frames="{count}" data-times="{times}"><div class="player">{views}</div>'
        f'<div class="controls"><button type="button">Play</button><input type="range" min="0" max="{count - 1}" '
        f'value="0" aria-label="frame"><output>{strips[0].times_s[0]:.2f} s</output></div></div>'
    )
