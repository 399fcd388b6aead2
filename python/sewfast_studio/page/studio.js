// The page: its views and who holds the control. Texts of others are only ever set as text.
import * as server from "/server.js";
import { open } from "/data.js";
import { mount } from "/tune.js";
import * as bode from "/bode.js";
import "/commission.js";
import { look } from "/drive.js";

const { ask, on } = server, $ = id => document.getElementById(id), VIEWS = ["data", "bode", "tune", "drive", "commission"];
const tune = mount(document, server);
let first = true, over = false, lost = false;

// what the focus goes to must not be left below the header, whose lines depend on the width
const header = document.querySelector("header");
new ResizeObserver(() => { document.documentElement.style.scrollPaddingTop = `${header.offsetHeight + 8}px`; }).observe(header);

on("closed", () => { $("control").textContent = "not connected: reload this page; if it stays so, start sewfast studio again and open its whole address"; });

function view(name) {
  for (const v of VIEWS) { $(v).hidden = v !== name; $(`view-${v}`).setAttribute("aria-pressed", v === name); }
  if (name === "data") open();
  if (name === "bode") bode.show();
  if (name === "tune") tune.show();
  if (name === "drive") look();
}
bode.connect(tune, view);

on("state", s => {
  $("folder").textContent = s.folder; $("take").hidden = s.writes;
  if (s.writes) { over = lost = false; $("take").textContent = "Take control"; }
  $("control").textContent = (s.writes ? "this page holds the control" : lost ? "another page has taken the control; this page looks on" : "this page looks on") + (s.pages > 1 ? `; ${s.pages} pages are open` : "");
  if (first && s.port) { $("port").value = s.port; view("drive"); }
  else if (first && s.models.length && (s.demo || s.models.includes(s.first))) view("tune");
  first = false;
});
on("lost", () => { lost = true; });
$("take").onclick = async () => {
  const held = await ask("take", { over });
  over = Boolean(held);
  if (!held) return;
  $("control").textContent = `another page has held the control of the drive for ${Math.ceil(held.held_s)} s` + (held.moves ? ", and the motor can turn" : "") + "; taking it over stops the motor";
  $("take").textContent = "Take over";
};
for (const v of VIEWS) $(`view-${v}`).onclick = () => view(v);
