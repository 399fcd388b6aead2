// Zoom into the pictures of the page: drag a rectangle, Ctrl and wheel; double click or Escape goes back.
"use strict";
// a link leads into a chapter that may be folded, and paper does not unfold
const unfold = (within) => { for (const d of within) d.open = true; };
const follow = () => { const at = document.getElementById(location.hash.slice(1)); if (at) { for (let e = at; e; e = e.parentElement) if (e.tagName === "DETAILS") e.open = true; at.scrollIntoView(); } };
addEventListener("hashchange", follow); follow();
addEventListener("beforeprint", () => unfold(document.querySelectorAll("details")));
for (const picture of document.querySelectorAll("figure svg[viewBox]")) {
  const whole = picture.getAttribute("viewBox");
  const [, , width, height] = whole.split(/[\s,]+/).map(Number);
  if (!(width > 0 && height > 0)) continue;
  let from = null, frame = null;
  const at = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(picture.getScreenCTM().inverse());
  const box = () => picture.getAttribute("viewBox").split(/[\s,]+/).map(Number);
  const back = () => picture.setAttribute("viewBox", whole);
  const drop = () => { frame?.remove(); from = frame = null; };
  // the shape stays that of the whole picture, so that nothing moves around it
  const show = (x, y, w, h) => {
    const wide = Math.min(Math.max(w, (h * width) / height), width), high = (wide * height) / width;
    if (wide < width / 1000) return;
    if (wide > 0.999 * width) return back();
    picture.setAttribute("viewBox", [x + (w - wide) / 2, y + (h - high) / 2, wide, high].join(" "));
  };
  picture.style.touchAction = "pan-y";
  picture.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || event.pointerType === "touch") return;
    event.preventDefault();
    picture.setPointerCapture(event.pointerId);
    from = at(event);
    frame = document.createElementNS("http://www.w3.org/2000/svg", "rect");
    frame.setAttribute("fill", "#0072B2");
    frame.setAttribute("fill-opacity", "0.15");
    picture.append(frame);
  });
  picture.addEventListener("pointermove", (event) => {
    if (!from) return;
    const to = at(event);
    frame.setAttribute("x", Math.min(from.x, to.x));
    frame.setAttribute("y", Math.min(from.y, to.y));
    frame.setAttribute("width", Math.abs(to.x - from.x));
    frame.setAttribute("height", Math.abs(to.y - from.y));
  });
  picture.addEventListener("pointerup", (event) => {
    if (!from) return;
    const start = from, to = at(event), now = box();
    drop();
    const w = Math.abs(to.x - start.x), h = Math.abs(to.y - start.y);
    // a click is no rectangle
    if (w > 0.01 * now[2] && h > 0.01 * now[3]) show(Math.min(start.x, to.x), Math.min(start.y, to.y), w, h);
  });
  picture.addEventListener("pointercancel", drop);
  picture.addEventListener("dblclick", back);
  picture.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return; // the page scrolls as ever
    event.preventDefault();
    const p = at(event), now = box(), factor = Math.exp(event.deltaY / 300);
    show(p.x - (p.x - now[0]) * factor, p.y - (p.y - now[1]) * factor, now[2] * factor, now[3] * factor);
  }, { passive: false });
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") { drop(); back(); } });
}
