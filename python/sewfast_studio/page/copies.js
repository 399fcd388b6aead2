// A step as Python and as commands: buttons that copy, and the text itself, folded.
export function copies(place, found) {
  const details = document.createElement("details"), summary = document.createElement("summary");
  summary.textContent = "Repeat this step without the page"; details.append(summary);
  for (const [label, value] of [["Copy as Python", found.python], ["Copy as commands", found.commands]]) {
    if (!value) continue;
    const button = document.createElement("button"), pre = document.createElement("pre");
    pre.textContent = value; button.textContent = label;
    button.onclick = () => navigator.clipboard.writeText(value).then(
      () => { button.textContent = "Copied"; setTimeout(() => { button.textContent = label; }, 1500); }, () => {});
    details.append(button, pre);
  }
  place.replaceChildren(details);
}
