// The step Model: identify from the recording of Look, then judge on a recording that the model has not seen.
import { ask, on, mark } from "/server.js";
import { sentences, teller } from "/tell.js";
import { copies } from "/copies.js";
import { panels } from "/look.js";
import { chosen, fill, open } from "/data.js";
import { free, titleOf } from "/tune.js";

const $ = id => document.getElementById(id);
let writes = false, busy = false, tune = null, view = null, turn = 0, latest = "", identified = "", grade = null;

/** The step Tune, and the way to a step. */
export function connect(tuning, viewing) { tune = tuning; view = viewing; }
const tell = teller(document, "model-error");
function enable() {
  $("identify").disabled = busy || !writes; $("cancel").disabled = $("cancel").hidden = !busy || !writes; $("bar").hidden = !busy;
  $("model-what").textContent = $("file").value || "no recording";
}
const step = (file, model_file) => ({ ...chosen(), file, model: $("kind").value, seed: parseInt($("seed").value) || 0, model_file });

on("state", s => {
  writes = s.writes; enable(); free($("model-file"), [...s.models, ...s.controllers, ...s.recordings]);
  const of = s.models.includes(latest) ? latest : $("model-of").value;
  fill($("model-of"), s.models.map(n => [n, titleOf(n)]), [of]); latest = "";
  if (!busy) mark("model", ...grade ?? [s.models.length ? `${s.models.length} in folder` : "none yet", s.models.length ? "good" : ""]);
});
document.addEventListener("recordings", ({ detail: names }) => {
  const kept = $("against").value, other = names.find(n => n !== $("file").value);
  fill($("against"), names.map(n => [n, n]), [names.includes(kept) ? kept : other ?? names[0]]);
});
document.addEventListener("columns", () => { clear(); enable(); });
$("against").onchange = $("model-of").onchange = clear;

/** A verdict on another recording, or of the model before, would pass for this one's. */
function clear() { turn++; $("validated").hidden = true; for (const id of ["verdict", "free", "card", "validate-copy"]) $(id).replaceChildren(); }

/** The mark of the step, until there is another one. */
function graded(...said) { grade = said; mark("model", ...said); }

async function identify() {
  tell(null); $("identify").disabled = true;
  try { await open(); await ask("identify", { ...step($("file").value, $("model-file").value), replace: "chosen" in $("model-file").dataset }); busy = true; $("progress").textContent = "starting"; } catch (error) { tell(error); }
  enable();
}
on("progress", p => {
  if (p.of !== "identified") return;
  busy = true; $("bar").value = p.done / Math.max(p.total, 1); mark("model", "under way");
  $("progress").textContent = `${p.done} of ${p.total}` + (p.best === null ? "" : `, best ${p.best.toPrecision(4)}`); enable();
});
on("identified", m => {
  busy = false; $("progress").textContent = ""; enable();
  if (m.error) { graded("failed", "bad"); tell(new Error(m.error)); }
  if (!m.found) return;  // another page asked, and is told why
  const f = m.found;
  clear(); latest = identified = f.file;
  $("headline").textContent = `The free run explains ${f.fit.toFixed(1)} % of the training data (rms error ${`${f.rmse.toPrecision(4)} ${f.unit}`.trim()}).`;
  $("no-model-yet").hidden = true; $("identify").classList.remove("primary"); $("to-tune").hidden = false;
  panels($("fit"), shown(f)); candidates(f.candidates); $("modeltext").textContent = f.text; $("modeltext-fold").hidden = false; copies($("identify-copy"), f);
  graded(`fit ${f.fit.toFixed(1)} %`, f.grade);
});

/** The two curves, and below them what is left between them: a good model's lie on each other. */
function shown(f) { return [f.free_run, [f.error]]; }

function candidates(rows) {
  $("candidates-fold").hidden = !rows.length;
  const best = Math.min(...rows.map(r => r.free_run_rmse ?? Infinity));
  $("candidates").replaceChildren(table(["candidate", "settings", "rms error of the free run"], rows.map(({ kind, free_run_rmse: rmse, ...rest }) => [
    kind, Object.entries(rest).map(([k, v]) => `${k} ${v}`).join(", "), (rmse === null ? "none" : rmse.toPrecision(4)) + (rmse === best ? " lowest" : ""),
  ]), k => rows[k].free_run_rmse === best));
}

function table(heads, rows, isChosen = () => false) {
  const made = document.createElement("table"), head = made.createTHead().insertRow(), body = made.createTBody();
  for (const name of heads) { const th = document.createElement("th"); th.scope = "col"; th.textContent = name; head.append(th); }
  rows.forEach((cells, k) => { const row = body.insertRow(); for (const cell of cells) row.insertCell().append(cell); row.classList.toggle("chosen", isChosen(k)); });
  return made;
}

const GRADES = { ok: "good", warn: "warn", fail: "bad" };
function chip(word, kind) { const made = document.createElement("span"); made.className = `chip ${kind ?? ""}`; made.textContent = word; return made; }

async function validate() {
  tell(null); $("validate").disabled = true;
  const mine = turn, file = $("against").value;
  try {
    const f = await ask("validate", step(file, $("model-of").value));
    if (mine !== turn) return;
    $("verdict").textContent = sentences(f.verdict); $("verdict").className = `chip ${f.grade}`; panels($("free"), shown(f));
    const lines = table(["question", "found", "limit", "verdict", "what it means"], f.lines.map(l => [l.name, l.shown, l.limit, chip(l.verdict, GRADES[l.verdict]), l.meaning]));
    lines.className = "blocks"; lines.createCaption().textContent = `Report card on ${file}`;
    $("card").replaceChildren(lines); copies($("validate-copy"), f); $("validated").hidden = false;
    graded(`fit ${f.fit.toFixed(1)} %`, f.grade);
  } catch (error) { if (mine === turn) tell(error); }
  finally { $("validate").disabled = false; }
}

$("identify").onclick = identify; $("validate").onclick = validate;
$("cancel").onclick = () => ask("cancel").catch(tell);
$("to-model").onclick = () => { view("model"); if (!$("identify").disabled) identify(); };
$("to-tune").onclick = () => { tune.choose(identified); view("tune"); };
enable();
