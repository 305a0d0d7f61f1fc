"""The frame of an HTML report: one file with its own style sheet and script, nothing loaded from elsewhere."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

STYLE = """
:root { --ink: #1d2129; --soft: #5b6472; --line: #dde1e7; --paper: #fff; --wash: #f5f6f8;
  --model: #1f5fa8; --frozen: #8a919c; --ballistic: #c46a1b; --good: #1d7a46; --bad: #b3261e; --true: #b3261e; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1100px; margin: 0 auto; padding: 32px 20px 64px; }
h1 { font-size: 15px; font-weight: 600; letter-spacing: .02em; color: var(--soft); margin: 0 0 12px; }
h2 { font-size: 21px; line-height: 1.3; margin: 48px 0 8px; padding-top: 20px; border-top: 1px solid var(--line); }
h3 { font-size: 15px; margin: 24px 0 6px; }
p { max-width: 74ch; margin: 8px 0; }
.verdict { font-size: 24px; line-height: 1.4; font-weight: 500; max-width: 60ch; margin: 0 0 8px; }
.soft, figcaption, caption { color: var(--soft); }
.good { color: var(--good); } .bad { color: var(--bad); }
code { font: 13px/1.4 ui-monospace, "SF Mono", Menlo, Consolas, monospace; }
code.long { overflow-wrap: anywhere; white-space: normal !important; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(230px, 1fr)); gap: 14px; margin: 24px 0 8px; }
.card { background: var(--wash); border-radius: 8px; padding: 14px 16px; }
.card .value { font-size: 30px; line-height: 1.2; font-weight: 600; font-variant-numeric: tabular-nums; }
.card dl { display: grid; grid-template-columns: auto auto; margin: 8px 0 0; font-size: 14px; color: var(--soft); }
.card dd { margin: 0; text-align: right; font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; margin: 12px 0; }
table { border-collapse: collapse; font-size: 14.5px; font-variant-numeric: tabular-nums; min-width: 100%; }
caption { text-align: left; padding-bottom: 6px; }
th, td { text-align: left; padding: 6px 14px 6px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; color: var(--soft); }
thead th { vertical-align: bottom; } th[scope=row], td:first-child, td code { white-space: nowrap; }
td.num { text-align: right; white-space: nowrap; } th.num { text-align: right; }
tr.strong td { font-weight: 600; }
figure { margin: 16px 0; }
figcaption { font-size: 14px; margin-top: 6px; max-width: 90ch; }
.sheet { display: grid; gap: 3px; grid-template-columns: 84px repeat(6, minmax(90px, 1fr)); align-items: center;
  font-size: 13px; color: var(--soft); min-width: 660px; }
.sheet .time { text-align: center; } .sheet .gap { grid-column: 1 / -1; height: 6px; }
.tile { aspect-ratio: 4 / 3; background-repeat: no-repeat; border-radius: 2px; }
.tile, .strip img { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.player { display: grid; grid-template-columns: repeat(4, minmax(0, 1fr)); gap: 6px; }
.player div { font-size: 13px; color: var(--soft); }
.controls { display: flex; gap: 12px; align-items: center; margin: 8px 0; font-size: 14px; flex-wrap: wrap; }
.controls input { flex: 1; min-width: 120px; accent-color: var(--model); }
.controls output { min-width: 5em; font-variant-numeric: tabular-nums; }
button { font: inherit; font-size: 14px; padding: 4px 14px; border: 1px solid var(--line); border-radius: 6px;
  background: var(--wash); color: inherit; cursor: pointer; }
button[aria-pressed=true] { background: var(--ink); color: #fff; border-color: var(--ink); }
.strip { display: grid; gap: 3px; grid-template-columns: repeat(8, minmax(100px, 1fr)); min-width: 820px;
  font-size: 12.5px; color: var(--soft); text-align: center; }
.strip img { width: 100%; display: block; border-radius: 2px; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(290px, 1fr)); gap: 12px 18px; }
.chart { width: 100%; height: auto; display: block; }
.chart text { font-size: 12px; fill: var(--soft); } .chart .title { font-size: 13px; fill: var(--ink); }
.chart .grid { stroke: var(--line); } .chart .tick { stroke: var(--frozen); }
.chart .seen { fill: #e9eef5; } .chart .moment { stroke: var(--frozen); stroke-dasharray: 3 3; }
.chart .line { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
.chart .model { stroke: var(--model); stroke-width: 2.2; }
.chart .frozen { stroke: var(--frozen); } .chart .ballistic { stroke: var(--ballistic); }
.legend { display: flex; gap: 18px; flex-wrap: wrap; font-size: 14px; color: var(--soft); margin: 8px 0; }
.legend i { display: inline-block; width: 18px; border-top: 3px solid; vertical-align: middle; margin-right: 6px; }
.legend .model { border-color: var(--model); } .legend .frozen { border-color: var(--frozen); }
.legend .ballistic { border-color: var(--ballistic); }
.legend .seen { border: 0; height: 12px; background: #e9eef5; }
.legend .moment { border-top: 2px dashed var(--frozen); }
.interval { width: 120px; height: 18px; display: block; }
.interval .bar { stroke: var(--model); stroke-width: 2; } .interval circle { fill: var(--model); }
.interval .true { stroke: var(--true); stroke-width: 2; }
.warnings { border-left: 3px solid var(--ballistic); padding: 2px 0 2px 14px; margin: 16px 0; }
.warnings p { margin: 4px 0; overflow-wrap: anywhere; }
.bars td .bar { display: block; height: 10px; background: var(--model); border-radius: 2px; min-width: 1px; }
.bars td.wide { width: 50%; }
@media (max-width: 640px) {
  main { padding: 20px 14px 48px; } .verdict { font-size: 20px; }
  .player { grid-template-columns: repeat(2, minmax(0, 1fr)); }
}
@media print { .controls { display: none; } h2 { break-after: avoid; } figure, .card { break-inside: avoid; } }
"""

NEGLIGIBLE = 1e-12
"""What rounding leaves of a zero, in any unit that occurs."""

SCRIPT = """
for (const player of document.querySelectorAll("[data-frames]")) {
  const count = Number(player.dataset.frames), slider = player.querySelector("input");
  const times = player.dataset.times.split(","), label = player.querySelector("output");
  const button = player.querySelector("button");
  let timer = null;
  const show = k => {
    slider.value = k;
    label.textContent = times[k] + " s";
    for (const tile of player.querySelectorAll(".tile"))
      tile.style.backgroundPosition = (count > 1 ? 100 * k / (count - 1) : 0) + "% 0";
  };
  const stop = () => { clearInterval(timer); timer = null; button.textContent = "Play"; };
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  button.addEventListener("click", () => {
    if (timer) return stop();
    button.textContent = "Pause";
    timer = setInterval(() => show((Number(slider.value) + 1) % count), 100);
  });
}
"""


def page(title: str, body: Sequence[str], style: str = "", script: str = "") -> str:
    """Return a whole HTML document.

    Args:
        title: In the browser's title bar.
        body: Pieces of HTML, in order.
        style: Further rules for the style sheet.
        script: What runs after the page's own script.
    """
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        # The page needs nothing from the network, so it may not ask for anything either.
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">\n"
        f"<title>{text(title)}</title>\n<style>{STYLE}{style}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(body)
        + f"\n</main>\n<script>{SCRIPT}{script}</script>\n</body>\n</html>\n"
    )


def text(value: object) -> str:
    """Return any text with the characters escaped that mean something in HTML."""
    return html.escape(str(value))


def section(title: str, *pieces: str) -> str:
    """Return a section with its heading; empty pieces are left out."""
    return "\n".join(["<section>", f"<h2>{text(title)}</h2>", *(piece for piece in pieces if piece), "</section>"])


def paragraph(words: str, style: str = "") -> str:
    """Return a paragraph of plain text."""
    mark = f' class="{style}"' if style else ""
    return f"<p{mark}>{text(words)}</p>"


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[int] = (), strong: Sequence[int] = ()
) -> str:
    """Return a table; cells are HTML already.

    Args:
        header: Column names, plain text.
        rows: Cells by row.
        numeric: Numbers of the columns that are aligned to the right.
        strong: Numbers of the rows that stand out.
    """

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(f"<{tag}{' class=num' if k in numeric else ''}>{cell}</{tag}>" for k, cell in enumerate(row))

    lines = [f"<tr{' class=strong' if i in strong else ''}>{cells('td', row)}</tr>" for i, row in enumerate(rows)]
    head = f"<thead><tr>{cells('th', [text(name) for name in header])}</tr></thead>"
    return f'<div class="scroll"><table>{head}<tbody>{"".join(lines)}</tbody></table></div>'


def facts(rows: Sequence[tuple[str, str]]) -> str:
    """Return a table of two columns: what, and how much; the second is HTML already."""
    lines = "".join(f"<tr><th scope=row>{text(name)}</th><td>{value}</td></tr>" for name, value in rows)
    return f'<div class="scroll"><table>{lines}</table></div>'


def number(value: float | None, digits: int = 3) -> str:
    """Write a number with significant digits, plain where people read it so; an en dash where there is none.

    >>> number(0.00341), number(1234.5), number(None), number(3.2e-7), number(-2.0)
    ('0.00341', '1230', '–', '3.2e−07', '−2.00')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if abs(value) < NEGLIGIBLE:
        return "0"
    written = f"{value:.{digits}g}"
    if 1e-5 <= abs(value) < 1e6:
        decimals = digits - 1 - math.floor(math.log10(abs(float(written))))
        written = f"{round(value, decimals):.{max(0, decimals)}f}"
    return written.replace("-", "−")


def fixed(value: float | None, places: int = 1, scale: float = 1.0) -> str:
    """Write a number with fixed places, after multiplying it by `scale`; an en dash where there is none.

    >>> fixed(0.01234, 1, 1e3), fixed(None)
    ('12.3', '–')
    """
    return "–" if value is None or not math.isfinite(value) else f"{value * scale:.{places}f}".replace("-", "−")
