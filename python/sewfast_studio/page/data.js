// The Data view: which recording and columns; look, identify, validate; files that are dropped or chosen.
import { ask as send, on, sendBytes } from "/server.js";
import { copies } from "/copies.js";
import { panels, showLook } from "/look.js";

const $ = id => document.getElementById(id), PIECE = 48 * 1024;
let writes = false, busy = false, files = null, stale = false, uploading = false;

const number = id => $(id).valueAsNumber > 0 ? $(id).valueAsNumber : null;

/** The recording, columns and times that are chosen. */
export function chosen() {
  return {
    file: $("file").value, inputs: [...$("inputs").selectedOptions].map(o => o.value), output: $("output").value || null,
    counts: $("counts").value || null, counts_per_rev: number("counts-per-rev"), Ts: number("Ts"), resample: number("resample"),
  };
}

/** Names of the columns, for other views. */
export const columns = () => [...$("inputs").options].map(o => o.value);

function ask(name) {
  return send(name, { ...chosen(), model: $("model").value, seed: parseInt($("seed").value) || 0 });
}

function tell(error) { $("error").textContent = error ? error.message : ""; $("error").hidden = !error; }

async function act(name, show) {
  tell(null); $(name).disabled = true;
  try { show(await ask(name)); } catch (error) { tell(error); }
  $(name).disabled = false; enable();
}

function enable() {
  $("identify").disabled = busy || !writes; $("cancel").disabled = !busy || !writes; $("bar").hidden = !busy;
  $("upload").disabled = !writes || uploading;
}

on("state", s => {
  writes = s.writes;
  if (s.gone) tell(new Error("the project folder is gone: put it back, or start sewfast studio in another one"));
  if (files !== s.recordings.join("/")) {
    files = s.recordings.join("/");
    const before = $("file").value;
    fill($("file"), s.recordings.map(n => [n, n]), [s.recordings.includes(before) ? before : s.first]);
    // a recording may be large, so it is opened only where its columns are asked for
    if ($("file").value !== before) { stale = true; if (!$("data").hidden) open(); }
    if (!s.recordings.length && !s.gone) tell(new Error("there is no recording in this folder: drop a CSV, log, JSON, .mat, .npz, Parquet or MCAP file here"));
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
  clearValidation();  // it was that of the model before
  $("headline").textContent = `free run explains ${f.fit.toFixed(1)} % of the training data (rmse ${`${f.rmse.toPrecision(4)} ${f.unit}`.trim()})`;
  panels($("fit"), [f.free_run]); candidates(f.candidates); text("modeltext", f.text); copies($("identify-copy"), f);
});

function fill(select, pairs, kept) {
  select.replaceChildren(...pairs.map(([value, label]) => {
    const option = new Option(label, value); option.selected = kept.includes(value); return option;
  }));
}

/** Reads the columns of the recording that is chosen, if that was not done yet. */
export async function open() {
  if (!stale || !$("file").value) return;
  stale = false; tell(null);
  // what was found on another recording would pass for this one's
  clear(["signals", "advice", "summary", "look-copy"]); clearValidation();
  try {
    const c = await ask("columns"), names = c.names.map(n => [n, n]);
    fill($("inputs"), names, c.inputs);
    fill($("output"), [["", c.encoder ? "speed from counts" : "speed from the counts below"], ...names], [c.output ?? ""]);
    fill($("counts"), [["", c.encoder ? "counts" : "none"], ...names], [""]);
    document.dispatchEvent(new CustomEvent("columns"));
  } catch (error) { tell(error); }
}

function clear(ids) {
  for (const id of ids) { $(id).replaceChildren(); if ($(id).tagName === "PRE") $(id).hidden = true; }
}
function clearValidation() { clear(["verdict", "free", "card", "validate-copy"]); }

function text(id, value) { $(id).textContent = value; $(id).hidden = false; }

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

$("file").onchange = () => { stale = true; open(); };
$("what").onsubmit = event => event.preventDefault();
$("cancel").onclick = () => send("cancel").catch(tell);
$("look").onclick = () => act("look", f => { showLook($("data"), f); copies($("look-copy"), f); });
$("identify").onclick = () => act("identify", () => { busy = true; $("progress").textContent = "starting"; });
$("validate").onclick = () => act("validate", f => {
  $("verdict").textContent = f.verdict; panels($("free"), [f.free_run]); text("card", f.card); copies($("validate-copy"), f);
});

// --- uploads: piece by piece, each after the server has written the one before ---

let received = null;
on("received", m => { if (received) m.error ? received[1](new Error(m.error)) : received[0](m.bytes); });

async function upload(file) {
  if (uploading || !writes) return;
  tell(null); uploading = true; enable();
  try {
    await send("upload", { file: file.name, size: file.size });
    for (let at = 0; at < file.size; at += PIECE) {
      const piece = await file.slice(at, at + PIECE).arrayBuffer();
      await new Promise((done, failed) => { received = [done, failed]; sendBytes(piece); });
      $("uploaded").textContent = `${file.name}: ${(100 * Math.min(1, (at + PIECE) / file.size)).toFixed(0)} %`;
    }
    await send("upload_end");
    $("uploaded").textContent = `${file.name} is in the project folder`;
    $("file").value = file.name; $("file").onchange();
  } catch (error) { $("uploaded").textContent = ""; tell(error); }
  uploading = false; received = null; enable();
}

async function uploadAll(list) { for (const file of [...list]) await upload(file); }
$("upload").onchange = async () => { await uploadAll($("upload").files); $("upload").value = ""; };
// a file that misses the view must not replace the page
for (const name of ["dragover", "drop"]) addEventListener(name, event => event.preventDefault());
$("data").addEventListener("dragover", () => $("what").classList.add("dropping"));
$("data").addEventListener("dragleave", () => $("what").classList.remove("dropping"));
$("data").addEventListener("drop", event => { $("what").classList.remove("dropping"); uploadAll(event.dataTransfer.files); });
