// The page: its views and who holds the control. Texts of others are only ever set as text.
import * as server from "/server.js";
import { open } from "/data.js";
import { mount } from "/tune.js";
import * as bode from "/bode.js";
import "/commission.js";
import { look } from "/drive.js";

const { ask, on } = server, $ = id => document.getElementById(id), VIEWS = ["data", "bode", "tune", "drive", "commission"];
const tune = mount(document, server);
let first = true;

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
  $("control").textContent = (s.writes ? "this page holds the control" : "this page looks on") + (s.pages > 1 ? `; ${s.pages} pages are open` : "");
  if (first && s.port) { $("port").value = s.port; view("drive"); }
  else if (first && s.models.length && (s.demo || s.models.includes(s.first))) view("tune");
  first = false;
});
$("take").onclick = () => ask("take");
for (const v of VIEWS) $(`view-${v}`).onclick = () => view(v);
