// Widget of a notebook: the page in a frame, whose view is that of the model, in both directions.

// Traits that the page reports and accepts.
const SHARED = ["by", "pinned", "selected"];

// Whether the notebook is dark, by the colour of its text.
function isDark(element) {
  const [r, g, b] = (getComputedStyle(element).color.match(/[\d.]+/g) || []).map(Number);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b > 127;
}

function render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.title = "Photosites";
  // Without allow-same-origin: names from untrusted files stay apart from the notebook.
  frame.sandbox = "allow-scripts allow-downloads";
  frame.style.cssText = "display: block; width: 100%; border: 0; border-radius: 4px";
  const resize = () => { frame.style.height = model.get("height_px") + "px"; };
  resize();
  let isReporting = false;
  const send = (message) => frame.contentWindow?.postMessage(message, "*");
  const sendTrait = (name) => {
    if (isReporting) return;
    const value = model.get(name);
    send({ foveasim: "set", name, value: name === "selected" ? [...new Uint32Array(bytesOf(value))] : value });
  };
  const receive = ({ source, data }) => {
    if (source !== frame.contentWindow || data?.foveasim !== "changed") return;
    isReporting = true;
    model.set(data.name, data.name === "selected" ? new DataView(Uint32Array.from(data.value).buffer) : data.value);
    isReporting = false;
    model.save_changes();
  };
  const open = () => {
    send({ foveasim: "set", name: "theme", value: isDark(el) ? "dark" : "light" });
    if (model.get("by")) sendTrait("by");
    if (model.get("pinned") >= 0) sendTrait("pinned");
    if (model.get("selected").byteLength) sendTrait("selected");
    send({ foveasim: "connect" });
  };
  const listeners = SHARED.map((name) => ["change:" + name, () => sendTrait(name)]);
  listeners.push(["change:height_px", resize]);
  for (const [event, listener] of listeners) model.on(event, listener);
  window.addEventListener("message", receive);
  frame.addEventListener("load", open);
  frame.srcdoc = model.get("page");
  el.replaceChildren(frame);
  return () => {
    window.removeEventListener("message", receive);
    for (const [event, listener] of listeners) model.off(event, listener);
  };
}

// Buffer of the bytes of a trait, which begins anywhere in the message.
function bytesOf(view) {
  return view.buffer.slice(view.byteOffset, view.byteOffset + view.byteLength);
}

export default { render };
