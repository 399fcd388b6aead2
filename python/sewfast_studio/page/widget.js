// A view in a notebook: the elements of the page in a shadow root, and the kernel's messages as its server.
/** Fills `el` with `html` and `css`, and gives the functions that reach the steps, as server.js does. */
function connect(model, el, html, css) {
  const root = el.attachShadow({ mode: "open" }), waiting = new Map(), listeners = {};
  const style = document.createElement("style"), holder = document.createElement("div");
  style.textContent = css; holder.className = "sf cell"; holder.innerHTML = html; root.append(style, holder);
  // keys of the view are no commands of the notebook
  root.addEventListener("keydown", event => event.stopPropagation());
  let number = 0;
  model.on("msg:custom", (message, buffers) => {
    if (message.curves) {
      const data = buffers[0], values = new Float32Array(data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength)), curves = {};
      let at = 0;
      for (const [name, n] of message.curves) { curves[name] = values.subarray(at, at + n); at += n; }
      message.found = { ...message.found, curves };
    }
    if (message.event) return (listeners[message.event] || []).forEach(f => f(message));
    const [done, failed] = waiting.get(message.id) || [() => {}, () => {}]; waiting.delete(message.id);
    "error" in message ? failed(new Error(message.error)) : done(message.found);
  });
  return {
    root,
    on: (event, heard) => (listeners[event] ??= []).push(heard),
    ask: (name, asked = {}) => new Promise((done, failed) => { waiting.set(++number, [done, failed]); model.send({ id: number, do: name, ...asked }); }),
  };
}
