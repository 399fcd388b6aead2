// The page: its steps, their marks, and which page is in control. Texts of others are only ever set as text.
import * as server from "/server.js";
import { open } from "/data.js";
import { mount } from "/tune.js";
import * as bode from "/bode.js";
import * as model from "/model.js";
import "/commission.js";
import { choose } from "/deploy.js";
import { look } from "/drive.js";

const { ask, on } = server, $ = id => document.getElementById(id), VIEWS = ["drive", "data", "model", "tune", "commission", "deploy"];
const tune = mount(document, server);
let first = true, over = false, lost = false;

function notice(text, takes) { $("notice-text").textContent = text; $("notice").hidden = !text; $("take").hidden = !takes; }
on("closed", () => {
  $("control").textContent = "not connected";
  notice("This page is not connected. The studio stops the drive when it ends; if the motor turns, use the emergency stop. Reload this page. If it stays so, start sewfast studio again and open its whole address.", false);
});

/** The state of a step beside its name: kind is good, warn, bad or nothing. */
document.addEventListener("mark", ({ detail: [step, word, kind = ""] }) => {
  const chip = $(`view-${step}`).querySelector(".chip");
  if (chip.textContent !== word) chip.textContent = word;
  chip.className = `chip ${kind}`;
});

/** Shows a step. A browser's Back and a reload lead to the one that was shown, without a fragment, as that is the token. */
function view(name) {
  if (history.state !== name) history[first ? "replaceState" : "pushState"](name, "");
  for (const v of VIEWS) { $(v).hidden = v !== name; $(`view-${v}`).setAttribute("aria-pressed", v === name); }
  scrollTo(0, 0);
  if (name === "data") bode.show();
  if (name === "model") open();
  if (name === "tune") tune.show();
  if (name === "drive") look();
}
bode.connect(tune, view); model.connect(tune, view);

on("state", s => {
  $("folder").textContent = $("folder").title = s.folder;
  if (s.writes) { over = lost = false; $("take").textContent = "Take control"; }
  const others = s.pages > 1 ? `${s.pages} pages are open.` : "";
  $("control").textContent = s.writes ? "in control" : "looking on";
  notice(s.writes ? "" : `${lost ? "Another page has taken control. This page looks on." : "This page looks on."} ${others}`.trim(), true);
  if (first && VIEWS.includes(history.state)) view(history.state);
  else if (first && s.port) { $("port").value = s.port; view("drive"); }
  else if (first && s.models.length && (s.demo || s.models.includes(s.first))) view("tune");
  else if (first) view("data");
  first = false;
});
addEventListener("popstate", ({ state }) => { if (VIEWS.includes(state)) view(state); });
on("lost", () => { lost = true; });
$("take").onclick = async () => {
  const held = await ask("take", { over });
  over = Boolean(held);
  if (!held) return;
  notice(`Another page has been in control of the drive for ${Math.ceil(held.held_s)} s.${held.moves ? " The motor can turn." : ""} Taking it over stops the motor.`, true);
  $("take").textContent = "Take over";
};
for (const v of VIEWS) $(`view-${v}`).onclick = () => view(v);
$("to-deploy").onclick = () => { choose(tune.saved()); view("deploy"); };
$("verified").onclick = () => { choose("commissioned/controllers/tuned.json"); view("deploy"); };
// a file that is dropped anywhere goes to the step Look
addEventListener("drop", event => { if ($("data").hidden && event.dataTransfer.files.length) view("data"); }, { capture: true });
