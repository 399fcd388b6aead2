// The step Look: which recording and columns; its signals; files that are dropped or chosen.
import { ask as send, on, mark, sendBytes } from "/server.js";
import { sentences, teller } from "/tell.js";
import { copies } from "/copies.js";
import { showLook } from "/look.js";

const $ = id => document.getElementById(id), PIECE = 48 * 1024;
let writes = false, files = null, stale = false, uploading = false, looking = false, turn = 0;

const number = id => $(id).valueAsNumber > 0 ? $(id).valueAsNumber : null;

/** The recording, columns and times that are chosen. */
export function chosen() {
  return {
    file: $("file").value, inputs: [...$("inputs").selectedOptions].map(o => o.value), output: $("output").value || null,
    counts: $("counts").value || null, counts_per_rev: number("counts-per-rev"), Ts: number("Ts"), resample: number("resample"),
    mask: $("mask").value.trim() || null, shift: $("shift").valueAsNumber || null, hold: $("hold").checked,
  };
}

/** Names of the columns, for other steps. */
export const columns = () => [...$("inputs").options].map(o => o.value);

const tell = teller(document, "error");
function enable() { $("upload").disabled = !writes || uploading; $("look").disabled = looking || !$("file").value; }

export function fill(select, pairs, kept) {
  select.replaceChildren(...pairs.map(([value, label]) => {
    const option = new Option(label, value); option.selected = kept.includes(value); return option;
  }));
}

on("state", s => {
  writes = s.writes;
  if (s.gone) tell(new Error("The project folder is gone. Put it back, or start sewfast studio in another one."));
  if (files !== s.recordings.join("/")) {
    files = s.recordings.join("/");
    const before = $("file").value;
    fill($("file"), s.recordings.map(n => [n, n]), [s.recordings.includes(before) ? before : s.first]);
    // a recording may be large, so it is opened only where its columns are asked for
    if ($("file").value !== before) { stale = true; if (!$("data").hidden) open(); }
    if (!s.recordings.length) asks("There is no recording in this folder. Drop a CSV, log, JSON, .mat, .npz, Parquet or MCAP file here.");
    mark("data", s.recordings.length === 1 ? "1 file" : `${s.recordings.length || "no"} files`);
    document.dispatchEvent(new CustomEvent("recordings", { detail: s.recordings }));
  }
  enable();
});

/** Reads the columns of the recording that is chosen, if that was not done yet. */
export async function open() {
  if (!stale || !$("file").value) return;
  stale = false; tell(null);
  const mine = ++turn;
  // what was found on another recording would pass for this one's
  for (const id of ["signals", "advice", "summary", "look-copy", "looked", "rows", "inputs", "output", "counts"]) $(id).replaceChildren();
  $("summary-fold").hidden = $("rows-fold").hidden = true; $("no-look").hidden = false; next(false); mark("data", "not looked at"); asks("Drop a file here, or choose one in the list. Then press Look.");
  $("mask").value = $("shift").value = ""; $("hold").checked = false;
  try {
    const c = await send("columns", chosen()), names = c.names.map(n => [n, n]);
    if (mine !== turn) return;
    fill($("inputs"), names, c.inputs); $("inputs").size = Math.min(6, Math.max(2, names.length));
    fill($("output"), [["", c.encoder ? "speed from counts" : "speed from the counts below"], ...names], [c.output ?? ""]);
    fill($("counts"), [["", c.encoder ? "counts" : "none"], ...names], [""]);
    rows(c);
    if (!c.inputs.length) { asks("Its columns are not known by their names. Choose the input and the output, then press Look."); mark("data", "needs columns", "warn"); }
    document.dispatchEvent(new CustomEvent("columns"));
  } catch (error) { if (mine !== turn) return; tell(error); mark("data", "not read", "bad"); }
}

function asks(text) { $("what-to-look-at").textContent = text; }

/** The first rows of a file, under names and units, so that a person sees which column is which. */
function rows(c) {
  const cell = (row, tag, text, scope) => { const td = document.createElement(tag); td.textContent = text; if (scope) td.scope = scope; row.append(td); };
  const head = document.createElement("tr");
  c.names.slice(0, c.units.length).forEach((name, k) => cell(head, "th", c.units[k] ? `${name} [${c.units[k]}]` : name, "col"));
  $("rows").replaceChildren(head, ...c.rows.filter(r => r.some(v => v !== null)).map(r => {
    const tr = document.createElement("tr"); for (const v of r) cell(tr, "td", v === null ? "" : Number(v.toPrecision(6)).toString()); return tr;
  }));
  $("rows-fold").hidden = false; $("rows-fold").open = true;
}

/** Does what an advice says, and looks again. */
function follow({ field, value }) {
  const at = $(field);
  if (at.type === "checkbox") at.checked = true; else at.value = field === "mask" && at.value ? `${at.value} ${value}` : value;
  at.closest("details").open = true; look();
}

/** After a look, the way on is the step's action. */
function next(on) { $("look").classList.toggle("primary", !on); $("to-model").hidden = !on; }

async function look() {
  tell(null); looking = true; enable();
  const mine = turn;  // another recording may be chosen meanwhile
  try {
    const f = await send("look", chosen());
    if (mine !== turn) return;
    $("rows-fold").open = false;  // the signals say more
    showLook($("data"), f, follow); copies($("look-copy"), f); $("no-look").hidden = true; next(true);
    const n = f.advice.filter(a => !a.idle).length;
    $("looked").textContent = n ? `${n} thing${n > 1 ? "s" : ""} to improve` : "Good to identify a model from";
    mark("data", n ? `${n} to improve` : "good", n ? "warn" : "good");
  } catch (error) { if (mine === turn) { tell(error); mark("data", "not read", "bad"); } }
  finally { looking = false; enable(); }
}

$("file").onchange = () => { stale = true; open(); };
$("what").onsubmit = event => event.preventDefault();
$("look").onclick = look;

// --- uploads: piece by piece, each after the server has written the one before ---

let received = null;
on("received", m => { if (received) m.error ? received[1](new Error(m.error)) : received[0](m.bytes); });

async function upload(file) {
  await send("upload", { file: file.name, size: file.size });
  for (let at = 0; at < file.size; at += PIECE) {
    const piece = await file.slice(at, at + PIECE).arrayBuffer();
    await new Promise((done, failed) => { received = [done, failed]; sendBytes(piece); });
    $("uploaded").textContent = `${file.name}: ${(100 * Math.min(1, (at + PIECE) / file.size)).toFixed(0)} %`;
  }
  await send("upload_end");
}

const queue = [];  // files that are dropped during an upload follow it
async function uploadAll(list) {
  if (!list.length) return;
  if (!writes) return tell(new Error("This page looks on. Press Take control, then add the files again."));
  queue.push(...list);
  if (uploading) return;
  tell(null); uploading = true; enable();
  const added = [], refused = [];
  while (queue.length) {
    const file = queue.shift();
    // each refusal names its file
    try { await upload(file); added.push(file.name); } catch (error) { refused.push(sentences(`${file.name}: ${error.message.replace(`${file.name}: `, "").replace(/^file: /, "")}`)); }
  }
  uploading = false; received = null; enable();
  $("uploaded").textContent = added.length ? `${added.join(", ")} ${added.length > 1 ? "are" : "is"} in the project folder` : "";
  if (added.length) { $("file").value = added.at(-1); stale = true; await open(); }
  if (refused.length) return tell(new Error(`upload: ${refused.join(" ")}`));
  // a person who adds a file wants to see it
  if (added.length && $("error").hidden && $("inputs").selectedOptions.length) await look();
}
$("upload").onchange = async () => { await uploadAll($("upload").files); $("upload").value = ""; };
// a file that misses the step must not replace the page
for (const name of ["dragover", "drop"]) addEventListener(name, event => event.preventDefault());
addEventListener("dragover", () => $("what").classList.add("dropping"));
addEventListener("dragleave", () => $("what").classList.remove("dropping"));
addEventListener("drop", event => { $("what").classList.remove("dropping"); uploadAll(event.dataTransfer.files); });
