// Curves on a canvas: one panel, shared time, colours that colour-blind people tell apart (Okabe-Ito), and dashes.
const STYLES = [["#0072b2", []], ["#d55e00", [7, 4]], ["#009e73", [2, 3]], ["#cc79a7", [9, 3, 2, 3]]];

/** Draws curves {name, unit, Ts, n, low, high} into a new canvas in `place`. */
export function draw(place, curves, says) {
  const canvas = document.createElement("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", says);
  place.append(canvas);
  const paint = () => paintInto(canvas, curves);
  new ResizeObserver(paint).observe(canvas);
  paint();
}

function paintInto(canvas, curves) {
  const scale = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (!w || !h) return;
  canvas.width = w * scale; canvas.height = h * scale;
  const g = canvas.getContext("2d"), ink = getComputedStyle(canvas).color;
  g.scale(scale, scale); g.font = "12px system-ui, sans-serif";
  let low = Infinity, high = -Infinity, seconds = 0;
  for (const c of curves) {
    for (const v of c.low) if (v !== null && v < low) low = v;
    for (const v of c.high) if (v !== null && v > high) high = v;
    seconds = Math.max(seconds, c.n * c.Ts);
  }
  if (!(high >= low)) return;
  if (high === low) { high += 1; low -= 1; }
  const left = 62, right = w - 12, top = 24, bottom = h - 34;
  const X = t => left + (right - left) * t / seconds, Y = v => bottom - (bottom - top) * (v - low) / (high - low);
  g.fillStyle = ink; g.strokeStyle = ink; g.lineWidth = 1; g.textBaseline = "middle";
  for (const v of ticks(low, high, 5)) {
    g.globalAlpha = .2; line(g, left, Y(v), right, Y(v)); g.globalAlpha = 1;
    g.textAlign = "right"; g.fillText(String(v), left - 6, Y(v));
  }
  g.textAlign = "center";
  for (const t of ticks(0, seconds, Math.max(2, w / 130))) g.fillText(String(t), X(t), bottom + 12);
  g.fillText("time [s]", (left + right) / 2, h - 8);
  let at = left;
  curves.forEach((c, i) => {
    const [colour, dash] = STYLES[i % STYLES.length], step = (right - left) * (c.n * c.Ts / seconds) / c.low.length;
    g.strokeStyle = colour; g.lineWidth = 1.6; g.setLineDash(dash); g.beginPath();
    let on = false;
    c.low.forEach((v, k) => {
      if (v === null) { on = false; return; }
      const x = left + k * step;
      g[on ? "lineTo" : "moveTo"](x, Y(v));
      if (c.high[k] !== v) g.lineTo(x, Y(c.high[k]));
      on = true;
    });
    g.stroke();
    const text = c.unit ? `${c.name} [${c.unit}]` : c.name;
    line(g, at, 10, at + 26, 10); g.setLineDash([]);
    g.textAlign = "left"; g.fillText(text, at + 32, 10); at += 52 + g.measureText(text).width;
  });
}

function line(g, x, y, x2, y2) { g.beginPath(); g.moveTo(x, y); g.lineTo(x2, y2); g.stroke(); }

function ticks(low, high, about) {
  const raw = (high - low) / about, ten = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(k => k * ten).find(s => s >= raw), found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(Number((k * step).toPrecision(6)));
  return found;
}
