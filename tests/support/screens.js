// What is wrong with a page, by boxes and colours; see screens.py.
const faults = [], name = e => `${e.tagName.toLowerCase()}${e.id ? "#" + e.id : e.className && typeof e.className === "string" ? "." + e.className.split(" ")[0] : ""} ${(e.textContent || e.value || "").trim().slice(0, 30).replace(/\s+/g, " ")}`;
const shown = e => e.checkVisibility({ visibilityProperty: true, opacityProperty: true, contentVisibilityAuto: true }) && e.getClientRects().length > 0;
const all = [...document.querySelectorAll("body *")].filter(shown), style = new Map(all.map(e => [e, getComputedStyle(e)])), box = new Map(all.map(e => [e, e.getBoundingClientRect()]));
const away = e => e.closest("header h1, svg, .plot .read, .plot .line") && (!e.closest("header h1") || style.get(e.closest("h1")).position === "absolute");
const own = e => [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()), control = e => e.matches("button, input, select, summary, a.button");
const wraps = e => style.get(e).display === "inline", scrolls = e => { for (let a = e.parentElement; a && a !== document.body; a = a.parentElement) if (/auto|scroll/.test(getComputedStyle(a).overflowX)) return true; return false; };
const held = e => { for (let a = e; a && a !== document.body; a = a.parentElement) if (["sticky", "fixed"].includes(style.get(a)?.position)) return true; return false; };

// --- clipped ---
const ruler = document.createElement("canvas").getContext("2d");
for (const e of all) {
  if (away(e) || e.tagName === "OPTION" || e.tagName === "DATALIST") continue;
  const s = style.get(e), b = box.get(e);
  if (!scrolls(e) && (b.right > document.documentElement.clientWidth + 1 || b.left < -1)) faults.push(["clipped", `${name(e)} is out of the window: ${Math.round(b.left)} to ${Math.round(b.right)}`]);
  if (!e.matches("select") && /hidden|clip/.test(s.overflowX + s.overflowY) && !e.title && s.fontSize !== "0px" && (e.scrollWidth > e.clientWidth + 1 || e.scrollHeight > e.clientHeight + 1) && !e.matches("input, canvas, progress, header, nav")) faults.push(["clipped", `${name(e)} ${e.scrollWidth}x${e.scrollHeight} in ${e.clientWidth}x${e.clientHeight}`]);
  if (/auto|scroll/.test(s.overflowX + s.overflowY) && !e.matches("select, html")) for (let a = e.parentElement; a && a !== document.body; a = a.parentElement) if (/auto|scroll/.test(getComputedStyle(a).overflowY)) faults.push(["clipped", `${name(e)} scrolls within what scrolls`]);
  const text = e.matches("input:not([type=range], [type=checkbox], [type=file])") ? e.value || e.placeholder : e.matches("select:not([multiple])") ? e.selectedOptions[0]?.text || "" : "";
  if (text) {
    ruler.font = s.font; const room = e.clientWidth - parseFloat(s.paddingLeft) - parseFloat(s.paddingRight);
    if (ruler.measureText(text).width > room + 1) faults.push(["clipped", `${name(e)}: "${text}" needs ${Math.round(ruler.measureText(text).width)} of ${Math.round(room)} px`]);
  }
  if (e.matches("button, .chip") && s.fontSize !== "0px" && (e.scrollWidth > e.clientWidth + 1 || e.scrollHeight > e.clientHeight + 1)) faults.push(["clipped", `${name(e)} ${e.scrollWidth}x${e.scrollHeight} in ${e.clientWidth}x${e.clientHeight}`]);
}

// --- overlap: controls and texts; what is held in place lies over what scrolls, and is compared among itself ---
const solid = all.filter(e => (control(e) || own(e)) && !away(e) && !e.closest(".menu, select") && e.tagName !== "OPTION");
for (const group of [solid.filter(held), solid.filter(e => !held(e))]) for (let i = 0; i < group.length; i++) for (let j = i + 1; j < group.length; j++) {
  const [a, b] = [group[i], group[j]], p = box.get(a), q = box.get(b);
  if (a.contains(b) || b.contains(a)) continue;
  // a text that breaks within a line has a box for each line
  if (wraps(a) || wraps(b)) { if ([...a.getClientRects()].some(r => [...b.getClientRects()].some(t => Math.min(r.right, t.right) - Math.max(r.left, t.left) > 1 && Math.min(r.bottom, t.bottom) - Math.max(r.top, t.top) > 3))) faults.push(["overlap", `${name(a)} and ${name(b)}: lines`]); continue; }
  const wide = Math.min(p.right, q.right) - Math.max(p.left, q.left), high = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
  if (wide > 1 && high > 1) faults.push(["overlap", `${name(a)} and ${name(b)}: ${Math.round(wide)} x ${Math.round(high)} px`]);
}

// --- contrast ---
const parsed = text => { const n = text.match(/[\d.]+/g).map(Number), srgb = text.startsWith("color("); return n.length > 3 && n[3] === 0 ? null : n.slice(0, 3).map(v => srgb ? v : v / 255).concat(n[3] ?? 1); };
const light = c => c.slice(0, 3).map(v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4).reduce((sum, v, k) => sum + v * [.2126, .7152, .0722][k], 0);
const behind = e => { for (let a = e; a; a = a.parentElement) { const c = parsed(getComputedStyle(a).backgroundColor); if (c && c[3] > .99) return c; } return [1, 1, 1, 1]; };
for (const e of all) if ((own(e) || e.matches("input, select")) && !away(e)) {
  const s = style.get(e), c = parsed(s.color); if (!c || s.fontSize === "0px") continue;
  const [a, b] = [light(c), light(behind(e))], ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05), large = parseFloat(s.fontSize) >= 24 || (parseFloat(s.fontSize) >= 18.6 && s.fontWeight >= 700);
  if (ratio < (large ? 3 : 4.5)) faults.push(["contrast", `${name(e)} ${ratio.toFixed(2)}`]);
}

// --- targets and grid ---
for (const e of all) if (control(e) || e.matches(".chip")) {
  const b = box.get(e), within = e.closest("label.check") ? box.get(e.closest("label.check")) : b;
  if (control(e) && Math.min(within.width, within.height) < 23.9) faults.push(["target", `${name(e)} ${Math.round(b.width)} x ${Math.round(b.height)}`]);
  if (Math.abs(b.height / 4 - Math.round(b.height / 4)) > .13 && !e.closest(".unit")) faults.push(["grid", `${name(e)} is ${b.height.toFixed(1)} px high`]);
}

// --- the step's action, and STOP ---
const main = all.filter(e => e.matches(".view .bar .primary"));
if (document.querySelector(".view") && main.length !== 1) faults.push(["primary", `${main.length}: ${main.map(name).join(", ")}`]);
for (const e of main) if (box.get(e).bottom > innerHeight || box.get(e).top < 0) faults.push(["primary", `${name(e)} at ${Math.round(box.get(e).top)}`]);
const stop = document.getElementById("stop"), b = stop && stop.getBoundingClientRect();
return { faults, stop: stop ? [innerWidth - b.right, b.top, b.width, b.height] : null };
