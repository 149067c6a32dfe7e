// A WebSocket whose messages are received by a worker.

// Code of a connection that was lost without one.
const LOST = 1006;

// One worker for all connections of the page: without a server, its script could not be loaded again.
/** @type {Worker | null} */
let worker = null;

export class WorkerSocket {
  // on: called with "open", "message" and its data, or "close" and its code. A page has one connection at a time.
  /** @param {string} address @param {{ open: () => void, message: (data: any) => void, close: (code: number) => void }} on */
  constructor(address, on) {
    const used = worker ||= new Worker("/static/socket_worker.js", { type: "module" });
    used.onmessage = ({ data: { type, data, code } }) => {
      if (type === "open") on.open();
      else if (type === "message") on.message(data);
      else on.close(code);
    };
    used.onerror = () => {
      used.terminate();
      worker = null;
      on.close(LOST);
    };
    used.postMessage({ open: address });
    this.worker = used;
  }

  /** @param {string | Uint8Array<ArrayBuffer>} message */
  send(message) { this.worker.postMessage({ message }); }
}
