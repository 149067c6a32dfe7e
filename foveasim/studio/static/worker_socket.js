// A WebSocket whose messages are received by a worker.

export class WorkerSocket {
  // on: called with "open", "message" and its data, or "close" and its code.
  /** @param {string} address @param {{ open: () => void, message: (data: any) => void, close: (code: number) => void }} on */
  constructor(address, on) {
    this.worker = new Worker("/static/socket_worker.js", { type: "module" });
    this.worker.addEventListener("message", ({ data: { type, data, code } }) => {
      if (type === "open") on.open();
      else if (type === "message") on.message(data);
      else {
        this.worker.terminate();
        on.close(code);
      }
    });
    this.worker.postMessage({ open: address });
  }

  /** @param {string | Uint8Array<ArrayBuffer>} message */
  send(message) { this.worker.postMessage({ message }); }
}
