// The frequency response of a recording with its bands, in Look; and the tuned loop beside it, in Tune.
import { ask, on } from "/server.js";
import { teller } from "/tell.js";
import { Chart } from "/curves.js";
import { copies } from "/copies.js";
import { chosen, columns, open } from "/data.js";

const $ = id => document.getElementById(id), x = "frequency [Hz]";
const charts = {
  gain: new Chart($("bode-gain"), { x, y: "gain [dB]", log: true }), phase: new Chart($("bode-phase"), { x, y: "phase [deg]", log: true, marks: [-180] }),
  coherence: new Chart($("bode-coherence"), { x, y: "coherence", log: true }),
  plant: new Chart($("loop-plant"), { x, y: "|plant| [dB]", log: true }), turn: new Chart($("loop-turn"), { x, y: "phase of the plant [deg]", log: true, marks: [-180] }),
  L: new Chart($("loop-L"), { x, y: "|L| [dB]", log: true, marks: [0], floor: -60 }), angle: new Chart($("loop-angle"), { x, y: "phase of L [deg]", log: true, marks: [-180] }),
  S: new Chart($("loop-S"), { x, y: "|S|, |T| [dB]", log: true, marks: [0], floor: -60 }),
};
let tune = null, view = null, response = null, notch = null, busy = false, writes = false;

/** The step Tune, whose controller is drawn, and the way to it. */
export function connect(tuning, viewing) { tune = tuning; view = viewing; }
const tell = teller(document, "bode-error");

function curve(c, at, name, label, style, dots = false) {
  return c[name] ? [{ name: label, x: c[at], y: c[name], low: c[`${name}_low`], high: c[`${name}_high`], style, dots }] : [];
}

$("bode-start").onclick = async () => {
  tell(null);
  try {
    await open();
    const segment = $("bode-segment").valueAsNumber;
    await ask("bode", { ...chosen(), reference: $("bode-reference").value || null, segment: segment > 0 ? segment : null });
    running(true);
  } catch (error) { tell(error); }
};
$("bode-cancel").onclick = () => ask("cancel").catch(tell);
function running(is) { busy = is; $("bode-state").textContent = is ? "starting" : ""; enable(); }
function enable() { $("bode-start").disabled = busy || !writes; $("bode-cancel").disabled = !busy || !writes; }
on("state", s => { writes = s.writes; enable(); });
on("progress", p => { if (p.of === "responded") { running(true); $("bode-state").textContent = p.best; } });
on("responded", m => {
  running(false);
  if (!m.found) return m.error && tell(new Error(m.error));
  const f = m.found, c = Object.fromEntries(Object.entries(f.curves).map(([name, values]) => [name, values.map(v => v ?? NaN)]));
  response = f.response; notch = f.notch; $("bode-charts").hidden = false;
  charts.gain.axes.y = `gain [dB re 1 ${f.unit}]`;
  charts.gain.draw([...curve(c, "hertz", "P_db", "measured, 95 %", 0, true), ...curve(c, "fit_hertz", "fit_db", "fit", 1)], "measured gain over frequency with its band");
  charts.phase.draw([...curve(c, "hertz", "P_deg", "measured, 95 %", 0, true), ...curve(c, "fit_hertz", "fit_deg", "fit", 1)], "measured phase over frequency with its band");
  charts.coherence.draw(curve(c, "hertz", "coherence", "", 0, true), "coherence over frequency, from 0 to 1");
  $("bode-text").textContent = `${f.text}\n\n${f.shaft}`; $("bode-text").hidden = false;
  $("bode-notch").hidden = !notch;
  if (notch) $("bode-notch").textContent = `Put the notch at ${notch[0].toPrecision(4)} Hz into the controller`;
  copies($("bode-copy"), f);
});
$("bode-notch").onclick = () => { $("notch-fold").open = true; tune.addNotch(notch); view("tune"); };
// the loop is drawn while somebody looks at it, and again with every controller that is
$("loop-fold").addEventListener("toggle", () => loop());
document.addEventListener("drawn", () => loop());

let drawing = false, again = false;
/** Plant, L, S and T of the tuned controller, with the response over it if there is one; the latest wins. */
async function loop() {
  const asked = tune.question();
  if (!$("loop-fold").open || !asked.model) return;
  if (drawing) { again = true; return; }
  drawing = true; again = false;
  try {
    const f = await ask("loop", { ...asked, response }), c = f.curves, m = "measured_hertz", at = plot => f.marks.filter(k => k.plot === plot);
    const both = (name, label) => [...curve(c, m, `measured_${name}`, "measured, 95 %", 0, true), ...curve(c, "hertz", name, label, 1)];
    charts.plant.draw(both("P_db", "model"), "gain of the plant over frequency"); charts.turn.draw(both("P_deg", "model"), "phase of the plant over frequency");
    charts.L.draw(both("L_db", "model"), "gain of L over frequency, margins marked", at("L_db")); charts.angle.draw(both("L_deg", "model"), "phase of L over frequency, phase margin marked", at("L_deg"));
    charts.S.draw([...curve(c, m, "measured_S_db", "S measured", 0, true), ...curve(c, m, "measured_T_db", "T measured", 2, true), ...curve(c, "hertz", "S_db", "S", 1), ...curve(c, "hertz", "T_db", "T", 4)], "sensitivity over frequency, its peak marked", at("S_db"));
    const whose = f.members > 1 ? `worst of ${f.members} members` : "model";
    $("loop-text").textContent = `${whose}, about ${Number(f.level.toPrecision(4))} ${tune.unit()}: ${f.text}` + (f.measured ? `\nmeasured: ${f.measured}` : "");
  } catch (error) { $("loop-text").textContent = error.message; }
  drawing = false; if (again) loop();
}

function references() {
  const kept = $("bode-reference").value;
  $("bode-reference").replaceChildren(new Option("none", ""), ...columns().map(n => new Option(n, n)));
  if (columns().includes(kept)) $("bode-reference").value = kept;
  const c = chosen();
  $("bode-what").textContent = c.file ? `${c.file}, from ${c.inputs.join(", ") || "no input"} to ${c.output || "the speed from counts"}` : "no recording";
}
document.addEventListener("columns", references);

/** Opens the step Look. */
export async function show() { await open(); references(); }
