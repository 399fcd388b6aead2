// The step Deploy: the report, and the commands that write a controller as code.
import { ask, on, mark } from "/server.js";
import { copies } from "/copies.js";
import { teller } from "/tell.js";
import { titleOf } from "/tune.js";

const $ = id => document.getElementById(id);
const tell = teller(document, "report-error");
function failed(error) { tell(error); if (error) $("report-state").textContent = ""; }

on("state", s => {
  $("report").disabled = !s.writes;
  const field = $("deploy-controller"), kept = field.value;
  field.replaceChildren(...s.controllers.map(n => new Option(titleOf(n), n)));
  if (s.controllers.includes(kept)) field.value = kept;
  $("no-controller").hidden = s.controllers.length > 0; show();
  mark("deploy", s.controllers.length ? `${s.controllers.length} saved` : "nothing yet", s.controllers.length ? "good" : "");
});

/** Once there is a report, the way on is to read it. */
function next(on) { $("report").classList.toggle("primary", !on); $("report-link").hidden = !on; $("report-link").classList.toggle("primary", on); }

function show() {
  const name = $("deploy-controller").value, quoted = /^[\w./-]+$/.test(name) ? name : `'${name.replaceAll("'", "'\\''")}'`;
  $("deploy-copy").replaceChildren();
  if (!name) return;
  copies($("deploy-copy"), { commands: `# C99, then IEC 61131-3 structured text, then an FMU\nsewfast deploy ${quoted} firmware\nsewfast deploy ${quoted} plc --to st\nsewfast deploy ${quoted} simulation --to fmi\n` });
  const fold = $("deploy-copy").querySelector("details"); fold.open = true; fold.querySelector("summary").textContent = "Commands that write it as code";
}
/** Takes a controller of the folder, as one that was just saved. */
export function choose(name) { if ([...$("deploy-controller").options].some(o => o.value === name)) { $("deploy-controller").value = name; show(); } }
$("deploy-controller").onchange = show;
$("report").onclick = async () => {
  failed(null); next(false);
  try { await ask("report"); $("report-state").textContent = "under way"; } catch (error) { failed(error); }
};
on("reported", m => {
  if (!m.found) return m.error && failed(new Error(m.error));
  $("report-state").textContent = `Written: ${m.found.file}`; $("report-link").href = m.found.address; next(true);
  copies($("report-copy"), m.found);
});
