// What `look` found: the signals, what to improve, the summary. For the page and for notebooks.
import { draw } from "/curves.js";

/** Curves of recordings, one panel for each list. */
export function panels(place, lists) {
  place.replaceChildren();
  for (const panel of lists) draw(place, panel, panel.map(c => `${c.name} ${c.unit}`).join(" and ") + " over time", panel.length > 1 ? "output" : "");
}

/** Fills the elements #signals, #advice and #summary in `root`. */
export function showLook(root, found) {
  const $ = id => root.querySelector(`#${id}`);
  panels($("signals"), found.curves.map(c => [c]));
  $("advice").replaceChildren(...found.advice.map(a => { const li = document.createElement("li"); li.textContent = a; li.className = "chip warn"; return li; }));
  $("summary").textContent = found.text; $("summary-fold").hidden = false;
}
