// What a step says where it is refused: below the field that the message names, else in the step's toast.

export const upper = s => s.charAt(0).toUpperCase() + s.slice(1);
/** A refusal as sentences: "expected a, received b; do c" is "Expected a, received b. Do c." Names of files stay as they are. */
export function sentences(text) {
  const parts = text.split("; ");
  return parts.map((s, k) => k || /^(expected|the|this|on|no) /.test(s) ? upper(s) : s).join(". ").replace(/([^.!?])$/, "$1.");
}

/** A function that shows an error, or takes it away; `root` holds the step's fields, `id` is its toast's. */
export function teller(root, id) {
  let beside = null;
  return error => {
    const toast = root.querySelector(`[id="${id}"]`);
    if (beside) { beside.text.remove(); beside.field.removeAttribute("aria-invalid"); beside.field.removeAttribute("aria-describedby"); beside = null; }
    const place = toast.parentNode, said = error ? error.message : "";
    const named = /^([\w[\]]+)(?:, [\w[\]]+)*: /.exec(said), name = named && named[1], quoted = /\(“([^”]+)”\)/.exec(said);
    // the one that a message begins with, or what to do names: then it is unfolded
    let field = named && place.querySelector(`[id="${name}"], [id="knob-${name}-value"], [data-name="${name}"]`), rest = said;
    if (field) rest = said.slice(named[0].length);
    else if (quoted) {
      field = [...place.querySelectorAll("label")].find(l => l.textContent.trim().startsWith(quoted[1]))?.querySelector("input, select");
      for (let fold = field?.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
    }
    if (field && field.checkVisibility()) {
      const text = document.createElement("small");
      text.className = "refused"; text.id = `${id}-beside`; text.setAttribute("role", "alert"); text.textContent = sentences(rest);
      (field.closest("label") ?? field).after(text);
      field.setAttribute("aria-invalid", "true"); field.setAttribute("aria-describedby", text.id);
      beside = { field, text }; text.scrollIntoView({ block: "nearest" });
    }
    // a field that is folded away is named as on the page
    const label = field && field.closest("label")?.firstChild.textContent.trim();
    toast.textContent = error ? sentences(label && rest !== said ? `${label}: ${rest}` : said) : "";
    toast.hidden = !error || beside !== null;
    if (!toast.hidden) toast.scrollIntoView({ block: "nearest" });  // the action stays in sight where the toast does not
  };
}
