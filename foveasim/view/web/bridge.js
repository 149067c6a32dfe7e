// Connection of a page inside a notebook with the widget that contains it, by messages between the two windows.

/** @type {Window | null} */
let host = null;

// Whether the page has an address, to which links can lead; pages in notebooks have none.
export const hasAddress = location.protocol !== "about:";

// Sends a change of the view, such as the pinned photosite; nothing happens outside of notebooks.
/** @param {string} name @param {unknown} value */
export function report(name, value) {
  if (host) host.postMessage({ foveasim: "changed", name, value }, "*");
}

// Connects with the window around the page once that asks for it; its later messages are passed to the handlers by name.
// Returns a function that is called when the page is complete.
/** @param {{ [name: string]: (value: any) => void }} handlers @param {() => object} state */
export function connect(handlers, state) {
  let isComplete = false;
  /** @type {HostMessage[]} */
  const waiting = [];
  /** @param {HostMessage} message */
  const receive = ({ foveasim, name, value }) => {
    if (foveasim === "connect") for (const [key, current] of Object.entries(state())) report(key, current);
    else if (foveasim === "set" && Object.hasOwn(handlers, name)) handlers[name](value);
  };
  window.addEventListener("message", (event) => {
    if (window.parent === window || event.source !== window.parent || !event.data || !event.data.foveasim) return;
    host = event.source;
    if (isComplete) receive(event.data);
    else waiting.push(event.data);
  });
  return () => {
    isComplete = true;
    waiting.splice(0).forEach(receive);
  };
}
