// The step Verify: the stages of a commissioning as they are entered, predictions before the machine runs along them, then what it did.
import { ask, on, mark } from "/server.js";
import { sentences, teller, upper } from "/tell.js";
import { draw } from "/curves.js";
import { copies } from "/copies.js";

const $ = id => document.getElementById(id);
const NAMES = { chirp_hi_lo: "chirp, fast to slow", chirp_lo_hi: "chirp, slow to fast" };
let writes = false, busy = false, stages = [], grade = ["not yet"];

const tell = teller(document, "commission-error");
function enable() { $("commission-start").disabled = busy || !writes; $("commission-cancel").disabled = $("commission-cancel").hidden = !busy || !writes; $("commission-bar").hidden = !busy; }
function enter(stage) { stages.push(stage); const row = document.createElement("li"); row.textContent = stage; $("stages").append(row); }
/** Once something is verified, the way on is the step's action. */
function next(on) { $("commission-start").classList.toggle("primary", !on); $("verified").hidden = !on; }

$("commission-start").onclick = async () => {
  tell(null); stages = []; $("stages").replaceChildren(); enter("starting"); $("commission-verdict").textContent = ""; $("loops").replaceChildren(); $("no-commission").hidden = true; $("commission-fold").hidden = true; $("commission-bar").removeAttribute("value"); next(false);
  const seed = $("machine-seed").value;
  try {
    const effort = { seed: 0, members: $("networks").valueAsNumber, evaluations: $("commission-tries").valueAsNumber };
    if ($("commission-on").value === "drive") await ask("drive_commission", { ...effort, go_on: $("go-on").checked });
    else await ask("commission", { machine: seed ? `virtual:${seed}` : "virtual", ...effort });
    busy = true; mark("commission", "under way");
  } catch (error) { $("stages").replaceChildren(); tell(error); }
  enable();
};
$("commission-cancel").onclick = () => ask($("commission-on").value === "drive" ? "stop" : "cancel").catch(tell);
$("commission-on").onchange = () => { $("machine-seed").disabled = $("commission-on").value === "drive"; $("go-on").disabled = !$("machine-seed").disabled; };
$("commission-on").onchange();
$("go").onclick = () => { $("go").hidden = true; $("commission-start").hidden = false; ask("drive_go").catch(tell); };
on("stage", m => {
  $("go").hidden = !m.waits; $("commission-start").hidden = m.waits; if (m.waits) $("go").textContent = `Go on: ${m.next}`;
  if (m.references) { $("commission-verdict").textContent = "Predicted, before the machine runs"; loops(m.references); }
});

/** Tracking errors along each reference. */
function loops(references) {
  $("loops").replaceChildren();
  for (const r of references) {
    const name = NAMES[r.name] ?? r.name.replaceAll("_", " "), title = `${name}: error`;
    draw($("loops"), r.curves, `tracking error along ${name}, ${r.curves.map(c => c.name).join(" and ")}, over time`, title);
  }
}

on("state", s => { writes = s.writes; enable(); if (!busy) mark("commission", ...grade); });
on("progress", p => {
  if (!["commissioned", "driven"].includes(p.of)) return;
  busy = true; enable(); $("commission-bar").value = p.done / Math.max(p.total, 1);
  const [, name, share] = p.best.match(/^(.*?)(?: (\d+\/\d+))?$/);
  if (stages.at(-1) !== name) enter(name);
  $("stages").lastChild.textContent = share ? `${name}, ${share}` : name;
});
function ended(m) {
  busy = false; $("go").hidden = true; $("commission-start").hidden = false; enable();
  if (m.error) { grade = ["not verified", "bad"]; tell(new Error(m.error)); }
  if (!m.found) return mark("commission", ...grade);
  const f = m.found, cost = v => v === null ? "none" : v.toPrecision(4);
  const is = f.verdict.startsWith("verified"), unit = f.references[0]?.curves[0]?.unit ?? "";
  $("commission-verdict").textContent = `${sentences(upper(f.verdict))} Cost predicted ${cost(f.predicted_cost)} ${unit}, measured ${cost(f.measured_cost)} ${unit}`;
  grade = is ? ["verified", "good"] : ["not verified", "bad"]; mark("commission", ...grade); next(is);
  loops(f.references);
  $("commission-text").textContent = f.text; $("commission-fold").hidden = false;
  copies($("commission-copy"), { ...f, ...(m.python ? m : {}) });
}
on("commissioned", ended);
on("driven", m => { if (m.kind === "commission") ended(m); });
