// Curves on a canvas: ticks with units, bands and gaps, linked cursors, zoom and pan, files as SVG and PNG.
// Measured, predicted and reference look the same in every chart: solid, dashed and dotted, in colours of the sheet.
const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3], [12, 4], [2, 3], [5, 2]];
export const REFERENCE = 5, BESIDE = 6;
const TOKENS = ["--series-1", "--series-2", "--series-3", "--series-4", "--series-5", "--soft", "--soft", "--ink", "--paper"], INK = 7, PAPER = 8, GREY = [1, BESIDE];
const ROLES = { measured: 0, "free run": 1, predicted: 1, fit: 1, model: 1, reference: REFERENCE };
const CHARTS = new Set(), FONT = "12px system-ui, 'DejaVu Sans', sans-serif", LEFT = 62, RIGHT = 12, BELOW = 34, TITLE = 26;
let printing = false;

function every(act) { for (const c of CHARTS) c.canvas.isConnected ? act(c) : CHARTS.delete(c); }
// on paper every curve is black and distinct by its dashes, a predicted one grey, whatever the theme of the screen
function print(on) { printing = on; every(c => c.paint()); }
addEventListener("beforeprint", () => print(true));
addEventListener("afterprint", () => print(false));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => every(c => { c.colours = null; c.paint(); }));

/** A chart in `place`, painted again when its size changes. */
export class Chart {
  /** `axes`: x and y (titles), log (of x), marks (levels of y that mean something), floor and roof (of the y that is shown), along (for a
   * path, whose x does not grow: the title of what grows along it). */
  constructor(place, axes) {
    this.axes = { x: "time [s]", y: "", log: false, marks: [], floor: -Infinity, roof: Infinity, along: "", ...axes };
    this.series = []; this.marks = []; this.view = null; this.colours = null; this.spots = new Map();
    CHARTS.add(this);
    const plot = document.createElement("div"); plot.className = "plot";
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img"); this.canvas.setAttribute("aria-label", "no curve yet");
    this.line = document.createElement("div"); this.line.className = "line"; this.line.hidden = true;
    this.read = document.createElement("div"); this.read.className = "read"; this.read.hidden = true;
    plot.append(this.canvas, this.line, this.read); place.append(plot);
    this.menu(plot); this.pointer();
    new ResizeObserver(() => this.paint()).observe(this.canvas);
  }

  /** Draws series {name, x, y, low, high, style, dots}: arrays, NaN is a gap; low and high make a band; marks {x, y, label}. A path has `along`,
   * and `box`: least and largest x and y at each of its points. */
  draw(series, says, marks = []) {
    this.series = series; this.marks = marks;
    this.canvas.setAttribute("aria-label", says); this.canvas.parentNode.classList.toggle("none", !series.length);
    this.paint();
  }

  /** Charts with the same x axis in the same group: their cursors and windows move together. Cursors move along paths, too. */
  linked(cursor = false) {
    const group = this.canvas.closest(".linked"), found = [this], key = c => cursor && c.axes.along || c.axes.x;
    if (group) every(c => { if (c !== this && key(c) === key(this) && c.canvas.closest(".linked") === group) found.push(c); });
    return found;
  }

  paint() {
    const { canvas } = this, scale = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    if (!w || !h) return;
    if (canvas.width !== Math.round(w * scale)) canvas.width = w * scale;
    if (canvas.height !== Math.round(h * scale)) canvas.height = h * scale;
    // a processor paints a few lines sooner than they take to a graphics card and back, above all where there is none
    const g = canvas.getContext("2d", { willReadFrequently: true });
    g.setTransform(scale, 0, 0, scale, 0, 0); g.clearRect(0, 0, w, h);
    this.picture(g, w, h, printing ? TOKENS.map((_, k) => k === PAPER ? "#fff" : GREY.includes(k) ? "#888" : "#000") : this.colours ??= this.resolved());
  }

  /** The sheet's colours of a scheme, or of the page's own. */
  resolved(scheme = "") {
    const probe = document.createElement("i");
    probe.style.colorScheme = scheme; this.canvas.parentNode.append(probe);
    const found = TOKENS.map(name => { probe.style.color = `var(${name})`; return getComputedStyle(probe).color; });
    probe.remove();
    return found;
  }

  picture(g, w, h, colours) {
    const { series, axes } = this;
    this.at = null; g.font = FONT;
    if (!series.length) return;
    const whole = range(series.map(s => s.x)), [from, to] = this.view || whole;
    const part = s => axes.along ? [0, s.x.length] : inside(s.x, from, to);
    let [low, high] = range(series.flatMap(s => { const [i, j] = part(s); return [s.y, s.low, s.high].map(v => v && [v, i, j]); }), true);
    low = Math.max(low, axes.floor); high = Math.min(high, axes.roof);
    if (!(high >= low)) return;
    if (high - low < 1e-9 * Math.max(1, Math.abs(high))) { high += 1; low -= 1; }
    const room = .04 * (high - low); low -= room; high += room;
    const lg = axes.log ? Math.log10 : v => v, right = w - RIGHT, bottom = h - BELOW, x0 = lg(from), kx = (right - LEFT) / (lg(to) - x0);
    const X = v => LEFT + kx * (lg(v) - x0), back = px => { const v = x0 + (px - LEFT) / kx; return axes.log ? 10 ** v : v; };
    const below = top => { const ky = (bottom - top) / (high - low); this.at = { X, Y: v => bottom - ky * (v - low), back, whole, from, to, left: LEFT, right, top, bottom, low, high, colours }; };
    below(TITLE);
    // names stand at their curves where there is room, the others beside the title; if these need another row, all
    const names = series.flatMap((s, i) => s.name && s.name !== axes.y ? [i] : []);
    let labels = names.length > 1 ? this.beside(g, names, part) : [];
    const others = () => names.filter(i => !labels.some(f => f.i === i));
    if (this.legend(g, w, colours, others(), false) > TITLE) labels = [];
    below(this.legend(g, w, colours, others()));
    const { Y, top } = this.at;
    this.grid(g, w, h);
    g.save(); g.beginPath(); g.rect(LEFT, top - 2, right - LEFT, bottom - top + 4); g.clip();
    series.forEach((s, i) => {
      const style = styleOf(s, i), [begin, end] = part(s);
      g.strokeStyle = g.fillStyle = colours[style];
      if (s.low) { g.globalAlpha = .22; band(g, s, X, Y); g.globalAlpha = 1; }
      if (s.box) { g.globalAlpha = .22; boxes(g, s.box, X, Y); g.globalAlpha = 1; }
      g.lineWidth = style ? 1.6 : 1.8; g.setLineDash(DASHES[style]); s.dots ? dots(g, s, X, Y) : trace(g, s, X, Y, begin, end, right - LEFT);
    });
    g.restore();
    g.textAlign = "left"; g.textBaseline = "middle";
    for (const { i, x, y } of labels) { g.fillStyle = colours[styleOf(series[i], i)]; g.fillText(series[i].name, x, y); }
    this.point(g, labels);
  }

  /** Places at their own curves for names, where their boxes meet no curve and are nearest to their own. */
  beside(g, names, part) {
    const { left, right, top, bottom } = this.at, found = [];
    if (this.series.some(s => part(s)[1] - part(s)[0] > 4 * (right - left))) return [];
    const ways = this.series.map(s => reach(s, this.at, ...part(s)));
    for (const i of names) {
      const name = this.series[i].name, wide = Math.ceil(g.measureText(name).width), steps = 24, room = right - left - wide - 8, kept = this.spots.get(name);
      let best = null, least = Infinity;
      for (let k = -1; k <= steps; k++) for (const up of [true, false]) {
        // where it stood before, so that it does not jump while a slider moves
        const at = k < 0 ? kept?.share : k / steps;
        if (at === undefined || (k < 0 && up !== kept.up)) continue;
        const x = Math.round(4 + at * room), [high, low] = extent(ways[i], x, x + wide), y = up ? high - 11 : low + 11;
        if (!(high <= low) || y - 8 < top || y + 8 > bottom) continue;
        const clear = ways.every((way, j) => { const [a, b] = extent(way, x - 4, x + wide + 4), gap = j === i ? 9 : 15; return !(a < y + gap && b > y - gap); });
        const score = k < 0 ? -1 : low - high + 20 * (1 - at);
        if (clear && score < least && !found.some(f => Math.abs(f.y - y) < 16 && left + x < f.x + f.wide + 8 && left + x + wide + 8 > f.x)) { least = score; best = { i, x: left + x, y, wide, share: at, up }; }
      }
      if (best) found.push(best);
      this.spots.set(name, best);
    }
    return found;
  }

  grid(g, w, h) {
    const { X, Y, left, right, top, bottom, low, high, from, to, colours } = this.at;
    g.fillStyle = g.strokeStyle = colours[INK]; g.lineWidth = 1; g.textBaseline = "middle"; g.setLineDash([]);
    g.textAlign = "right";
    for (const v of ticks(low, high)) {
      g.globalAlpha = .14; line(g, left, Y(v), right, Y(v)); g.globalAlpha = 1;
      g.fillText(number(v), left - 6, Y(v));
    }
    for (const v of this.axes.marks) if (v > low && v < high) { g.globalAlpha = .7; line(g, left, Y(v), right, Y(v)); g.globalAlpha = 1; }
    g.textAlign = "center";
    let free = 0;  // a narrow picture leaves out the labels that would touch
    for (const v of this.axes.log ? decades(from, to) : ticks(from, to)) {
      g.globalAlpha = .14; line(g, X(v), top, X(v), bottom); g.globalAlpha = 1;
      const text = number(v), half = g.measureText(text).width / 2, x = Math.min(X(v), w - half);
      if (x - half >= free) { g.fillText(text, x, bottom + 12); free = x + half + 6; }
    }
    g.fillText(this.axes.x, (left + right) / 2, h - 8);
  }

  /** Circles with labels, each at the corner where the fewest points of curves are, and no name. */
  point(g, names) {
    const { X, Y, low, high, from, to, left, right, top, bottom, colours } = this.at;
    g.lineWidth = 1.6; g.setLineDash([]); g.textBaseline = "middle"; g.textAlign = "left";
    for (const m of this.marks) if (m.x >= from && m.x <= to && m.y >= low && m.y <= high) {
      const x = X(m.x), y = Y(m.y), wide = g.measureText(m.label).width;
      g.strokeStyle = colours[INK]; g.beginPath(); g.arc(x, y, 4.5, 0, 2 * Math.PI); g.stroke();
      let best = null, least = Infinity;
      for (const [dx, dy] of [[9, -12], [9, 12], [-9 - wide, -12], [-9 - wide, 12], [9, -28], [9, 28], [-9 - wide, -28], [-9 - wide, 28]]) {
        const a = x + dx, b = y + dy;
        let met = a < left || a + wide > right || b - 8 < top || b + 8 > bottom ? 1e6 : 0;
        if (names.some(n => Math.abs(n.y - b) < 16 && n.x < a + wide + 4 && n.x + n.wide > a - 4)) met += 1e5;
        for (const s of this.series) for (let k = 0; k < s.x.length; k++) {
          const px = X(s.x[k]); if (px > a - 2 && px < a + wide + 2 && Math.abs(Y(s.y[k]) - b) < 9) met++;
        }
        if (met < least) { least = met; best = [a, b]; }
      }
      g.fillStyle = colours[INK]; g.fillText(m.label, ...best);
    }
  }

  /** Title and names above the axes, so that they cover nothing, in as many rows as they need; returns where the axes begin. */
  legend(g, w, colours, names, draws = true) {
    let at = LEFT, y = 12;
    const place = wide => { if (at > LEFT && at + wide > w - 30) { at = LEFT; y += 18; } const x = at; at += wide + 16; return x; };
    g.textAlign = "left"; g.textBaseline = "middle"; g.lineWidth = 1.8; g.setLineDash([]); g.fillStyle = colours[INK];
    if (this.axes.y) { g.font = `600 ${FONT}`; const x = place(g.measureText(this.axes.y).width); if (draws) g.fillText(this.axes.y, x, y); g.font = FONT; }
    for (const i of names) {
      const s = this.series[i], style = styleOf(s, i), x = place(32 + g.measureText(s.name).width);
      if (!draws) continue;
      g.strokeStyle = g.fillStyle = colours[style]; g.setLineDash(DASHES[style]);
      if (s.dots) for (const k of [3, 13, 23]) g.fillRect(x + k - 1, y - 1, 3, 3); else line(g, x, y, x + 26, y);
      g.setLineDash([]); g.fillStyle = colours[INK]; g.fillText(s.name, x + 32, y);
    }
    return y + TITLE - 12;
  }

  // --- cursor, zoom and pan -----------------------------------------------------------------------

  pointer() {
    const { canvas } = this;
    let start = null, pans = false, began = null;
    const px = event => event.clientX - canvas.getBoundingClientRect().left;
    canvas.addEventListener("pointerdown", event => {
      if (event.button !== 0 || !this.at) return;
      start = px(event); began = this.at; pans = event.shiftKey || event.pointerType === "touch"; canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", event => {
      if (!this.at) return;
      const x = px(event);
      if (start === null) return this.cursor(x, event.clientY - canvas.getBoundingClientRect().top);
      this.line.classList.remove("spot"); this.line.style.top = "";
      if (pans) this.window(began.back(began.left + start - x), began.back(began.right + start - x));
      else { this.line.hidden = false; this.line.style.left = `${Math.min(start, x)}px`; this.line.style.width = `${Math.abs(x - start)}px`; this.line.style.opacity = .25; }
    });
    const end = event => {
      if (start === null) return;
      const from = start, x = px(event); start = null; this.line.style.width = ""; this.line.style.opacity = "";
      if (!pans && Math.abs(x - from) > 4) this.window(this.at.back(Math.min(from, x)), this.at.back(Math.max(from, x)));
      this.cursor(x);
    };
    canvas.addEventListener("pointerup", end); canvas.addEventListener("pointercancel", () => { start = null; });
    canvas.addEventListener("pointerleave", () => { if (start === null) for (const c of this.linked(true)) c.line.hidden = c.read.hidden = true; });
    canvas.addEventListener("dblclick", () => this.window(-Infinity, Infinity));
    canvas.addEventListener("wheel", event => {
      if (!event.ctrlKey || !this.at) return;  // the page scrolls as ever
      event.preventDefault(); this.zoom(Math.exp(event.deltaY / 300), px(event));
    }, { passive: false });
  }

  /** Values at a place of this chart, in all that are linked with it. */
  cursor(x, y = 0) {
    const at = this.at, value = this.axes.along ? this.along(x, y) : at.back(Math.min(Math.max(x, at.left), at.right));
    for (const c of this.linked(true)) {
      if (!c.at) continue;
      const { along } = c.axes, said = [`${(along || c.axes.x).split(" [")[0]} ${short(value)}`];
      let place = c.at.X(value), top = "";
      for (const s of c.series) {
        const k = along && !s.along ? -1 : nearest(s.along ?? s.x, value), v = s.y[k];
        if (v === undefined || Number.isNaN(v)) continue;
        if (along && s === c.series[0]) { place = c.at.X(s.x[k]); top = `${c.at.Y(v) - 4}px`; }
        said.push(`${s.name || c.axes.y.split(" [")[0]} ${short(v)}${along ? ` at ${short(s.x[k])}` : ""}`);
      }
      c.line.classList.toggle("spot", Boolean(along)); c.line.style.top = top;
      c.line.hidden = c.read.hidden = !(place >= c.at.left && place <= c.at.right) || Boolean(along && !top); c.line.style.left = `${along ? place - 4 : place}px`;
      c.read.textContent = said.join("\n");
      const over = place > (c.at.left + c.at.right) / 2;
      c.read.style.left = over ? "" : `${place + 8}px`; c.read.style.right = over ? `${c.canvas.clientWidth - place + 8}px` : "";
    }
  }

  /** What grows along the first path, at its point nearest to a place. */
  along(x, y) {
    const [s] = this.series, { X, Y } = this.at;
    let least = Infinity, found = 0;
    for (let k = 0; k < s.x.length; k++) { const d = Math.hypot(X(s.x[k]) - x, Y(s.y[k]) - y); if (d < least) { least = d; found = k; } }
    return s.along[found];
  }

  /** Shows x from one value to another, in all linked charts; nothing beyond what is recorded. */
  window(from, to) {
    if (!this.at) return;
    const [least, most] = this.at.whole, all = from <= least && to >= most, lg = this.axes.log ? Math.log10 : v => v, power = this.axes.log ? v => 10 ** v : v => v;
    if (!all && lg(to) - lg(from) < 1e-4 * (lg(most) - lg(least))) return;
    if (from < least) { to = power(lg(to) + lg(least) - lg(from)); from = least; }
    if (to > most) { from = Math.max(least, power(lg(from) - lg(to) + lg(most))); to = most; }
    for (const c of this.linked()) { c.view = all ? null : [from, Math.min(to, most)]; c.paint(); }
  }

  /** `factor` below 1 enlarges, about a place or the middle; `shift` moves by a share of the window. */
  zoom(factor, about = null, shift = 0) {
    if (!this.at) return;
    const { left, right, back } = this.at, x = about ?? (left + right) / 2, move = shift * (right - left);
    this.window(back(x - (x - left) * factor + move), back(x + (right - x) * factor + move));
  }

  // --- files --------------------------------------------------------------------------------------

  menu(plot) {
    const menu = document.createElement("details"), summary = document.createElement("summary"), list = document.createElement("div");
    menu.className = "menu"; summary.textContent = "\u22ef"; summary.title = "Drag to enlarge, Shift and drag to move, Ctrl and wheel to zoom, double click for the whole";
    summary.setAttribute("aria-label", "Zoom and save this picture");
    for (const [label, act] of [["Enlarge", () => this.zoom(.5)], ["Reduce", () => this.zoom(2)], ["Earlier", () => this.zoom(1, null, -.25)], ["Later", () => this.zoom(1, null, .25)],
      ["Whole", () => this.window(-Infinity, Infinity)], ["Save as SVG", () => this.save("svg")], ["Save as PNG", () => this.save("png")]]) {
      const button = document.createElement("button"); button.type = "button"; button.textContent = label; button.onclick = act; list.append(button);
    }
    menu.addEventListener("focusout", event => { if (!menu.contains(event.relatedTarget)) menu.open = false; });
    menu.append(summary, list); plot.append(menu);
  }

  /** The picture as on light paper, at the size of the screen; a PNG has twice its pixels. */
  async file(kind) {
    const w = this.canvas.clientWidth, h = this.canvas.clientHeight, colours = this.resolved("light");
    try {
      if (kind === "svg") { const g = new Svg(w, h); this.picture(g, w, h, colours); return new Blob([g.text()], { type: "image/svg+xml" }); }
      const canvas = document.createElement("canvas"), g = canvas.getContext("2d");
      canvas.width = 2 * w; canvas.height = 2 * h; g.scale(2, 2); g.fillStyle = "#fff"; g.fillRect(0, 0, w, h);
      this.picture(g, w, h, colours);
      return await new Promise(done => canvas.toBlob(done));
    } finally { this.paint(); }
  }

  async save(kind) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(await this.file(kind));
    link.download = `${(this.axes.y || this.series[0]?.name || "curves").replace(/\W+/g, "-").replace(/^-|-$/g, "") || "curves"}.${kind}`;
    link.click(); setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }
}

/** The part of a canvas's context that a chart uses, as SVG. */
class Svg {
  constructor(w, h) { this.head = `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${w} ${h}" width="${w}" height="${h}"><rect width="${w}" height="${h}" fill="#fff"/>`; this.parts = []; this.path = ""; this.globalAlpha = 1; this.dash = []; this.groups = 0; this.ruler = document.createElement("canvas").getContext("2d"); }
  text() { return `${this.head}${this.parts.join("")}</svg>`; }
  beginPath() { this.path = ""; }
  moveTo(x, y) { this.path += `M${short2(x)} ${short2(y)}`; }
  lineTo(x, y) { this.path += `${this.path ? "L" : "M"}${short2(x)} ${short2(y)}`; }
  rect(x, y, w, h) { this.path += `M${x} ${y}h${w}v${h}h${-w}z`; }
  arc(x, y, r) { this.path += `M${short2(x - r)} ${short2(y)}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`; }
  stroke() { this.parts.push(`<path d="${this.path}" fill="none" stroke="${this.strokeStyle}" stroke-width="${this.lineWidth}" stroke-opacity="${this.globalAlpha}" stroke-dasharray="${this.dash.join(" ") || "none"}"/>`); }
  fill() { this.parts.push(`<path d="${this.path}" fill="${this.fillStyle}" fill-opacity="${this.globalAlpha}"/>`); }
  fillRect(x, y, w, h) { this.beginPath(); this.rect(short2(x), short2(y), w, h); this.fill(); }
  setLineDash(dash) { this.dash = dash; }
  clip() { this.parts.push(`<clipPath id="axes"><path d="${this.path}"/></clipPath><g clip-path="url(#axes)">`); this.groups++; }
  save() {}
  restore() { for (; this.groups; this.groups--) this.parts.push("</g>"); }
  measureText(text) { this.ruler.font = this.font; return this.ruler.measureText(text); }
  fillText(text, x, y) {
    const plain = text.replace(/[&<>]/g, c => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;" })[c]), anchor = { left: "start", right: "end", center: "middle" }[this.textAlign];
    this.parts.push(`<text x="${short2(x)}" y="${short2(y + 4)}" text-anchor="${anchor}" fill="${this.fillStyle}" font-family="sans-serif" font-size="12"${this.font.startsWith("600") ? ' font-weight="600"' : ""}>${plain}</text>`);
  }
}

/** Draws recorded curves {name, unit, Ts, n, low, high}, lowest and highest of each piece, into `place`; the first's unit is on the axis. */
export function draw(place, curves, says, named = "") {
  const unit = curves[0]?.unit, one = curves.length === 1, title = named || (one ? curves[0].name : "");
  new Chart(place, { y: `${title}${unit ? ` [${unit}]` : ""}`.trim() }).draw(curves.map(c => {
    const step = c.n * c.Ts / c.low.length, whole = c.low.every((v, k) => v === c.high[k]);
    const each = whole ? [c.low] : [c.low, c.high], x = [], y = [];
    for (let k = 0; k < c.low.length; k++) for (const values of each) { x.push(k * step); y.push(values[k] ?? NaN); }
    return { name: one && !named ? "" : c.name, style: one && !named ? 0 : ROLES[c.name], x, y };
  }), says);
}

function styleOf(s, i) { return s.style ?? ROLES[s.name] ?? i % 5; }

/** Least and largest of arrays; with `parts`, of [array, first, end]. */
function range(arrays, parts = false) {
  let low = Infinity, high = -Infinity;
  for (const given of arrays) if (given) {
    const [values, i, j] = parts ? given : [given, 0, given.length];
    for (let k = i; k < j; k++) { const v = values[k]; if (v < low) low = v; if (v > high) high = v; }
  }
  return [low, high];
}

/** First index whose x is not below a value; x grows. */
function place(x, value) {
  let a = 0, b = x.length;
  while (a < b) { const m = (a + b) >> 1; if (x[m] < value) a = m + 1; else b = m; }
  return a;
}
/** The samples from one x to another, with a neighbour at either side. */
function inside(x, from, to) { return [Math.max(0, place(x, from) - 1), Math.min(x.length, place(x, to) + 2)]; }
function nearest(x, value) { const k = place(x, value); return k > 0 && (k >= x.length || value - x[k - 1] < x[k] - value) ? k - 1 : k; }

/** Least and largest pixel of a curve in each column of its picture. */
function reach({ x, y }, { X, Y, left, right }, begin, end) {
  const wide = Math.ceil(right - left) + 1, high = new Float32Array(wide).fill(Infinity), low = new Float32Array(wide).fill(-Infinity);
  let px = NaN, py = NaN;
  for (let k = begin; k < end; k++) {
    const qx = X(x[k]) - left, qy = Y(y[k]);
    const first = Number.isNaN(py) ? qx : px, from = Number.isNaN(py) ? qy : py, a = Math.max(0, Math.floor(Math.min(first, qx))), b = Math.min(wide - 1, Math.ceil(Math.max(first, qx)));
    for (let c = a; c <= b; c++) {
      const share = qx === first ? 0 : Math.min(1, Math.max(0, (c - first) / (qx - first))), at = from + share * (qy - from);
      if (at < high[c]) high[c] = at; if (at > low[c]) low[c] = at;
      // within a column a curve may climb all the way
      if (b - a < 2) { if (qy < high[c]) high[c] = qy; if (qy > low[c]) low[c] = qy; }
    }
    px = qx; py = qy;
  }
  return { high, low };
}
/** The same over some columns. */
function extent({ high, low }, from, to) {
  let a = Infinity, b = -Infinity;
  for (let c = Math.max(0, from); c <= Math.min(high.length - 1, to); c++) { if (high[c] < a) a = high[c]; if (low[c] > b) b = low[c]; }
  return [a, b];
}

/** A line; of many samples only the lowest and the highest of each column of pixels, which is all that one sees. */
function trace(g, { x, y }, X, Y, begin, end, pixels) {
  g.beginPath();
  let pen = false;
  if (end - begin <= 4 * pixels) for (let k = begin; k < end; k++) {
    if (Number.isNaN(y[k])) { pen = false; continue; }
    g[pen ? "lineTo" : "moveTo"](X(x[k]), Y(y[k])); pen = true;
  }
  else for (let column = 0; column < pixels; column++) {
    const i = begin + Math.floor((end - begin) * column / pixels), j = begin + Math.floor((end - begin) * (column + 1) / pixels);
    let least = i, most = i, gaps = 0;
    for (let k = i; k < j; k++) { const v = y[k]; if (v < y[least] || Number.isNaN(y[least])) least = k; if (v > y[most] || Number.isNaN(y[most])) most = k; if (Number.isNaN(v)) gaps++; }
    if (2 * gaps >= j - i) { pen = false; continue; }
    for (const k of least < most ? [least, most] : [most, least]) { g[pen ? "lineTo" : "moveTo"](X(x[k]), Y(y[k])); pen = true; }
  }
  g.stroke();
}

function dots(g, { x, y }, X, Y) {
  for (let k = 0; k < y.length; k++) if (!Number.isNaN(y[k])) g.fillRect(X(x[k]) - 1, Y(y[k]) - 1, 2.5, 2.5);
}

/** Boxes as one shape. */
function boxes(g, [left, right, low, high], X, Y) {
  g.beginPath();
  for (let k = 0; k < left.length; k++) if (!Number.isNaN(left[k])) g.rect(X(left[k]), Y(high[k]), Math.max(1, X(right[k]) - X(left[k])), Math.max(1, Y(low[k]) - Y(high[k])));
  g.fill();
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
const number = v => String(v).replace("-", "\u2212"), short = v => number(Number(v.toPrecision(4))), short2 = v => Math.round(100 * v) / 100;

/** Five to seven round numbers: the first of the usual steps that gives so many. */
export function ticks(low, high) {
  const ten = 10 ** Math.floor(Math.log10((high - low) / 6)), found = [];
  const count = s => Math.floor(high / s) - Math.ceil(low / s) + 1;
  const step = [1, 2, 5, 10, 2.5, 4, 8, 6, 1.5, 3, 20].map(k => k * ten).find(s => count(s) >= 5 && count(s) <= 7) || 10 * ten;
  // a whole number beyond 2^53 does not grow by one
  for (let k = Math.ceil(low / step); k * step <= high && found.length < 12; k++) found.push(Number((k * step).toPrecision(6)));
  return found;
}

/** The same on a logarithmic axis: powers of ten, with 3 or 2 and 5 between where they are few. */
export function decades(from, to) {
  let found = [];
  for (const each of [[1], [1, 3], [1, 2, 5]]) {
    found = [];
    for (let e = Math.floor(Math.log10(from)); 10 ** e <= to; e++) for (const k of each) { const v = Number((k * 10 ** e).toPrecision(6)); if (v >= from && v <= to) found.push(v); }
    if (found.length >= 5) return found.length > 7 ? found.filter((_, k) => k % Math.ceil(found.length / 7) === 0) : found;
  }
  return found.length > 2 ? found : ticks(from, to);
}
