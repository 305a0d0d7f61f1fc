(() => {
const root = document.getElementById("replay"), block = document.getElementById("replay-data");
if (!root || !block) return;
const data = JSON.parse(block.textContent), L = 1e-4;
const style = getComputedStyle(document.documentElement);
const paint = name => style.getPropertyValue("--" + name).trim();  // live: the scheme may change
const color = k => paint("m" + k % 6);
const shown = data.models.map(() => true);
let at = 0, frame = 0, timer = null, began = 0;
const find = name => root.querySelector("[data-part=" + name + "]");
const slider = find("slider"), clock = find("clock"), play = find("play"), picker = find("episode");
const episode = () => data.episodes[at];
const escaped = words => words.replace(/[&<>"]/g, c => "&#" + c.charCodeAt(0) + ";");
const nearest = (times, t) => times.reduce((best, v, k) => Math.abs(v - t) < Math.abs(times[best] - t) ? k : best, 0);

data.episodes.forEach((e, k) => picker.append(new Option(e.name, k)));
data.models.forEach((name, k) => {
  const button = document.createElement("button");
  button.type = "button"; button.textContent = name; button.style.borderLeftColor = "var(--m" + k % 6 + ")";
  button.setAttribute("aria-pressed", "true");
  button.addEventListener("click", () => {
    shown[k] = !shown[k]; button.setAttribute("aria-pressed", String(shown[k])); prepare(); draw();
  });
  find("models").append(button);
});

// Motion, from the side and from above

const turn = (q, k) => {
  const [w, x, y, z] = [q[4 * k], q[4 * k + 1], q[4 * k + 2], q[4 * k + 3]].map(v => v * 1e-4);
  return p => {
    const tx = 2 * (y * p[2] - z * p[1]), ty = 2 * (z * p[0] - x * p[2]), tz = 2 * (x * p[1] - y * p[0]);
    return [p[0] + w * tx + y * tz - z * ty, p[1] + w * ty + z * tx - x * tz, p[2] + w * tz + x * ty - y * tx];
  };
};
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const point = (p, k) => p[3 * k] === null ? null : [p[3 * k] * L, p[3 * k + 1] * L, p[3 * k + 2] * L];
const hull = points => {  // Andrew's monotone chain
  const sorted = points.slice().sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const side = list => {
    const out = [];
    for (const p of list) {
      while (out.length > 1) {
        const a = out[out.length - 2], b = out[out.length - 1];
        if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
        out.pop();
      }
      out.push(p);
    }
    return out.slice(0, -1);
  };
  return side(sorted).concat(side(sorted.reverse()));
};
let bounds = null;
function frameOf() {  // bounds of both views: all measurements, and predictions that stay near them
  const e = episode(), axes = e.axes, low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9];
  const grow = (p, by) => axes.forEach((axis, i) => {
    const v = dot(axis, p); low[i] = Math.min(low[i], v - by); high[i] = Math.max(high[i], v + by);
  });
  const each = (list, count, name, by) => {
    for (let k = 0; k < e.t.length; k++) {
      const p = point(list, k * count + name);
      if (p) grow(p, by);
    }
  };
  const sizes = e.free.map(name => data.bodies[name].size * L);
  e.free.forEach((_, b) => each(e.p, e.free.length, b, sizes[b]));
  const most = [0, 1, 2].map(i => 0.5 * Math.max(high[0] - low[0], high[1] - low[1], high[2] - low[2]));
  const limits = [low.map((v, i) => v - most[i]), high.map((v, i) => v + most[i])];
  e.models.forEach((m, j) => m && shown[j] && e.free.forEach((_, b) => each(m.p, e.free.length, b, sizes[b])));
  for (const name in e.others)
    if (data.bodies[name].motion === "driven") each(e.others[name].p, 1, 0, data.bodies[name].size * L);
  for (let i = 0; i < 3; i++) {
    low[i] = Math.max(low[i], limits[0][i]); high[i] = Math.min(high[i], limits[1][i]);
  }
  if (data.ground) low[2] = Math.min(low[2], data.ground.offset / Math.hypot(...data.ground.normal) - 0.01);
  bounds = { low, high };
}
const step = range => [1, 2, 5, 10, 20].map(f => f * 10 ** Math.floor(Math.log10(range) - 1))
  .find(s => range / s <= 7) || range;
function view(canvas, vertical) {
  const e = episode(), U = e.axes[0], V = e.axes[vertical], { low, high } = bounds;
  const width = canvas.clientWidth || 520, left = 42, bottom = 22;
  const scale = (width - left - 8) / (high[0] - low[0] || 1);
  const tall = Math.min(Math.max((high[vertical] - low[vertical]) * scale, 70), 280);
  const s = Math.min(scale, tall / (high[vertical] - low[vertical] || 1)), ratio = window.devicePixelRatio || 1;
  const height = tall + bottom + 8;
  canvas.style.height = height + "px";
  canvas.width = width * ratio; canvas.height = height * ratio;
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  const mid = (low[0] + high[0]) / 2, x0 = left + (width - left - 8) / 2;
  const middle = (low[vertical] + high[vertical]) / 2, y0 = 8 + tall / 2;
  const place = p => [x0 + s * (dot(U, p) - mid), y0 - s * (dot(V, p) - middle)];
  g.font = "11px system-ui, sans-serif"; g.fillStyle = paint("soft"); g.strokeStyle = paint("grid"); g.lineWidth = 1;
  const grid = step(Math.max(high[0] - low[0], high[vertical] - low[vertical]));
  const words = v => (Math.abs(v) < 1e-9 ? 0 : v).toFixed(grid < 0.1 ? 2 : 1).replace("-", "−");
  const from = mid - (x0 - left) / s, to = mid + (width - 8 - x0) / s;
  for (let v = Math.ceil(from / grid) * grid; v <= to + 1e-9; v += grid) {
    const x = x0 + s * (v - mid);
    g.beginPath(); g.moveTo(x, 8); g.lineTo(x, 8 + tall); g.stroke();
    g.textAlign = "center";
    if (x < width - 14) g.fillText(words(v), x, height - 8);
  }
  const down = middle - tall / 2 / s, above = middle + tall / 2 / s;
  for (let v = Math.ceil(down / grid) * grid; v <= above + 1e-9; v += grid) {
    const y = y0 - s * (v - middle);
    g.beginPath(); g.moveTo(left, y); g.lineTo(width - 8, y); g.stroke();
    g.textAlign = "right"; g.fillText(words(v), left - 6, y + 4);
  }
  g.save(); g.beginPath(); g.rect(left, 8, width - left - 8, tall); g.clip();
  if (vertical === 2 && data.ground) {
    const y = y0 - s * (data.ground.offset / Math.hypot(...data.ground.normal) - middle);
    g.strokeStyle = paint("ground"); g.lineWidth = 2;
    g.beginPath(); g.moveTo(left, y); g.lineTo(width, y); g.stroke();
  }
  const trail = (list, count, b, color, until, dots) => {
    g.strokeStyle = color; g.fillStyle = color; g.lineWidth = 1.2;
    g.beginPath();
    let joined = false;
    for (let k = 0; k < e.t.length && k <= until; k++) {
      const p = point(list, k * count + b);
      if (!p) { joined = false; continue; }
      const [x, y] = place(p);
      if (dots) { g.moveTo(x + 1.4, y); g.arc(x, y, 1.4, 0, 7); }
      else if (joined) g.lineTo(x, y); else g.moveTo(x, y);
      joined = true;
    }
    if (dots) g.fill(); else g.stroke();
  };
  const body = (name, p, q, k, color, filled) => {
    const origin = point(p, k);
    if (!origin) return;
    const shape = data.bodies[name];
    if (q[4 * k] === null) {  // only the centroid was measured
      const [x, y] = place(origin);
      g.strokeStyle = color; g.lineWidth = 2;
      g.beginPath(); g.moveTo(x - 5, y); g.lineTo(x + 5, y); g.moveTo(x, y - 5); g.lineTo(x, y + 5); g.stroke();
      return;
    }
    const turned = turn(q, k), corners = [];
    for (let i = 0; i < shape.points.length; i += 3) {
      const r = turned([shape.points[i] * L, shape.points[i + 1] * L, shape.points[i + 2] * L]);
      corners.push(place([origin[0] + r[0], origin[1] + r[1], origin[2] + r[2]]));
    }
    const outline = hull(corners);
    g.beginPath(); outline.forEach((c, i) => i ? g.lineTo(...c) : g.moveTo(...c)); g.closePath();
    if (filled) { g.fillStyle = paint("body"); g.fill(); }
    g.strokeStyle = color; g.lineWidth = filled ? 1.6 : 1.8; g.stroke();
    g.lineWidth = 0.7; g.beginPath();
    for (const [a, b] of shape.edges) { g.moveTo(...corners[a]); g.lineTo(...corners[b]); }
    if (!shape.edges.length) for (let i = 0; i < 3; i++) {
      const axis = [0, 0, 0]; axis[i] = 0.7 * shape.size * L;
      const r = turned(axis);
      g.moveTo(...place(origin)); g.lineTo(...place([origin[0] + r[0], origin[1] + r[1], origin[2] + r[2]]));
    }
    g.stroke();
  };
  const count = e.free.length;
  for (const name in e.others) body(name, e.others[name].p, e.others[name].q, frame, paint("frozen"), true);
  e.free.forEach((_, b) => trail(e.p, count, b, paint("frozen"), 1e9, true));
  e.models.forEach((m, j) => {
    if (!m || !shown[j]) return;
    g.globalAlpha = 0.35; e.free.forEach((_, b) => trail(m.p, count, b, color(j), 1e9, false));
    g.globalAlpha = 1; e.free.forEach((_, b) => trail(m.p, count, b, color(j), frame, false));
  });
  e.free.forEach((name, b) => body(name, e.p, e.q, frame * count + b, paint("ink"), true));
  e.models.forEach((m, j) => {
    if (m && shown[j]) e.free.forEach((name, b) => body(name, m.p, m.q, frame * count + b, color(j), false));
  });
  g.restore();
}

// Curves over time

const W = 520, H = 150, LEFT = 46, RIGHT = 14, TOP = 20, BOTTOM = 22;
const across = t => LEFT + (W - LEFT - RIGHT) * t / (episode().t[episode().t.length - 1] || 1);
function curve(name, title, pick, floor, reference) {
  const svg = find(name), e = episode();
  const lines = e.models.map((m, j) => m && shown[j] ? pick(m) : null);
  const values = lines.flatMap(line => line || []).filter(v => v !== null && v > 0);
  svg.parentElement.hidden = !values.length;
  if (!values.length) return;
  let low = Math.max(floor, 10 ** Math.floor(Math.log10(Math.min(...values))));
  let high = Math.max(10 * low, 10 ** Math.ceil(Math.log10(Math.max(...values))));
  const y = v => H - BOTTOM - (H - BOTTOM - TOP) * Math.log(Math.min(Math.max(v, low), high) / low)
    / Math.log(high / low);
  let out = '<text class="title" x="' + LEFT + '" y="13">' + title + "</text>";
  out += '<rect class="seen" x="' + LEFT + '" y="' + TOP + '" width="' + (across(e.warm) - LEFT)
    + '" height="' + (H - TOP - BOTTOM) + '"/>';
  for (let p = Math.round(Math.log10(low)); p <= Math.round(Math.log10(high)); p++) {
    const at = y(10 ** p);
    out += '<line class="grid" x1="' + LEFT + '" x2="' + (W - RIGHT) + '" y1="' + at + '" y2="' + at + '"/>'
      + '<text x="' + (LEFT - 5) + '" y="' + (at + 4) + '" text-anchor="end">' + +(10 ** p).toPrecision(1) + "</text>";
  }
  if (reference) out += '<line class="one" x1="' + LEFT + '" x2="' + (W - RIGHT) + '" y1="' + y(reference)
    + '" y2="' + y(reference) + '"/>';
  const last = e.t[e.t.length - 1] || 1, tick = step(last);
  for (let t = 0; t <= last + 1e-9; t += tick)
    out += '<text x="' + across(t) + '" y="' + (H - 8) + '" text-anchor="middle">' + +t.toFixed(3) + "</text>";
  lines.forEach((line, j) => {
    if (!line) return;
    let path = "", joined = false;
    line.forEach((v, k) => {
      if (v === null) { joined = false; return; }
      path += (joined ? "L" : "M") + across(e.t[k]).toFixed(1) + " " + y(v).toFixed(1); joined = true;
    });
    out += '<path class="line" style="stroke:var(--m' + j % 6 + ')" d="' + path + '"/>';
  });
  svg.innerHTML = out + '<line class="now" y1="' + TOP + '" y2="' + (H - BOTTOM) + '"/>';
}
function phases() {
  const svg = find("phase"), e = episode();
  const own = e.models.filter((m, j) => m && m.phase && shown[j])[0] || e.models.find(m => m && m.phase);
  svg.parentElement.hidden = !own;
  if (!own) return;
  let out = "";
  e.t.forEach((t, k) => {
    if (own.phase[k] < 0) return;
    const a = k ? (e.t[k - 1] + t) / 2 : t, b = k + 1 < e.t.length ? (t + e.t[k + 1]) / 2 : t;
    const name = data.phases[own.phase[k]];
    out += '<rect class="bar" x="' + across(a) + '" y="2" width="' + (across(b) - across(a) + 0.3)
      + '" height="14" fill="var(--' + name + ')"><title>' + name + "</title></rect>";
  });
  svg.innerHTML = out + '<line class="now" y1="0" y2="18"/>';
}
for (const svg of root.querySelectorAll("svg.chart")) {
  const seek = event => {
    const box = svg.getBoundingClientRect(), e = episode();
    const t = ((event.clientX - box.left) / box.width * W - LEFT) / (W - LEFT - RIGHT) * e.t[e.t.length - 1];
    stop(); show(nearest(e.t, t));
  };
  svg.addEventListener("pointerdown", event => { event.preventDefault(); seek(event); });
  svg.addEventListener("pointermove", event => { if (event.buttons) seek(event); });
}

// Frames of the videos, the rendered prediction and the difference

const pictures = {};
const picture = source => {
  if (!pictures[source]) {
    pictures[source] = new Image();
    pictures[source].onload = () => film();
    pictures[source].src = source;
  }
  return pictures[source];
};
function film() {
  const box = find("film"), videos = (data.video || {})[episode().name] || [];
  const wanted = videos.flatMap((v, i) => ["recorded", ...v.models.flatMap((source, j) =>
    source && shown[j] ? ["predicted " + j, "difference " + j] : [])].map(kind => [v, i, kind]));
  const key = episode().name + wanted.map(w => w[1] + w[2]).join();
  if (box.dataset.key !== key) {
    box.dataset.key = key;
    box.replaceChildren(...videos.map((v, i) => {
      const row = document.createElement("div");
      row.className = "row";
      row.append(...wanted.filter(w => w[1] === i).map(([, , kind]) => {
        const figure = document.createElement("figure"), canvas = document.createElement("canvas");
        const [what, j] = kind.split(" ");
        canvas.width = v.size[0]; canvas.height = v.size[1]; canvas.dataset.kind = kind; canvas.dataset.video = i;
        const caption = document.createElement("figcaption");
        caption.textContent = v.camera + ", " + what + (j ? " by " + data.models[j] : "");
        figure.append(canvas, caption);
        return figure;
      }));
      return row;
    }));
  }
  const now = episode().t[frame];
  for (const canvas of box.querySelectorAll("canvas")) {
    const v = videos[canvas.dataset.video], k = nearest(v.t, now), [w, h] = v.size;
    const [what, j] = canvas.dataset.kind.split(" "), g = canvas.getContext("2d");
    const stamp = (source, mode) => {
      const image = picture(source);
      if (!image.complete || !image.naturalWidth) return;
      g.globalCompositeOperation = mode;
      g.drawImage(image, k % v.columns * w, Math.floor(k / v.columns) * h, w, h, 0, 0, w, h);
    };
    g.globalCompositeOperation = "source-over"; g.clearRect(0, 0, w, h);
    stamp(what === "predicted" ? v.models[j] : v.real, "source-over");
    if (what === "difference") {
      stamp(v.models[j], "difference");
      g.globalCompositeOperation = "lighter";  // each of the two draws doubles the brightness
      g.drawImage(canvas, 0, 0); g.drawImage(canvas, 0, 0);
    }
    canvas.dataset.frame = k;
  }
}

// One clock for all views

function prepare() {
  frameOf();
  curve("move", "translation error, open loop [mm]", m => m.move, 0.01);
  curve("turn", "rotation error, open loop [deg]", m => m.turn, 0.01);
  curve("z", "short predictions: largest residual [units of the noise]", m => m.z, 0.1, 1);
  phases();
}
function draw() {
  const e = episode(), t = e.t[frame];
  slider.value = frame;
  clock.textContent = t.toFixed(3) + " s";
  root.dataset.episode = e.name; root.dataset.time = t; root.dataset.frame = frame;
  for (const line of root.querySelectorAll(".now"))
    for (const end of ["x1", "x2"]) line.setAttribute(end, across(t));
  const now = (m, j) => data.models[j] + ": " + m.move[frame].toPrecision(3) + " mm"
    + (m.turn && m.turn[frame] !== null ? ", " + m.turn[frame].toPrecision(3) + " deg" : "");
  find("values").textContent = e.models.map((m, j) => m && shown[j] && m.move[frame] !== null ? now(m, j) : "")
    .filter(Boolean).join(" · ");
  view(find("side"), 2); view(find("top"), 1);
  film();
}
const show = k => { frame = k; draw(); };
function choose(k, time) {
  at = k; frame = time === undefined ? 0 : nearest(episode().t, time);
  picker.value = k; slider.max = episode().t.length - 1;
  find("bearing").textContent = String(episode().bearing).replace("-", "−");
  prepare(); draw();
}
const stop = () => { clearInterval(timer); timer = null; play.textContent = "Play"; };
play.addEventListener("click", () => {
  if (timer) return stop();
  const e = episode(), last = e.t[e.t.length - 1], slow = Number(find("speed").value);
  if (frame >= e.t.length - 1) frame = 0;
  const start = e.t[frame]; began = performance.now(); play.textContent = "Pause";
  timer = setInterval(() => {
    const t = start + (performance.now() - began) / 1000 * slow;
    show(nearest(e.t, Math.min(t, last)));
    if (t >= last) stop();
  }, 30);
});
slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
picker.addEventListener("change", () => { stop(); choose(Number(picker.value)); });
const go = (name, time) => {
  const k = data.episodes.findIndex(e => e.name === name);
  if (k < 0) return;
  stop(); choose(k, time); root.scrollIntoView({ block: "start" });
};
for (const button of document.querySelectorAll("button.go"))
  button.addEventListener("click", () => go(button.dataset.episode, Number(button.dataset.time)));
window.addEventListener("resize", draw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
choose(0);

// Residual wrenches against coordinates

const chart = document.getElementById("wrench");
if (!chart || !data.wrench) return;
const part = name => chart.querySelector("[data-part=" + name + "]"), plot = part("plot");
const options = (select, names) => names.forEach((name, k) => select.append(new Option(name, k)));
const kinds = ["missing force x", "missing force y", "missing force z", "missing torque x", "missing torque y",
  "missing torque z", "misfit", "missing force along the velocity", "missing force sideways",
  "missing force across, upwards", "missing force along spin × velocity", "missing torque along the spin"];
const coordinates = data.wrench.coordinates;
options(part("model"), data.models); options(part("kind"), kinds);
options(part("coordinate"), coordinates.map(c => c.name + (c.unit ? " [" + c.unit + "]" : "")));
const phasePicker = part("phase");
options(phasePicker, ["all phases", ...data.phases]);
const present = new Set(data.wrench.models.flat().map(p => data.phases[p.ph]));
part("marks").innerHTML = data.phases.filter(name => present.has(name))
  .map(name => '<span><i style="background:' + 'var(--in-' + name + ')' + '"></i>' + name + "</span>").join("");
function scatter() {
  const [m, kind, c, ph] = ["model", "kind", "coordinate", "phase"].map(name => Number(part(name).value));
  const points = data.wrench.models[m].filter(p => p.a[kind] !== null && p.c[c] !== null && (!ph || p.ph === ph - 1));
  const unit = kind === 6 ? "× noise" : kind < 3 || kind > 6 && kind < 11 ? "m/s²" : "rad/s²";
  const signed = kind !== 6, name = coordinates[c];
  chart.dataset.points = points.length;
  if (!points.length) { plot.innerHTML = '<text x="20" y="40">nothing in this phase</text>'; return; }
  const w = 1060, h = 340, l = 62, r = 12, top = 26, b = 40;
  const xs = points.map(p => p.c[c]), x0 = Math.min(...xs), x1 = Math.max(...xs);
  const sizes = points.map(p => Math.abs(p.a[kind]) + p.s[kind]).sort((u, v) => u - v);
  const most = sizes[Math.floor(0.95 * (sizes.length - 1))] * 1.1 || 1;  // larger values are clipped to the edge
  const X = v => l + (w - l - r) * (v - x0) / (x1 - x0 || 1);
  const base = signed ? -most : 0;
  const Y = v => top + (h - top - b) * (1 - Math.max(0, Math.min(1, (v - base) / (most - base))));
  let out = '<text class="title" x="' + l + '" y="15">' + kinds[kind] + " [" + unit + "] against "
    + escaped(name.name + (name.unit ? " [" + name.unit + "]" : "")) + "</text>";
  const sy = step(most - base), sx = step(x1 - x0 || 1);
  for (let v = Math.ceil(base / sy) * sy; v <= most; v += sy)
    out += '<line class="grid" x1="' + l + '" x2="' + (w - r) + '" y1="' + Y(v) + '" y2="' + Y(v) + '"/>'
      + '<text x="' + (l - 6) + '" y="' + (Y(v) + 4) + '" text-anchor="end">' + +v.toPrecision(3) + "</text>";
  for (let v = Math.ceil(x0 / sx) * sx; v <= x1 + 1e-9; v += sx)
    out += '<text x="' + X(v) + '" y="' + (h - 16) + '" text-anchor="middle">' + +v.toPrecision(3) + "</text>";
  out += '<line class="zero" x1="' + l + '" x2="' + (w - r) + '" y1="' + Y(0) + '" y2="' + Y(0) + '"/>';
  points.forEach((p, k) => {
    const x = X(p.c[c]), color = "var(--in-" + data.phases[p.ph] + ")", a = p.a[kind], s = p.s[kind];
    out += '<line class="error" style="stroke:' + color + '" x1="' + x + '" x2="' + x + '" y1="' + Y(a - s)
      + '" y2="' + Y(a + s) + '"/><circle data-k="' + k + '" cx="' + x + '" cy="' + Y(a) + '" r="3" style="fill:'
      + color + '"><title>episode ' + escaped(p.e) + ", " + p.t.toFixed(3) + " s, " + data.phases[p.ph] + ": "
      + a.toPrecision(3) + (signed ? " ± " + s.toPrecision(2) : "") + " " + unit + "</title></circle>";
  });
  const bins = [0, 1, 2, 3].map(() => [0, 0, 0]);
  const order = points.map((_, k) => k).sort((i, j) => xs[i] - xs[j]);
  order.forEach((k, i) => {  // weighted means of four equally filled bins
    const p = points[k], weight = 1 / (p.s[kind] ** 2 + (most / 20) ** 2);
    const bin = bins[Math.floor(4 * i / points.length)];
    bin[0] += weight; bin[1] += weight * p.a[kind]; bin[2] += weight * p.c[c];
  });
  if (points.length >= 12)
    out += '<path class="bin" d="M' + bins.map(v => X(v[2] / v[0]) + " " + Y(v[1] / v[0])).join("L") + '"/>';
  plot.innerHTML = out;
  for (const circle of plot.querySelectorAll("circle"))
    circle.addEventListener("click", () => { const p = points[circle.dataset.k]; go(p.e, p.t); });
}
for (const select of chart.querySelectorAll("select")) select.addEventListener("change", scatter);
const first = data.wrench.first;
part("model").value = 0; part("kind").value = first[0]; part("coordinate").value = first[1]; scatter();
})();
