// Buttons that copy a step as Python and as commands, and show both where the clipboard is closed.
export function copies(place, found) {
  place.replaceChildren();
  for (const [label, value] of [["Copy as Python", found.python], ["Copy as commands", found.commands]]) {
    const button = document.createElement("button"), details = document.createElement("details");
    const summary = document.createElement("summary"), pre = document.createElement("pre");
    summary.textContent = label.replace("Copy as ", "Show "); pre.textContent = value; details.append(summary, pre);
    button.textContent = label;
    button.onclick = () => navigator.clipboard.writeText(value).then(
      () => { button.textContent = "Copied"; setTimeout(() => { button.textContent = label; }, 1500); },
      () => { details.open = true; });
    place.append(button, details);
  }
}
