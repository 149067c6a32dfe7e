// A WebSocket in a worker: large messages arrive while the page is busy.

/** @type {WebSocket | undefined} */
let socket;

/** @param {unknown} message @param {Transferable[]} [transferred] */
const tell = (message, transferred = []) => self.postMessage(message, { transfer: transferred });

self.addEventListener("message", ({ data }) => {
  if (data.open === undefined) {
    if (socket?.readyState === WebSocket.OPEN) socket.send(data.message);
    return;
  }
  const made = new WebSocket(data.open);
  socket = made;
  made.binaryType = "arraybuffer";
  made.addEventListener("open", () => tell({ type: "open" }));
  made.addEventListener("message", (event) => tell({ type: "message", data: event.data },
    typeof event.data === "string" ? [] : [event.data]));
  made.addEventListener("close", ({ code }) => tell({ type: "close", code }));
});
