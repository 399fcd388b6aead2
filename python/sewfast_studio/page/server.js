// The one socket to the server: questions with their answers, and events. The token stays out of the address bar.
if (location.hash.length > 1) {
  sessionStorage.setItem("token", location.hash.slice(1));
  history.replaceState(null, "", "/");
}
const socket = new WebSocket(`ws://${location.host}/socket`);
socket.binaryType = "arraybuffer";
const waiting = new Map(), listeners = {};
let number = 0;

/** Calls `heard(message)` at every event of that name. */
export function on(event, heard) { (listeners[event] ??= []).push(heard); }

/** A step of the server; resolves to what it found, rejects with its refusal. One that is not `answered` is only sent. */
export function ask(name, asked = {}, answered = true) {
  if (socket.readyState !== WebSocket.OPEN) return Promise.reject(new Error("no connection to the studio"));
  if (!answered) return socket.send(JSON.stringify({ do: name, ...asked }));
  const id = ++number;
  socket.send(JSON.stringify({ id, do: name, ...asked }));
  return new Promise((done, failed) => waiting.set(id, [done, failed]));
}

/** Says the state of a step beside its name: a word, and good, warn or bad. */
export function mark(...said) { document.dispatchEvent(new CustomEvent("mark", { detail: said })); }

/** A piece of a file that is uploaded; its answer is the event `received`. */
export function sendBytes(piece) { socket.send(piece); }

socket.onopen = () => socket.send(sessionStorage.getItem("token") || "none");
socket.onclose = () => {
  for (const [, failed] of waiting.values()) failed(new Error("the connection to the studio has ended"));
  waiting.clear(); (listeners.closed || []).forEach(f => f());
};
socket.onmessage = ({ data }) => {
  const message = typeof data === "string" ? JSON.parse(data) : unpacked(data);
  if (message.event) return (listeners[message.event] || []).forEach(f => f(message));
  const [done, failed] = waiting.get(message.id) || [() => {}, () => {}]; waiting.delete(message.id);
  "error" in message ? failed(new Error(message.error)) : done(message.found);
};

/** Length of the head, head, then the curves that it names in float32. */
function unpacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true), curves = {};
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length;
  for (const [name, n] of head.curves) { curves[name] = new Float32Array(buffer, at, n); at += 4 * n; }
  return { ...head, found: { ...head.found, curves } };
}
