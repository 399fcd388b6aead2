// What `look` found: the signals, what to improve, the summary. For the page and for notebooks.
import { draw } from "/curves.js";
import { sentences } from "/tell.js";

/** Curves of recordings, one panel for each list. */
export function panels(place, lists) {
  place.replaceChildren();
  for (const panel of lists) draw(place, panel, panel.map(c => `${c.name} ${c.unit}`).join(" and ") + " over time", panel.length > 1 ? "output" : "");
}

/** Fills the elements #signals, #advice and #summary in `root`; `follow` does what an advice says, if a field does it. */
export function showLook(root, found, follow = null) {
  const $ = id => root.querySelector(`#${id}`);
  panels($("signals"), found.curves.map(c => [c]));
  $("advice").replaceChildren(...found.advice.map(a => {
    const li = document.createElement("li"), said = document.createElement("span"), button = document.createElement("button");
    said.textContent = sentences(a.text ?? a); li.className = `chip ${a.idle ? "" : "warn"}`; li.append(said);
    if (follow && a.field) { button.textContent = "Do so"; button.onclick = () => follow(a); li.append(button); }
    return li;
  }));
  $("summary").textContent = found.text; $("summary-fold").hidden = false;
}
