// The Commission view: the stages as they are entered, then prediction beside measurement. The virtual machine only.
import { ask, on } from "/server.js";
import { draw } from "/curves.js";
import { copies } from "/copies.js";

const $ = id => document.getElementById(id);
let writes = false, busy = false, stages = [];

function tell(error) { $("commission-error").textContent = error ? error.message : ""; $("commission-error").hidden = !error; }
function enable() { $("commission-start").disabled = busy || !writes; $("commission-cancel").disabled = !busy || !writes; }

$("commission-start").onclick = async () => {
  tell(null); stages = []; $("stages").replaceChildren(); $("commission-verdict").textContent = ""; $("loops").replaceChildren();
  const seed = $("machine-seed").value;
  try {
    await ask("commission", { machine: seed ? `virtual:${seed}` : "virtual", seed: 0, members: $("networks").valueAsNumber, evaluations: $("commission-tries").valueAsNumber });
    busy = true;
  } catch (error) { tell(error); }
  enable();
};
$("commission-cancel").onclick = () => ask("cancel").catch(tell);

on("state", s => { writes = s.writes; enable(); });
on("progress", p => {
  if (p.of !== "commissioned") return;
  busy = true; enable();
  const [, name, share] = p.best.match(/^(.*?)(?: (\d+\/\d+))?$/);
  if (stages.at(-1) !== name) { stages.push(name); $("stages").append(document.createElement("li")); }
  $("stages").lastChild.textContent = share ? `${name}, ${share}` : name;
});
on("commissioned", m => {
  busy = false; enable();
  if (m.error) return tell(new Error(m.error));
  const f = m.found, cost = v => v === null ? "none" : v.toPrecision(4);
  $("commission-verdict").textContent = `${f.verdict}: cost predicted ${cost(f.predicted_cost)}, measured ${cost(f.measured_cost)}`;
  for (const r of f.references) {
    const title = document.createElement("h3"); title.textContent = `${r.name}: tracking error`; $("loops").append(title);
    draw($("loops"), r.curves, `tracking error along ${r.name}, measured and predicted, over time`);
  }
  $("commission-text").textContent = f.text; $("commission-text").hidden = false;
  copies($("commission-copy"), f);
});
