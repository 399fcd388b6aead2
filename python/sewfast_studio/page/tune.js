// The step Tune: sliders whose every move is a question to the server, and at most one under way; the latest wins.
import { BESIDE, Chart, REFERENCE } from "/curves.js";
import { sentences, teller } from "/tell.js";

const PINS = ["A", "B"], MOST_NOTCHES = 4, DEEPEST = -30, CALM = 700;
const WEIGHTS = [["tracking", "y"], ["chatter", "u"], ["effort", "u"], ["overshoot", "%"], ["rise", "ms"], ["lag", "ms"], ["saturation", "share"]];
const KNOBS = { alpha: "weight alpha", beta: "weight beta", N: "derivative filter N", filter_samples: "mean of feedback", filter_time: "lag of feedback" };
const NUMBERS = [ // name, title, unit
  ["Ms", "Ms", ""], ["Mt", "Mt", ""], ["phase_margin_deg", "phase margin", "deg"], ["gain_margin", "gain margin", ""],
  ["delay_margin_ms", "delay margin", "ms"], ["crossover_hz", "crossover", "Hz"], ["noise_gain", "noise gain", "u/y"],
  ["rise_ms", "rise 10 to 90 %", "ms"], ["overshoot_percent", "overshoot of this step", "%"], ["settling_ms", "settling, 2 %", "ms"],
  ["peak", "disturbance peak", "y"], ["recovery_ms", "recovery", "ms"], ["u_rms", "command, rms", "u"], ["du_rms", "its change, rms", "u"],
];

/** A file of a commissioning by a name that fits into a field. */
export const titleOf = name => name.replace(/^commissioned\/\w+\//, "commissioned: ");

/** A name that no file has: the one of a field, or, where a person did not choose it, with the next number. */
export function free(field, files) {
  field.oninput = () => { field.dataset.chosen = "yes"; };
  if (field.dataset.chosen) return;
  const [, word, number, ending] = /^(.*?)(?:-(\d+))?(\.\w+)?$/.exec(field.value);
  for (let k = Number(number ?? 1); files.includes(field.value);) field.value = `${word}-${++k}${ending}`;
}

/**
 * Brings the view to life: `root` holds its elements, `ask` and `on` reach the steps (server.js).
 * Returns how it is opened, its controller as a question has it, and how a notch is put in.
 */
export function mount(root, { ask, on, mark = () => {} }) {
  const $ = id => root.querySelector(`[id="${id}"]`);
  const charts = {
    step: new Chart($("step-plot"), {}), command: new Chart($("command-plot"), {}), load: new Chart($("load-plot"), {}),
    loop: new Chart($("loop-plot"), { x: "frequency [Hz]", y: "|L| [dB]", log: true, marks: [0], floor: -60 }),
    phase: new Chart($("phase-plot"), { x: "frequency [Hz]", y: "phase of L [deg]", log: true, marks: [-180] }),
    nichols: new Chart($("nichols-plot"), { x: "phase of L [deg]", y: "Nichols: |L| [dB]", along: "frequency [Hz]", marks: [0], floor: DEEPEST, roof: 40 }),
    upset: new Chart($("upset-plot"), {}),
    sensitivity: new Chart($("sens-plot"), { x: "frequency [Hz]", y: "|S|, |T| [dB]", log: true, marks: [0], floor: -60 }),
  };
  let opened = null, values = {}, history = [], first = null, now = null, pins = {}, asking = false, again = null, resting = 0, knobs = [], busy = false, writes = false, saving = false, notches = [], failed = "", front = [], before = null, judged = null, verdict = null, weighing = 0, sought = null, stored = null, storedAs = "";

  const question = more => ({ model: $("tune-model").value, controller: $("tune-start").value || null, values, notches, ...more });
  const given = pairs => Object.fromEntries(pairs.map(([name, id]) => [name, $(id).valueAsNumber]).filter(([, v]) => Number.isFinite(v)));
  const weights = () => given(WEIGHTS.map(([name]) => [name, `weight-${name}`]));
  const tell = teller(root, "tune-error");

  let turn = 0, opening = 0, shown = null, missed = "";
  const place = (model, start) => JSON.stringify([model, start || null]), chosen = () => place($("tune-model").value, $("tune-start").value);

  /** Opens what is chosen. Until then nothing is open, as the values are another one's. False if it was refused, null if something else was chosen meanwhile. */
  async function open(kept = {}) {
    tell(null); opened = null;
    if (shown !== chosen()) { shown = chosen(); $("saved").textContent = ""; waits(); }
    enable();
    const mine = ++turn;
    if (!$("tune-model").value) { blank(); return false; }
    opening++;
    try {
      const found = await ask("tune_open", question({ values: {} }));
      if (mine !== turn) return null;
      opened = found;
      const start = Object.fromEntries(opened.knobs.map(k => [k.name, k.value]));
      values = { ...start, ...Object.fromEntries(Object.entries(kept).filter(([name]) => name in start)) };
      history = []; pins = {}; first = before = now = judged = verdict = null; front = []; $("front").hidden = true;
      if (Object.keys(kept).length) {
        const begun = await loopOf(start);
        if (mine !== turn) return null;
        first = begun;
      }
      $("figures").hidden = $("step-plot").parentNode.hidden = false;
      $("tune-members").textContent = opened.members > 1 ? `${opened.members} models. A curve is their median. Its band holds all of them.` : ""; $("limit-unit").textContent = `[${opened.u_unit}]`;
      for (const [name, per] of WEIGHTS) $(`weight-${name}`).previousSibling.textContent = `${name}, per ${{ u: opened.u_unit, y: opened.y_unit }[per] || per} `;
      const measures = opened.counts || !opened.noise;
      $("noise").disabled = measures; $("noise").checked = opened.counts || (!measures && $("noise").checked);
      $("noise-what").textContent = opened.counts ? "Noise of the encoder's counts" : opened.noise ? `Noise of ${text(opened.noise)} ${opened.y_unit}, as recorded` : "Noise: none was recorded";
      $("knob-feedforward-value").disabled = false;
      sliders(); move(); listNotches();
      if (missed) tell(new Error(missed));
      missed = "";
      if (untaken.has(shown)) takeIt(...untaken.get(shown));
      return true;
    } catch (error) {
      if (mine !== turn) return null;
      opened = null; blank(); tell(error);
      return false;
    } finally { opening--; }
  }

  /** Nothing is open: what is shown of the one before would pass for that of the one that is chosen. */
  function blank() {
    now = first = before = judged = verdict = null; pins = {}; history = [];
    for (const id of ["knobs", "lights", "reasons", "cost", "notches"]) $(id).replaceChildren();
    $("figures").hidden = $("step-plot").parentNode.hidden = $("front").hidden = true; enable();
  }

  function sliders() {
    knobs = opened.knobs.filter(k => k.name !== "feedforward").map(k => {
      const label = document.createElement("label"), slider = document.createElement("input"), field = document.createElement("input");
      label.textContent = (KNOBS[k.name] ?? k.name.replaceAll("_", " ")) + (k.unit ? ` [${k.unit}]` : ""); label.htmlFor = `knob-${k.name}`;
      const to = v => k.log ? Math.log(v / k.low) / Math.log(k.high / k.low) : (v - k.low) / (k.high - k.low);
      const from = p => k.log ? k.low * (k.high / k.low) ** p : k.low + p * (k.high - k.low);
      // a browser that keeps fields over a reload gives values of those without a name to the next ones of the page: these are made later
      Object.assign(slider, { type: "range", id: label.htmlFor, name: label.htmlFor, min: 0, max: 1, step: k.whole ? 1 / (k.high - k.low) : .005 });
      Object.assign(field, { type: "number", id: `${label.htmlFor}-value`, name: `${label.htmlFor}-value`, step: "any" }); field.setAttribute("aria-label", label.textContent);
      const show = () => {
        slider.value = to(values[k.name]); field.value = Number(values[k.name].toPrecision(5));
        slider.setAttribute("aria-valuetext", `${field.value} ${k.unit}`);
      };
      let held = null;  // values when a drag began: a drag is one step back
      slider.oninput = event => {
        if (!held) { held = { ...values }; keep(held); }
        const v = from(slider.valueAsNumber);
        values = { ...values, [k.name]: k.whole ? Math.round(v) : Number(v.toPrecision(5)) }; show(); move(event.timeStamp);
      };
      slider.onchange = () => { held = null; };
      field.onchange = () => { if (Number.isFinite(field.valueAsNumber)) { keep(values); values = { ...values, [k.name]: field.valueAsNumber }; show(); move(); } };
      show();
      return { show, nodes: [label, slider, field] };
    });
    $("knobs").replaceChildren(...knobs.flatMap(k => k.nodes));
    const lead = () => { $("knob-feedforward-value").checked = values.feedforward === 1; };
    knobs.push({ show: lead }); lead();
  }

  /** The sliders of the trade-off: one front, and either end of it; the calmest controller is the first. */
  function trade(k) {
    const most = front.length - 1, of = front[k];
    $("front-response").value = k; $("front-robust").value = most - k;
    return of.values;
  }
  let traded = null;  // values when a drag began
  for (const [id, at] of [["front-response", v => v], ["front-robust", v => front.length - 1 - v]]) {
    $(id).oninput = event => {
      if (!traded) { traded = { ...values }; keep(traded); }
      values = { ...values, ...trade(at($(id).valueAsNumber)) }; knobs.forEach(k => k.show()); move(event.timeStamp);
    };
    $(id).onchange = () => { traded = null; };
  }

  /** The notches that were put into the start, each with the way to take it out again. */
  function listNotches() {
    $("notches").replaceChildren(...notches.map(([f], k) => {
      const li = document.createElement("li"), button = document.createElement("button");
      button.textContent = `Remove the notch at ${Number(f.toPrecision(4))} Hz`;
      button.onclick = () => { notches = notches.filter((_, j) => j !== k); open(withoutNotches(values)); };
      li.append(button); return li;
    }));
    $("add-notch").disabled = !opened || notches.length >= MOST_NOTCHES;
  }
  // their numbers move up when one is removed, so that the others begin anew
  function withoutNotches(v) { return Object.fromEntries(Object.entries(v).filter(([name]) => !name.startsWith("notch_"))); }

  async function addNotch(numbers) {
    const before = notches, kept = opened ? values : {};
    notches = [...notches, numbers];
    if (await open(kept) === false) { const said = $("tune-error").textContent; notches = before; await open(kept); tell(new Error(`notch: ${said}`)); }
  }

  function keep(v) { tell(null); before = now; history.push({ ...v }); if (history.length > 200) history.shift(); enable(); }
  function set(v) { keep(values); values = { ...v }; knobs.forEach(k => k.show()); move(); }
  function undo() { tell(null); if (history.length) { before = now; values = history.pop(); knobs.forEach(k => k.show()); move(); } }

  /** Asks for the loop with the present values; while one question is under way only the latest waits. */
  async function move(began = performance.now()) {
    enable();
    if (!opened) return;
    if (asking) { again = began; return; }
    asking = true; clearTimeout(resting); clearTimeout(weighing); $("cost").classList.add("old"); $("reasons").classList.add("old");
    const asked = values, of = opened;
    try {
      const found = await loopOf(asked);
      // the answer is of one that was open before
      if (of !== opened) { asking = false; again = null; return move(); }
      if (found.stamp !== opened.stamp) return await anew();
      now = found; first ??= now; judged = verdict = null; paint();
      // what something else has said stays until a person goes on
      if (failed && $("tune-error").textContent === failed) tell(null);
      failed = "";
      requestAnimationFrame(() => setTimeout(() => document.dispatchEvent(new CustomEvent("drawn", { detail: performance.now() - began }))));
    } catch (error) { if (of === opened) { tell(error); failed = $("tune-error").textContent; } }
    // what has come meanwhile waits for the next picture, as then the newest does
    if (again !== null) return requestAnimationFrame(() => { const since = again; again = null; asking = false; if (opened) move(since); });
    asking = false; resting = setTimeout(judge, 250);
  }

  async function loopOf(values) { return { ...await ask("tune_move", question({ values, noise: $("noise").checked && !opened.counts })), values }; }

  /** Curves that stand beside the present ones, with noise or without as those. */
  async function withNoise() {
    try {
      const fresh = new Map([[null, null]]), of = opened;
      for (const f of [first, before, pins.A, pins.B]) if (f && !fresh.has(f)) {
        fresh.set(f, await loopOf(f.values));
        if (of !== opened) return;
      }
      first = fresh.get(first); before = fresh.get(before); for (const p of PINS) if (pins[p]) pins[p] = fresh.get(pins[p]);
    } catch (error) { tell(error); }
    move();
  }

  /** A file of this name is another one now: what is shown of it begins again, with the numbers as they stand. */
  async function anew() {
    const was = opened, kept = values, moved = was.knobs.some(k => values[k.name] !== k.value);
    asking = false; again = null;
    if (!await open()) return;
    // gains that were set by hand stay, unless they are in other units now
    if (moved && was.u_unit === opened.u_unit && was.y_unit === opened.y_unit) await open(kept);
    if (opened) tell(new Error("The model or the controller in the folder has changed. The start was computed again."));
  }

  /** What a search would find of these gains: their cost, and what its limits count. It takes longer, so it waits for a rest. */
  async function judge() {
    if (asking || !opened) return;
    const asked = values, of = opened;
    try {
      const found = await ask("tune_judge", question({ weights: weights() }));
      if (asked !== values || of !== opened) return;
      judged = found;
      const { cost, start_cost: start } = judged, share = 100 * (cost / start - 1), off = Math.abs(share).toFixed(1);
      $("cost").textContent = cost === null ? "cost: the loop diverges" : `cost ${cost.toPrecision(4)} ${opened.y_unit}` + (start === null ? ", while the start diverges" : off === "0.0" ? ", that of the start" : `, ${off} % ${share < 0 ? "below" : "above"} the start`);
      $("cost").classList.remove("old"); weighing = setTimeout(weigh, CALM); lights();
    } catch (error) { if (of === opened) tell(error); }
  }

  /** The verdict of the core on these gains; it runs the references, so it waits for a longer rest. */
  async function weigh() {
    if (asking || !opened) return;
    const asked = values, of = opened;
    try {
      const found = await ask("tune_verdict", question());
      if (asked !== values || of !== opened) return;
      verdict = found; const said = found.text.slice(found.grade.length + 2);
      $("reasons").textContent = said ? sentences(said) : ""; $("reasons").classList.remove("old"); lights();
    } catch (error) { if (of === opened) tell(error); }
  }

  const STYLES = { now: 0, A: 1, B: 3, before: BESIDE, start: BESIDE };
  const each = () => {
    const beside = $("compare").value, other = beside === "before" && before !== first ? before : beside ? first : null;
    return [["now", now], ...PINS.filter(p => pins[p]).map(p => [p, pins[p]]), [other === first ? "start" : "before", other]].filter(([, f], i) => i === 0 || (f && f !== now));
  };

  function series(x, name, f, label, style) {
    const c = f.curves;
    return c[name] ? [{ name: label, x: c[x], y: c[name], low: f === now ? c[`${name}_low`] : null, high: c[`${name}_high`], style }] : [];
  }

  /** L as a path through gain and phase; of an ensemble each frequency has a box that holds all members. */
  function nichols(label, f, style) {
    const c = f.curves, end = c.L_db.findIndex(v => v < DEEPEST), cut = name => c[name]?.slice(0, end > 0 ? end : undefined);
    const box = f === now && c.L_db_low ? [cut("L_deg_low"), cut("L_deg_high"), cut("L_db_low"), cut("L_db_high")] : null;
    return { name: label, x: cut("L_deg"), y: cut("L_db"), along: cut("hertz"), box, style };
  }
  /** Where |S| is at its limit: 1 + L lies on a circle about 0. */
  function circle(Ms) {
    const x = [], y = [];
    for (let k = 0; k <= 90; k++) {
      const a = k * Math.PI / 45, re = 1 - Math.cos(a) / Ms, im = -Math.sin(a) / Ms;
      x.push(-180 + Math.atan2(im, re) * 180 / Math.PI); y.push(20 * Math.log10(Math.hypot(re, im)));
    }
    return { name: `Ms ${Ms}`, x, y, style: 4 };
  }

  function paint() {
    const shown = each(), style = name => STYLES[name], y = opened.y_unit, u = opened.u_unit;
    const word = label => shown.length > 1 ? label : "";  // a curve alone needs no name
    const all = (x, name) => shown.flatMap(([label, f]) => series(x, name, f, word(label), style(label)));
    const says = now.diverges ? "the loop diverges" : `overshoot ${text(now.overshoot_percent)} %, rise ${text(now.rise_ms)} ms, Ms ${text(now.Ms)}`;
    charts.step.axes.y = `step: output [${y}]`; charts.command.axes.y = `step: command [${u}]`; charts.load.axes.y = `disturbance ${text(opened.disturbance)} ${u}: output [${y}]`;
    charts.step.draw(now.diverges ? [] : [...shown.flatMap(([label, f]) => series("reference_t", "reference_y", f, label, style(label))), ...series("reference_t", "reference_r", now, "reference", REFERENCE)], `step response, ${says}`);
    charts.command.draw(now.diverges ? [] : all("reference_t", "reference_u"), "command of the step");
    charts.load.draw(now.diverges ? [] : all("disturbance_t", "disturbance_y"), `disturbance response, recovery ${text(now.recovery_ms)} ms`);
    charts.upset.axes.y = `disturbance: command [${u}]`; charts.upset.draw(now.diverges ? [] : all("disturbance_t", "disturbance_u"), "command against the disturbance");
    const limit = limitMs();
    charts.nichols.draw([...shown.map(([label, f]) => nichols(label, f, style(label))), ...limit > 1 ? [circle(limit)] : []], `Nichols chart of L, and where Ms is ${limit}`, [{ x: -180, y: 0, label: "\u22121" }]);
    charts.loop.draw(all("hertz", "L_db"), "size of L over frequency");
    charts.phase.draw(all("hertz", "L_deg"), "phase of L over frequency");
    charts.sensitivity.draw([...series("hertz", "S_db", now, "S", 0), ...series("hertz", "T_db", now, "T", 4),
      ...shown.slice(1).flatMap(([label, f]) => series("hertz", "S_db", f, `S ${label}`, style(label)))], `sensitivity, peak ${text(now.Ms)}`);
    if (front.length) { $("front-rise").value = `rise ${shortTime(now.rise_ms)}`; $("front-Ms").value = `Ms ${text(now.Ms)}`; }
    numbers(shown); lights();
  }

  const text = v => v === null || v === undefined ? "none" : Number(v.toPrecision(3)).toString().replace("-", "\u2212");
  const SLOW = 1e4, shortTime = ms => ms === null ? "without end" : ms > SLOW ? `${text(ms / 1000)} s` : `${text(ms)} ms`;

  /** The table is made when its columns change; a move only writes into it, which the browser lays out sooner. */
  function numbers(shown) {
    const table = $("numbers"), titles = shown.map(([label]) => label), unit = { u: opened.u_unit, y: opened.y_unit, "u/y": `${opened.u_unit}/${opened.y_unit}` };
    const head = ["quantity", ...titles, "unit"], rows = NUMBERS.map(([name, title, of]) => {
      const values = shown.map(([, f]) => f[name]), slow = of === "ms" && values.some(v => v > SLOW);
      return [title, ...values.map(v => text(slow && v ? v / 1000 : v)), slow ? "s" : unit[of] ?? of];
    });
    if (table.rows.length !== rows.length + 1 || table.rows[0].cells.length !== head.length) {
      table.replaceChildren(...[head, ...rows].map((cells, k) => {
        const row = document.createElement("tr");
        row.append(...cells.map((_, i) => {
          const cell = document.createElement(k && i ? "td" : "th");
          if (k && i && i <= titles.length) cell.className = "n";
          if (!k || !i) cell.scope = k ? "row" : "col";
          return cell;
        }));
        return row;
      }));
    }
    [head, ...rows].forEach((cells, k) => cells.forEach((said, i) => { const cell = table.rows[k].cells[i]; if (cell.textContent !== said) cell.textContent = said; }));
  }

  const limitMs = () => parseFloat($("limit-Ms").value) || 1.8, HAIR = 1.001, KINDS = { good: "good", fair: "warn", poor: "bad", unfit: "bad" };

  /** The verdict and the limits as words and signs, never by colour alone. A search judges by its own references, and so do the limits:
   * what is drawn is one step. */
  function lights() {
    const limit = limitMs(), over = parseFloat($("limit-overshoot").value), most = parseFloat($("limit-u").value);
    const row = (what, found, limit, unit = "") => [what, judged && found !== null && found <= limit * HAIR, `${judged ? ` ${found === null ? "without end" : text(found) + unit},` : ""} at most ${limit}${unit}`];
    // a search has no linear loops of some models: then that of the table counts
    const rows = [row("Ms", judged?.Ms === 0 ? now.Ms : judged?.Ms, limit)];
    if (Number.isFinite(over)) rows.push(row("overshoot", judged?.overshoot, over, " %"));
    if (Number.isFinite(most)) rows.push(row("command", judged?.u, most, ` ${opened.u_unit}`));
    if (limit > 1) $("Ms-means").textContent = `Ms ${limit} leaves a gain margin of at least ${text(limit / (limit - 1))} and a phase margin of at least ${text(2 * Math.asin(.5 / limit) * 180 / Math.PI)} degrees.` +
      (judged?.Ms > 1.01 * now.Ms ? ` The table holds about ${text(opened.level)} ${opened.y_unit}. The limit counts other levels too: Ms is ${text(judged.Ms)} there.` : "") +
      (Number.isFinite(over) && judged?.overshoot < .99 * now.overshoot_percent ? " The limit of overshoot counts the references of a search, not this step." : "");
    const stable = now.stable && !now.diverges;
    const chips = [[verdict ? `gains ${verdict.grade}` : "gains: being judged", verdict ? KINDS[verdict.grade] : ""], [stable ? "stable" : "unstable", stable ? "good" : "bad"],
      ...rows.map(([what, ok, said]) => [`${what}${judged ? "" : ":"}${said}`, !judged ? "" : ok ? "good" : "bad"])];
    while ($("lights").children.length > chips.length) $("lights").lastChild.remove();
    chips.forEach(([said, kind], k) => {
      const li = $("lights").children[k] ?? $("lights").appendChild(document.createElement("li"));
      if (li.textContent !== said) li.textContent = said;
      li.className = `chip ${kind}`; li.title = k < 2 ? "" : "The largest of all references, models and variations that a search runs";
    });
    const broken = !stable || (judged && rows.some(([, ok]) => !ok)), rated = verdict && verdict.grade !== "good";
    mark("tune", !stable ? "unstable" : broken ? "limit broken" : rated ? verdict.grade : `Ms ${text(now.Ms)}`, broken ? "bad" : rated ? KINDS[verdict.grade] : judged ? "good" : "");
  }

  function enable() {
    $("undo").disabled = !history.length; $("reset").disabled = !opened;
    $("search").disabled = $("trade").disabled = !opened || busy || !writes; $("tune-cancel").disabled = $("tune-cancel").hidden = !busy || !writes; $("tune-bar").hidden = !busy;
    $("save").disabled = !opened || !writes; $("add-notch").disabled = !opened || notches.length >= MOST_NOTCHES;
    // what comes next is the only action that stands out
    const next = values === stored ? "to-deploy" : values === sought && !busy ? "save" : "search";
    for (const id of ["search", "save", "to-deploy"]) $(id).classList.toggle("primary", id === next);
    $("to-deploy").hidden = next !== "to-deploy";
    for (const p of PINS) { $(`pin-${p}`).disabled = !opened; $(`take-${p}`).disabled = !pins[p]; }
  }

  async function copied(button, which) {
    try {
      const file = values === stored ? storedAs : $("save-name").value;  // what was saved is repeated under its name
      const said = (await ask("tune_copy", question({ file })))[which], label = button.textContent;
      $("tune-copy").textContent = said; $("tune-copy").hidden = false;
      await navigator.clipboard.writeText(said).then(() => { button.textContent = "Copied"; setTimeout(() => { button.textContent = label; }, 1200); }, () => {});
    } catch (error) { tell(error); }
  }

  for (const id of ["tune-model", "tune-start"]) $(id).onchange = () => { notches = []; open(); };
  $("weights").replaceChildren(...WEIGHTS.map(([name, per]) => {
    const label = document.createElement("label"), field = document.createElement("input");
    label.textContent = `${name}, ${per} `; Object.assign(field, { type: "number", min: 0, step: "any", id: `weight-${name}`, name: `weight-${name}`, placeholder: "usual" });
    field.onchange = () => { if (opened) { $("cost").classList.add("old"); judge(); } };
    label.append(field); return label;
  }));
  $("add-notch").onclick = () => {
    const f = $("notch-hz").valueAsNumber;
    f > 0 ? addNotch([f, .1, .5]) : tell(new Error("notch: Expected a frequency in Hz. Type it, or take the one that the frequency response in Look proposes."));
  };
  $("undo").onclick = undo;
  $("reset").onclick = () => set(Object.fromEntries(opened.knobs.map(k => [k.name, k.value])));
  for (const p of PINS) {
    $(`pin-${p}`).onclick = () => { pins[p] = now; enable(); paint(); };
    $(`take-${p}`).onclick = () => set(pins[p].values);
  }
  $("compare").oninput = () => { if (opened && now) paint(); };
  // who sets a limit wants it kept
  for (const id of ["limit-Ms", "limit-overshoot", "limit-u"]) $(id).oninput = () => { $("tune-within").checked = true; if (opened && now) paint(); };
  $("noise").onchange = withNoise;
  let alone = null;  // the weights of the reference, whose work a feedforward does
  $("knob-feedforward-value").onchange = event => {
    const on = event.target.checked, { alpha, beta } = values;
    set({ ...values, ...on ? { alpha: 0, beta: 0 } : alone, feedforward: on ? 1 : 0 });
    alone = on ? { alpha, beta } : null;
  };
  $("search").onclick = () => search("tune_search");
  $("trade").onclick = () => search("tune_front");
  async function search(what) {
    tell(null);
    const constraints = $("tune-within").checked ? given([["Ms", "limit-Ms"], ["overshoot", "limit-overshoot"], ["u", "limit-u"]]) : {};
    const seconds = $("tune-seconds").valueAsNumber, effort = { evaluations: $("evaluations").valueAsNumber, seed: $("tune-seed").valueAsNumber, seconds: seconds > 0 ? seconds : null };
    try { await ask(what, question({ ...effort, weights: weights(), constraints })); busy = true; $("tune-progress").textContent = "starting"; enable(); } catch (error) { tell(error); }
  }
  const untaken = new Map(), listed = (id, name) => [...$(id).options].some(o => o.value === name);
  let waiting = "";
  /** Takes what a search found if it is of the model and start that are open; else once they are: another page, or this one before, can have asked. */
  function takeIt(found, values, take) {
    const of = place(found.model, found.start), same = of === shown && opened;
    untaken.delete(of);
    if (!same) { untaken.set(of, [found, values, take]); return waits(); }
    if (opened.knobs.length === Object.keys(values).length && opened.knobs.every(k => k.name in values)) return take();
    $("tune-progress").textContent = "A search with other notches has ended.";
  }
  /** Says which search waits for its model or start to be chosen, the newest first. */
  function waits() {
    if (busy) return;
    const [found] = [...untaken].filter(([of]) => of !== chosen()).at(-1)?.[1] ?? [], start = found?.start ? titleOf(found.start) : "computed from the model";
    const gone = !found ? "" : !listed("tune-model", found.model) ? found.model : found.start && !listed("tune-start", found.start) ? found.start : "";
    $("tune-progress").textContent = waiting = !found ? "" : gone ? `A search has ended, but ${titleOf(gone)} is no longer in the folder. Put it back to see what was found.` : found.model !== $("tune-model").value ? `A search for ${titleOf(found.model)} has ended. Choose this model to see what was found.` : `A search from another start has ended. Choose the start “${start}” to see what was found.`;
  }
  $("tune-cancel").onclick = () => ask("cancel").catch(tell);
  $("save").onclick = async () => {
    tell(null);
    const file = $("save-name").value, written = values;
    saving = true;
    try {
      await ask("tune_save", question({ file, replace: "chosen" in $("save-name").dataset })); $("saved").textContent = `Written: ${file}`;
      stored = written; storedAs = file;
      // the start is this controller now, and has the notches that were put into it
      if (file === $("tune-start").value) { const same = values === written; notches = []; if (await open(values) && same) stored = values; }
      enable();
    } catch (error) { tell(error); }
    saving = false;
  };
  $("copy-python").onclick = event => copied(event.target, "python");
  $("copy-commands").onclick = event => copied(event.target, "commands");
  root.addEventListener("keydown", event => {
    if ($("tune").hidden || event.target.type === "number" || event.target.type === "text") return;
    if (event.key === "z" || event.key === "Z") { event.preventDefault(); undo(); }
  });
  on("progress", p => {
    if (p.of !== "searched" && p.of !== "traded") return;
    busy = true; $("tune-bar").value = p.done / Math.max(p.total, 1); $("tune-progress").textContent = `${p.done} of ${p.total}`; enable();
  });
  on("searched", m => {
    busy = false; $("tune-progress").textContent = ""; enable();
    if (!m.found) return m.error && tell(new Error(m.error));  // another page is told why
    takeIt(m.found, m.found.values, () => {
      $("tune-progress").textContent = m.found.interrupted ? "Cancelled. These are the best gains so far." : `${m.found.ended === "time" ? "Time is up. " : ""}Found gains with cost ${m.found.cost.toPrecision(4)} ${opened.y_unit}, from ${m.found.start_cost.toPrecision(4)}.`;
      set(m.found.values); sought = values; enable();
    });
  });
  on("traded", m => {
    busy = false; $("tune-progress").textContent = ""; enable();
    if (!m.found) return m.error && tell(new Error(m.error));
    if (m.found.front.length) takeIt(m.found, m.found.front[0].values, () => {
      front = m.found.front; const most = front.length - 1;
      for (const id of ["front-response", "front-robust"]) $(id).max = most;
      $("front").hidden = false; $("knobs-fold").open = false;
      $("tune-progress").textContent = `Found ${front.length} controllers. Each is better than every other in response or in robustness.`;
      // where it begins: the fastest that keeps the limit
      const limit = parseFloat($("limit-Ms").value) || 1.8, kept = front.map((f, k) => f.Ms <= limit ? k : 0);
      set({ ...values, ...trade(Math.max(...kept)) }); sought = values; enable();
    });
  });
  on("state", s => {
    writes = s.writes; enable(); free($("save-name"), [...s.controllers, ...s.models, ...s.recordings]);
    fill($("tune-model"), s.models.map(n => [n, titleOf(n)]), s.first); fill($("tune-start"), [["", "computed from the model"], ...s.controllers.map(n => [n, titleOf(n)])], s.start ?? "");
    $("no-model").hidden = s.models.length > 0;
    const [model, start] = shown === null ? [] : JSON.parse(shown), gone = shown !== null && shown !== chosen();
    if (gone) { missed = model ? `${titleOf(model !== $("tune-model").value ? model : start)} is no longer in the folder.` : ""; notches = []; opened = null; turn++; }
    if (gone || !s.models.length) blank();
    if (waiting && $("tune-progress").textContent === waiting) waits();  // what waits may have come or gone
    if (!opened) mark("tune", s.models.length ? "ready" : "needs a model");
    if (!$("tune").hidden && !saving) opened ? move() : opening && !gone || open();
  });

  function fill(select, pairs, chosen) {
    const kept = select.options.length ? select.value : chosen;
    select.replaceChildren(...pairs.map(([value, label]) => new Option(label, value)));
    if (pairs.some(([value]) => value === kept)) select.value = kept;
  }

  enable();
  /** Takes a model of the folder, as one that was just identified. */
  function choose(name) { if (listed("tune-model", name) && $("tune-model").value !== name) { $("tune-model").value = name; notches = []; open(); } }
  return { choose, show: async () => { await (opened ? move() : opening || open()); }, question, addNotch, saved: () => storedAs, unit: () => opened ? opened.y_unit : "" };
}
