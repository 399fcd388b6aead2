// The Commission view: the stages as they are entered, predictions before the machine runs along them, then what it did.
import { ask, on } from "/server.js";
import { draw } from "/curves.js";
import { copies } from "/copies.js";

const $ = id => document.getElementById(id);
let writes = false, busy = false, stages = [];

function tell(error) { $("commission-error").textContent = error ? error.message : ""; $("commission-error").hidden = !error; }
function enable() { $("commission-start").disabled = busy || !writes; $("commission-cancel").disabled = !busy || !writes; $("report").disabled = !writes; }

$("commission-start").onclick = async () => {
  tell(null); stages = []; $("stages").replaceChildren(); $("commission-verdict").textContent = ""; $("loops").replaceChildren();
  const seed = $("machine-seed").value;
  try {
    const effort = { seed: 0, members: $("networks").valueAsNumber, evaluations: $("commission-tries").valueAsNumber };
    if ($("commission-on").value === "drive") await ask("drive_commission", { ...effort, go_on: $("go-on").checked });
    else await ask("commission", { machine: seed ? `virtual:${seed}` : "virtual", ...effort });
    busy = true;
  } catch (error) { tell(error); }
  enable();
};
$("commission-cancel").onclick = () => ask($("commission-on").value === "drive" ? "stop" : "cancel").catch(tell);
$("commission-on").onchange = () => { $("machine-seed").disabled = $("commission-on").value === "drive"; $("go-on").disabled = !$("machine-seed").disabled; };
$("commission-on").onchange();
$("go").onclick = () => { $("go").hidden = true; ask("drive_go").catch(tell); };
on("stage", m => {
  $("go").hidden = !m.waits; if (m.waits) $("go").textContent = `Go on: ${m.next}`;
  if (m.references) { $("commission-verdict").textContent = "predicted, before the machine runs along it"; loops(m.references); }
});

/** Tracking errors along each reference. */
function loops(references) {
  $("loops").replaceChildren();
  for (const r of references) {
    const title = document.createElement("h3"); title.textContent = `${r.name}: tracking error`; $("loops").append(title);
    draw($("loops"), r.curves, `tracking error along ${r.name}, ${r.curves.map(c => c.name).join(" and ")}, over time`);
  }
}

on("state", s => { writes = s.writes; enable(); });
on("progress", p => {
  if (!["commissioned", "driven"].includes(p.of)) return;
  busy = true; enable();
  const [, name, share] = p.best.match(/^(.*?)(?: (\d+\/\d+))?$/);
  if (stages.at(-1) !== name) { stages.push(name); $("stages").append(document.createElement("li")); }
  $("stages").lastChild.textContent = share ? `${name}, ${share}` : name;
});
function ended(m) {
  busy = false; $("go").hidden = true; enable();
  if (m.error) return tell(new Error(m.error));
  const f = m.found, cost = v => v === null ? "none" : v.toPrecision(4);
  $("commission-verdict").textContent = `${f.verdict}: cost predicted ${cost(f.predicted_cost)}, measured ${cost(f.measured_cost)}`;
  loops(f.references);
  $("commission-text").textContent = f.text; $("commission-text").hidden = false;
  copies($("commission-copy"), { ...f, ...(m.python ? m : {}) });
}
$("report").onclick = async () => {
  $("report-error").hidden = true;
  try { await ask("report"); $("report-state").textContent = "under way"; } catch (error) { failed(error); }
};
function failed(error) { $("report-error").textContent = error.message; $("report-error").hidden = false; $("report-state").textContent = ""; }
on("reported", m => {
  if (m.error) return failed(new Error(m.error));
  $("report-state").textContent = `written: ${m.found.file}`; $("report-link").href = m.found.address; $("report-link").hidden = false;
  copies($("report-copy"), m.found);
});
on("commissioned", ended);
on("driven", m => { if (m.kind === "commission") ended(m); });
