// The page: its views, and the way from a recording to a model. Texts of others are only ever set as text.
import { ask as send, on } from "/server.js";
import { draw } from "/curves.js";
import { show } from "/tune.js";
import { copies } from "/copies.js";
import "/commission.js";
import { look } from "/drive.js";

const $ = id => document.getElementById(id), VIEWS = ["data", "tune", "drive", "commission"];
let writes = false, busy = false, files = null;

on("closed", () => { $("control").textContent = "not connected: start sewfast studio again, or open its whole address"; });

/** A step on the recording that is chosen. */
function ask(name) {
  const output = $("output").value, seconds = parseFloat($("resample").value);
  return send(name, {
    file: $("file").value, inputs: [...$("inputs").selectedOptions].map(o => o.value), output: output || null,
    resample: seconds > 0 ? seconds : null, model: $("model").value, seed: parseInt($("seed").value) || 0,
  });
}

function view(name) {
  for (const v of VIEWS) { $(v).hidden = v !== name; $(`view-${v}`).setAttribute("aria-pressed", v === name); }
  if (name === "tune") show();
  if (name === "drive") look();
}

function tell(error) { $("error").textContent = error ? error.message : ""; $("error").hidden = !error; }

async function act(name, show) {
  tell(null); $(name).disabled = true;
  try { show(await ask(name)); } catch (error) { tell(error); }
  $(name).disabled = false; enable();
}

function enable() {
  $("identify").disabled = busy || !writes; $("cancel").disabled = !busy || !writes; $("bar").hidden = !busy;
  $("take").hidden = writes;
}

on("state", s => {
  writes = s.writes; $("folder").textContent = s.folder;
  $("control").textContent = (writes ? "this page holds the control" : "this page looks on") + (s.pages > 1 ? `; ${s.pages} pages are open` : "");
  if (files !== s.recordings.join("/")) {
    const first = files === null;
    files = s.recordings.join("/"); fill($("file"), s.recordings.map(n => [n, n]), [s.first]);
    if (s.recordings.length) choose();
    else tell(new Error("there is no recording in this folder: put a CSV, .mat, .npz, Parquet or MCAP file there and load this page again"));
    if (first && s.models.length && (s.demo || s.models.includes(s.first))) view("tune");
  }
  enable();
});
on("progress", p => {
  if (p.of !== "identified") return;
  busy = true; $("bar").value = p.done / Math.max(p.total, 1);
  $("progress").textContent = `${p.done} of ${p.total}` + (p.best === null ? "" : `, best ${p.best.toPrecision(4)}`); enable();
});
on("identified", m => {
  busy = false; $("progress").textContent = ""; enable();
  if (m.error) return tell(new Error(m.error));
  const f = m.found;
  $("headline").textContent = `free run explains ${f.fit.toFixed(1)} % of the training data (rmse ${`${f.rmse.toPrecision(4)} ${f.unit}`.trim()})`;
  curves($("fit"), [f.free_run]); candidates(f.candidates); text("modeltext", f.text); copies($("identify-copy"), f);
});

function fill(select, pairs, chosen) {
  select.replaceChildren(...pairs.map(([value, label]) => {
    const option = new Option(label, value); option.selected = chosen.includes(value); return option;
  }));
}

async function choose() {
  tell(null);
  try {
    const c = await ask("columns"), names = c.names.map(n => [n, n]);
    fill($("inputs"), names, c.inputs);
    fill($("output"), c.encoder ? [["", "speed from counts"], ...names] : names, [c.output ?? ""]);
  } catch (error) { tell(error); }
}

function text(id, value) { $(id).textContent = value; $(id).hidden = false; }

function curves(place, panels) {
  place.replaceChildren();
  for (const panel of panels) draw(place, panel, panel.map(c => `${c.name} ${c.unit}`).join(" and ") + " over time");
}

function candidates(rows) {
  const table = document.createElement("table"), place = $("candidates");
  place.replaceChildren(); if (!rows.length) return;
  const best = Math.min(...rows.map(r => r.free_run_rmse ?? Infinity));
  const head = table.insertRow();
  for (const name of ["candidate", "settings", "free-run rmse"]) { const th = document.createElement("th"); th.textContent = name; head.append(th); }
  for (const { kind, free_run_rmse: rmse, ...rest } of rows) {
    const row = table.insertRow(), settings = Object.entries(rest).map(([k, v]) => `${k} ${v}`).join(", ");
    const cells = [kind, settings, (rmse === null ? "none" : rmse.toPrecision(4)) + (rmse === best ? " lowest" : "")];
    for (const cell of cells) row.insertCell().textContent = cell;
    row.classList.toggle("chosen", rmse === best);
  }
  place.className = "scroll"; place.tabIndex = 0; place.append(table);
}

$("file").onchange = choose;
$("what").onsubmit = event => event.preventDefault();
$("take").onclick = () => send("take");
for (const v of VIEWS) $(`view-${v}`).onclick = () => view(v);
$("cancel").onclick = () => send("cancel").catch(tell);
$("look").onclick = () => act("look", f => {
  curves($("signals"), f.curves.map(c => [c]));
  $("advice").replaceChildren(...f.advice.map(a => { const li = document.createElement("li"); li.textContent = a; return li; }));
  text("summary", f.text); copies($("look-copy"), f);
});
$("identify").onclick = () => act("identify", () => { busy = true; $("progress").textContent = "starting"; });
$("validate").onclick = () => act("validate", f => {
  $("verdict").textContent = f.verdict; curves($("free"), [f.free_run]); text("card", f.card); copies($("validate-copy"), f);
});
