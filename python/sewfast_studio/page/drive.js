// The step Record: connect, limits, arming, live curves, and a STOP that goes ahead of everything else.
import { ask, on, mark } from "/server.js";
import { teller } from "/tell.js";
import { Chart } from "/curves.js";
import { copies } from "/copies.js";
import { free, titleOf } from "/tune.js";

const $ = id => document.getElementById(id);
const LIMITS = ["volt", "speed_rpm", "acceleration", "current"], SAID = ["command", "V", "speed", "RPM", "acceleration", "RPM/s", "current", "A"], MOST_COLUMNS = 1200, PROMPT = 10;
let writes = false, drive = { connected: false, armed: false }, prompt = 0, paused = false, looping = false, charts = new Map(), run = -1, asking = false;

const tell = teller(document, "drive-error");
const seconds = value => Math.min(30, Math.max(.5, value || 5));

// --- STOP: no question, no confirmation, from every view and every page ---

function stop() {
  $("drive-state").textContent = "stopping";
  ask("stop").catch(error => { $("drive-state").textContent = "STOP not sent: use the emergency stop"; tell(error); });
}
$("stop").onclick = stop;
addEventListener("keydown", event => { if (event.key === "Escape") { event.preventDefault(); stop(); } }, { capture: true });
on("beat", m => { prompt = m.prompt; ask("alive", { n: m.n }, false); state(); $("arm").disabled = !mayArm(); });
on("closed", () => { $("drive-state").textContent = "no connection: use the emergency stop"; });
on("stopped", m => {
  drive = { ...drive, armed: false }; state(); enable();
  if (!m.moving) return;
  $("stopped").textContent = m.error || `${m.why.charAt(0).toUpperCase()}${m.why.slice(1)}: output off, confirmed after ${m.off_ms.toFixed(0)} ms. At rest after ${(m.rest_ms / 1000).toFixed(2)} s. Arm to go on.`;
});

// --- what there is ---

on("state", s => {
  writes = s.writes;
  fill($("run-controller"), s.controllers); fill($("signal"), s.excitations); fill($("reference"), s.references);
  for (const field of ["record-file", "run-file"]) free($(field), s.recordings);
  enable();
});
on("drive", m => {
  drive = m;
  if (m.error) tell(new Error(m.error));
  if (m.connected) for (const [k, name] of LIMITS.entries()) {
    const ceiling = m.ceilings[k];
    $(`limit-${name}`).placeholder = ceiling === null ? "none" : `at most ${Number(ceiling.toPrecision(4))}`;
  }
  state(); enable(); table();
  if (m.connected && !$("drive").hidden) follow();
});

function state() {
  const d = drive, speed = d.connected ? `, ${d.speed.toFixed(0)} RPM` : "";
  document.querySelector("header").classList.toggle("armed", !!d.armed);
  const said = !d.connected ? "no drive" : `${d.name}: ${d.job ? "running" : d.state}${d.state === "tripped" ? ` (${d.reason})` : ""}, ${d.armed ? "ARMED" : "not armed"}${d.job ? `, ${d.job}` : ""}`;
  if ($("drive-state").textContent !== said) $("drive-state").textContent = said;
  mark("drive", ...!d.connected ? ["no drive"] : d.state === "tripped" ? ["tripped", "bad"] : d.armed ? [d.job ? "moving" : "armed", "warn"] : ["connected", "good"]);
  $("no-drive").hidden = d.connected; $("live-panel").hidden = !d.connected;
  $("prompt").textContent = d.connected && writes && !d.armed ? (prompt < PROMPT ? `This page has answered ${prompt} of ${PROMPT} times in a row. Arming waits for that.` : "This page answers in time.") : "";
  // the last sample of a run is no speed of the drive any more
  if (!d.job) $("speed").textContent = d.connected ? `${d.state}${speed}` : "no drive";
}

function table() {
  const d = drive, rows = !d.connected ? [] : [
    ["state", d.state + (d.reason && d.state === "tripped" ? `: ${d.reason}` : "")], ["sample time", `${d.Ts * 1000} ms`], ["watchdog", `${d.watchdog * 1000} ms`],
    ["limits", isLimited() ? LIMITS.map((_, k) => `${SAID[2 * k]} ${d.limits[k] === null ? "free" : `${Number(d.limits[k].toPrecision(4))} ${SAID[2 * k + 1]}`}`).join(", ") : "none are set yet"],
    ["frames received, dropped", `${d.received}, ${d.dropped}`],
  ];
  $("drive-table").replaceChildren(...rows.map(([title, value]) => {
    const row = document.createElement("tr"), th = document.createElement("th"); th.scope = "row"; th.textContent = title; row.append(th);
    row.insertCell().textContent = value; return row;
  }));
}

/** Limits are numbers of a drive from the first that is set on; before, it moves nothing. */
function isLimited() { return !!drive.limits && drive.limits.some(v => v !== 0); }

/** Only a page that answers in time may watch over a motor. */
function mayArm() { return drive.connected && writes && !drive.job && !drive.armed && prompt >= PROMPT; }

function enable() {
  const d = drive, idle = d.connected && writes && !d.job;
  $("connect").disabled = d.connected || !writes; $("disconnect").disabled = !idle; $("limits").disabled = !idle;
  $("arm").disabled = !mayArm(); $("disarm").disabled = !idle || !d.armed; $("clear").disabled = !idle || d.state !== "tripped";
  $("record").disabled = !idle || !d.armed;
  // what comes next is the only action that stands out
  $("connect").hidden = d.connected; $("limits").hidden = !d.connected || d.armed; $("limits").classList.toggle("primary", !isLimited());
  $("arm").hidden = !d.connected || d.armed || !isLimited(); $("record").hidden = !d.armed;
  for (const id of ["disconnect", "disarm", "clear"]) $(id).hidden = $(id).disabled;
  $("run").disabled = !idle || !d.armed || !$("run-controller").value;
}

async function act(name, asked = {}) {
  tell(null);
  try { await ask(name, asked); return true; } catch (error) { tell(error); return false; }
}

$("connect").onclick = async () => {
  $("connect").disabled = true;
  await act("drive_connect", { port: $("port").value.trim(), baud: $("baud").valueAsNumber || 115200, watchdog: $("watchdog").valueAsNumber / 1000 || null }); enable();
};
$("disconnect").onclick = () => { $("stopped").textContent = $("limits-set").textContent = ""; act("drive_disconnect"); };
$("limits").onclick = async () => {
  const asked = Object.fromEntries(LIMITS.map(name => [name, $(`limit-${name}`).valueAsNumber || null]));
  $("limits-set").textContent = await act("drive_limits", asked) ? "The limits are set." : "";
};
$("arm").onclick = async () => { $("stopped").textContent = ""; await act("drive_arm"); };
$("disarm").onclick = () => act("drive_disarm");
$("clear").onclick = () => act("drive_clear");
$("record").onclick = () => begin("drive_record", { signal: $("signal").value, seed: $("record-seed").valueAsNumber || 0, scale: $("record-scale").valueAsNumber, file: $("record-file").value });
$("run").onclick = () => begin("drive_run", { controller: $("run-controller").value, reference: $("reference").value, seed: $("run-seed").valueAsNumber || 0, scale: $("run-scale").valueAsNumber, file: $("run-file").value });

async function begin(name, asked) {
  $("driven").textContent = ""; $("driven-copy").replaceChildren(); $("stopped").textContent = "";
  if (await act(name, asked)) $("driven").textContent = name === "drive_run" ? "The controller runs." : "Recording.";
}
on("driven", m => {
  if (m.kind === "commission") return;
  $("driven").textContent = m.found ? m.found.text : "";
  if (m.error) tell(new Error(m.error)); else copies($("driven-copy"), m);
});

// --- what is seen: one question under way, so that a slow page misses frames and nothing queues up ---

async function loop() {
  if ($("drive").hidden || !drive.connected) { looping = false; return; }
  if (drive.connected && !paused && !asking) {
    asking = true;
    try { paint(await ask("live", { seconds: seconds($("live-seconds").valueAsNumber), columns: Math.min(MOST_COLUMNS, Math.max(100, $("live").clientWidth - 74)) })); } catch (error) { tell(error); }
    asking = false;
  }
  requestAnimationFrame(loop);
}

function paint(f) {
  if (!f.columns || !f.curves.t) return;
  if (f.run !== run) { run = f.run; charts.clear(); $("live").replaceChildren(); }
  const panels = new Map(), t = f.curves.t, n = t.length, step = n > 1 ? t[1] - t[0] : 0;
  for (const [name, unit] of Object.entries(f.columns)) panels.set(unit, [...(panels.get(unit) || []), name]);
  for (const [unit, names] of panels) {
    if (!charts.has(unit)) charts.set(unit, new Chart($("live"), { y: `${names.find(n => names.every(m => m.startsWith(n))) ?? ""} [${unit || "1"}]`.trim() }));
    const series = names.map(name => {
      const low = f.curves[`${name}_low`], high = f.curves[`${name}_high`], x = new Float32Array(2 * n), y = new Float32Array(2 * n);
      for (let k = 0; k < n; k++) { x[2 * k] = t[k]; x[2 * k + 1] = t[k] + .5 * step; y[2 * k] = low[k]; y[2 * k + 1] = high[k]; }
      return { name: names.length > 1 ? name.replaceAll("_", " ") : "", x, y };
    });
    charts.get(unit).draw(series, `${names.join(" and ")} over the last ${seconds($("live-seconds").valueAsNumber)} seconds`);
  }
  const speed = f.curves.speed_high || f.curves.speed_true_high;
  if (speed && drive.job) $("speed").textContent = Number.isNaN(speed[n - 1]) ? "speed unknown" : `${speed[n - 1].toFixed(0)} RPM`;
  $("live-state").textContent = `${f.title}: ${f.end}${f.n ? ` of ${f.n}` : ""} samples` + (f.missing ? `, ${f.missing} missing` : "") + (drive.job ? "" : " (ended)");
  document.dispatchEvent(new CustomEvent("frame", { detail: f.end }));
}

function pause() { paused = !paused; $("pause").setAttribute("aria-pressed", paused); $("pause").textContent = paused ? "Go on (Space)" : "Pause (Space)"; }
$("pause").onclick = pause;
document.addEventListener("keydown", event => {
  if (event.key !== " " || $("drive").hidden || ["INPUT", "BUTTON", "SELECT", "SUMMARY"].includes(event.target.tagName)) return;
  event.preventDefault(); pause();
});

function fill(select, names) {
  const kept = select.value;
  select.replaceChildren(...names.map(name => new Option(titleOf(name), name)));
  if (names.includes(kept)) select.value = kept;
}

function follow() { if (!looping) { looping = true; requestAnimationFrame(loop); } }

/** Opens the step. */
export async function look() {
  follow();
  try {
    const found = await ask("ports");
    $("ports").replaceChildren(...[{ path: "virtual", text: "a computed drive" }, ...found].map(({ path, text }) => new Option(text, path)));
  } catch (error) { tell(error); }
}
