// Curves on a canvas: axes, bands, gaps; colours that colour-blind people tell apart (Okabe-Ito), and dashes.
const STYLES = [["#0072b2", []], ["#d55e00", [7, 4]], ["#009e73", [2, 3]], ["#cc79a7", [9, 3, 2, 3]], ["#e69f00", [12, 4]]];
const CHARTS = new Set();
let printing = false;

// on paper every curve is black and distinct by its dashes, whatever the theme of the screen
function ink(canvas) { return printing ? "#000" : getComputedStyle(canvas).color; }
function colour(style) { return printing ? "#000" : STYLES[style][0]; }
function print(on) { printing = on; for (const c of CHARTS) c.canvas.isConnected ? c.paint() : CHARTS.delete(c); }
addEventListener("beforeprint", () => print(true));
addEventListener("afterprint", () => print(false));

/** A chart in a new canvas in `place`, painted again when its size changes. */
export class Chart {
  /** `axes`: x and y (titles), log (of x), marks (levels of y that mean something), floor (least y that is shown). */
  constructor(place, axes) {
    this.axes = { x: "time [s]", y: "", log: false, marks: [], floor: -Infinity, ...axes };
    this.series = []; this.marks = [];
    CHARTS.add(this);
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img"); this.canvas.setAttribute("aria-label", "no curve yet");
    place.append(this.canvas);
    new ResizeObserver(() => this.paint()).observe(this.canvas);
  }

  /** Draws series {name, x, y, low, high, style, dots}: arrays, NaN is a gap; low and high make a band; marks {x, y, label}. */
  draw(series, says, marks = []) {
    this.series = series; this.marks = marks;
    this.canvas.setAttribute("aria-label", says);
    this.paint();
  }

  paint() {
    const { canvas, series, axes } = this, scale = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    if (!w || !h) return;
    if (canvas.width !== Math.round(w * scale)) canvas.width = w * scale;
    if (canvas.height !== Math.round(h * scale)) canvas.height = h * scale;
    const g = canvas.getContext("2d");
    g.setTransform(scale, 0, 0, scale, 0, 0); g.clearRect(0, 0, w, h); g.font = "12px system-ui, sans-serif";
    if (!series.length) return;
    let [low, high] = range(series.flatMap(s => [s.y, s.low, s.high])), [from, to] = range(series.map(s => s.x));
    low = Math.max(low, axes.floor);
    if (!(high >= low)) return;
    if (high - low < 1e-9 * Math.max(1, Math.abs(high))) { high += 1; low -= 1; }
    const room = .04 * (high - low); low -= room; high += room;
    const left = 62, right = w - 12, top = this.top(), bottom = h - 34, lg = axes.log ? Math.log10 : v => v;
    const kx = (right - left) / (lg(to) - lg(from)), ky = (bottom - top) / (high - low), x0 = lg(from);
    const X = v => left + kx * (lg(v) - x0), Y = v => bottom - ky * (v - low);
    this.grid(g, { w, h, left, right, top, bottom, X, Y, low, high, from, to });
    g.save(); g.beginPath(); g.rect(left, top - 2, right - left, bottom - top + 4); g.clip();
    series.forEach((s, i) => {
      const style = s.style ?? i % STYLES.length;
      g.strokeStyle = g.fillStyle = colour(style);
      if (s.low) { g.globalAlpha = .22; band(g, s, X, Y); g.globalAlpha = 1; }
      g.lineWidth = 1.6; g.setLineDash(STYLES[style][1]); s.dots ? dots(g, s, X, Y) : trace(g, s, X, Y);
    });
    g.restore();
    this.point(g, { X, Y, low, high, from, to, right });
    this.legend(g, left);
  }

  grid(g, { w, h, left, right, top, bottom, X, Y, low, high, from, to }) {
    g.fillStyle = g.strokeStyle = ink(this.canvas); g.lineWidth = 1; g.textBaseline = "middle"; g.setLineDash([]);
    g.textAlign = "right";
    for (const v of ticks(low, high, 5)) {
      g.globalAlpha = .2; line(g, left, Y(v), right, Y(v)); g.globalAlpha = 1;
      g.fillText(String(v), left - 6, Y(v));
    }
    for (const v of this.axes.marks) if (v > low && v < high) { g.globalAlpha = .7; line(g, left, Y(v), right, Y(v)); g.globalAlpha = 1; }
    g.textAlign = "center";
    for (const v of this.axes.log ? decades(from, to) : ticks(from, to, Math.max(2, w / 130))) {
      g.globalAlpha = .2; line(g, X(v), top, X(v), bottom); g.globalAlpha = 1;
      g.fillText(String(v), Math.min(X(v), w - g.measureText(String(v)).width / 2), bottom + 12);
    }
    g.fillText(this.axes.x, (left + right) / 2, h - 8);
  }

  /** Circles with labels, to the left of those at the right edge. */
  point(g, { X, Y, low, high, from, to, right }) {
    g.strokeStyle = g.fillStyle = ink(this.canvas); g.lineWidth = 1.6; g.setLineDash([]); g.textBaseline = "middle";
    for (const m of this.marks) if (m.x >= from && m.x <= to && m.y >= low && m.y <= high) {
      const x = X(m.x), y = Y(m.y), room = g.measureText(m.label).width + 12 < right - x;
      g.beginPath(); g.arc(x, y, 4.5, 0, 2 * Math.PI); g.stroke();
      g.textAlign = room ? "left" : "right"; g.fillText(m.label, x + (room ? 9 : -9), y - 9);
    }
  }

  /** The title stands over the legend. */
  top() { return this.axes.y ? 40 : 24; }

  legend(g, left) {
    let at = left;
    const y = this.top() - 14;
    g.textAlign = "left"; g.textBaseline = "middle"; g.lineWidth = 1.6;
    this.series.forEach((s, i) => {
      if (!s.name) return;
      const style = s.style ?? i % STYLES.length;
      g.strokeStyle = g.fillStyle = colour(style); g.setLineDash(STYLES[style][1]);
      if (s.dots) for (const k of [3, 13, 23]) g.fillRect(at + k - 1, y - 1, 3, 3); else line(g, at, y, at + 26, y);
      g.setLineDash([]); g.fillStyle = ink(this.canvas); g.fillText(s.name, at + 32, y);
      at += 52 + g.measureText(s.name).width;
    });
    if (this.axes.y) { g.fillStyle = ink(this.canvas); g.fillText(this.axes.y, left, 10); }
  }
}

/** Draws recorded curves {name, unit, Ts, n, low, high}, lowest and highest of each piece, into `place`. */
export function draw(place, curves, says) {
  new Chart(place, {}).draw(curves.map(c => {
    const step = c.n * c.Ts / c.low.length, whole = c.low.every((v, k) => v === c.high[k]);
    const each = whole ? [c.low] : [c.low, c.high], x = [], y = [];
    for (let k = 0; k < c.low.length; k++) for (const values of each) { x.push(k * step); y.push(values[k] ?? NaN); }
    return { name: c.unit ? `${c.name} [${c.unit}]` : c.name, x, y };
  }), says);
}

function range(arrays) {
  let low = Infinity, high = -Infinity;
  for (const values of arrays) if (values) for (const v of values) { if (v < low) low = v; if (v > high) high = v; }
  return [low, high];
}

function trace(g, { x, y }, X, Y) {
  g.beginPath();
  let pen = false;
  for (let k = 0; k < y.length; k++) {
    if (Number.isNaN(y[k])) { pen = false; continue; }
    g[pen ? "lineTo" : "moveTo"](X(x[k]), Y(y[k])); pen = true;
  }
  g.stroke();
}

function dots(g, { x, y }, X, Y) {
  for (let k = 0; k < y.length; k++) if (!Number.isNaN(y[k])) g.fillRect(X(x[k]) - 1, Y(y[k]) - 1, 2.5, 2.5);
}

function band(g, { x, low, high }, X, Y) {
  for (let k = 0; k < x.length; k++) {
    if (Number.isNaN(low[k])) continue;
    const first = k;
    g.beginPath();
    for (; k < x.length && !Number.isNaN(low[k]); k++) g.lineTo(X(x[k]), Y(low[k]));
    for (let j = k - 1; j >= first; j--) g.lineTo(X(x[j]), Y(high[j]));
    g.fill();
  }
}

function line(g, x, y, x2, y2) { g.beginPath(); g.moveTo(x, y); g.lineTo(x2, y2); g.stroke(); }

function ticks(low, high, about) {
  const raw = (high - low) / about, ten = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(k => k * ten).find(s => s >= raw), found = [];
  // a whole number beyond 2^53 does not grow by one
  for (let k = Math.ceil(low / step); k * step <= high && found.length < 4 * about; k++) found.push(Number((k * step).toPrecision(6)));
  return found;
}

function decades(from, to) {
  const found = [];
  for (let e = Math.ceil(Math.log10(from)); 10 ** e <= to; e++) found.push(Number((10 ** e).toPrecision(6)));
  return found;
}
