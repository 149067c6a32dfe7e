// Connection to the server: one WebSocket that reconnects, messages with numbers, and parts with arrays.

import { memory } from "./memory.js";
import { awaited } from "./pending.js";
import { WorkerSocket } from "./worker_socket.js";

const TYPES = {
  uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, int16: Int16Array,
  uint32: Uint32Array, int32: Int32Array, float32: Float32Array, float64: Float64Array,
};
const FIRST_DELAY_MS = 250;
const LONGEST_DELAY_MS = 4000;
// The server closes with this code when the token is wrong.
const WRONG_TOKEN = 4403;
// A preview that is not answered in this time no longer delays the next one.
const PATIENCE_MS = 4000;
// Without any message for this time after a change, the server does not answer.
const SILENT_MS = 1500;

// Identifies this page: a duplicated tab remembers the same session, and receives a copy of it; a reloaded one keeps the session.
const PAGE = (isReloaded() && memory.get("page"))
  || Array.from(crypto.getRandomValues(new Uint32Array(4)), (part) => part.toString(36)).join("");
memory.set("page", PAGE);

function isReloaded() {
  const [entry] = performance.getEntriesByType("navigation");
  return entry instanceof PerformanceNavigationTiming && entry.type === "reload";
}

// Returns the header and the arrays of a part; arrays are views of its buffer.
/** @type {(buffer: ArrayBuffer) => Part} */
export function readPart(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  /** @type {PartHeader} */
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  /** @type {Arrays} */
  const arrays = {};
  for (const { name, type, size, offset } of header.arrays) arrays[name] = new TYPES[type](buffer, 4 + length + offset, size);
  return { part: header.part, version: header.version, is_preview: Boolean(header.is_preview), hasMore: Boolean(header.has_more),
    isAwaited: Boolean(header.is_awaited), about: header.about, arrays };
}

// Messages of one connection: their numbers, which of them wait for an answer, and the views that the page asked for.
export class Requests {
  lastId; doneId = 0; nDone = 0; lastMs = NaN; isBusy = false; isPreview = false;
  /** @type {Map<number, number>} */ sentAt = new Map();
  /** @type {{ id: number, resolve: (isDone: boolean) => void }[]} */ waiting = [];
  views = ""; pixels = 0;
  // The change of a slider that is on its way, and the one after it.
  /** @type {number | null} */ draftId = null;
  /** @type {{ key: string, value: unknown } | null} */ nextDraft = null;

  constructor(lastId = 0) { this.lastId = lastId; }

  // Returns the number of a new message.
  next() {
    this.sentAt.set(++this.lastId, performance.now());
    return this.lastId;
  }

  // Resolves to whether the message with this number succeeded; without a number it failed.
  /** @type {(id: number | null) => Promise<boolean>} */
  answered(id) { return id === null ? Promise.resolve(false) : new Promise((resolve) => { this.waiting.push({ id, resolve }); }); }

  // Messages up to this number are answered; only the last one can have failed.
  /** @param {number} id @param {boolean} isFailed */
  settle(id, isFailed) {
    for (const one of this.waiting.filter((each) => id >= each.id)) one.resolve(!isFailed || (one.id !== id && id !== Infinity));
    this.waiting = this.waiting.filter((one) => id < one.id);
  }

  // A result is shown: measures the time since its message.
  /** @param {number} id */
  show(id) {
    const start = this.sentAt.get(id);
    for (const old of this.sentAt.keys()) if (old <= id) this.sentAt.delete(old);
    if (start !== undefined) this.lastMs = performance.now() - start;
    this.doneId = id;
  }
}

export class Connection {
  /** @type {WorkerSocket | null} */ socket = null;
  // Final values that were set without a connection.
  /** @type {Map<string, unknown>} */ unsent = new Map();
  // Values whose messages are not answered, with their numbers: they are sent again after the connection was lost.
  /** @type {Map<string, { id: number, value: unknown }>} */ unanswered = new Map();
  isSilent = false; silence = 0;

  // isSame, isContinued: whether the token or the session is that of an earlier connection; isFailed: whether a message of the page failed.
  /**
   * @typedef {{
   *   hello: (message: Hello, about: { isSame: boolean, isContinued: boolean }) => void,
   *   message: (message: ServerMessage, about: { isFailed: boolean }) => void,
   *   part: (part: Part) => void, status: (status: "open" | "lost" | "denied") => void, silent: (isSilent: boolean) => void,
   * }} Listeners
   * @param {Listeners} on
   */
  constructor(on) {
    this.on = on;
    // Settings of a link may follow.
    this.token = location.hash.slice(1).split("&").find((part) => !part.includes("=")) || memory.get("token") || "";
    this.requests = new Requests();
    this.delay = FIRST_DELAY_MS;
    this.isOpen = false;
    const now = () => { if (!this.socket && !this.isDenied) this.open(); };
    addEventListener("online", now);
    addEventListener("focus", now);
  }

  // Whether all messages are answered, and the page shows the last result, which no complete one follows.
  get isAnswered() {
    const { lastId, doneId, isPreview, waiting } = this.requests;
    return this.isSettled && lastId > 0 && doneId >= lastId && !isPreview && waiting.length === 0 && this.unsent.size === 0;
  }

  // Whether all drafts are answered, and the server computes nothing.
  get isSettled() { return this.isOpen && !this.requests.isBusy && this.requests.draftId === null; }

  open() {
    clearTimeout(this.retry);
    const address = (location.protocol === "https:" ? "wss://" : "ws://") + location.host + "/socket";
    const socket = new WorkerSocket(address, {
      open: () => socket.send(JSON.stringify({ token: this.token, session: memory.get("session"), page: PAGE })),
      message: (data) => {
        this._hear();
        if (typeof data === "string") this._receive(JSON.parse(data));
        else this.on.part(readPart(data));
      },
      close: (code) => this._close(socket, code),
    });
    this.socket = socket;
  }

  /** @param {WorkerSocket} socket @param {number} code */
  _close(socket, code) {
    if (socket !== this.socket) return;
    this.socket = null;
    this.isOpen = false;
    clearTimeout(this.patience);
    this._hear();
    for (const [key, { value }] of this.unanswered) this.unsent.set(key, value);
    this.unanswered.clear();
    this.requests.settle(Infinity, true);
    this.requests = new Requests(this.requests.lastId);
    this.isDenied = code === WRONG_TOKEN;
    this.on.status(this.isDenied ? "denied" : "lost");
    if (this.isDenied) return;
    this.retry = setTimeout(() => this.open(), this.delay);
    this.delay = Math.min(LONGEST_DELAY_MS, 2 * this.delay);
  }

  /** @param {Hello | ServerMessage} message */
  _receive(message) {
    const { requests } = this;
    if (message.kind === "hello") {
      const isSame = memory.get("token") === this.token, isContinued = memory.get("session") === message.session;
      this.isOpen = true;
      this.delay = FIRST_DELAY_MS;
      memory.set("token", this.token);
      memory.set("session", message.session);
      this.on.hello(message, { isSame, isContinued });
      this.on.status("open");
      for (const [key, value] of this.unsent) this.set(key, value, true);
      this.unsent.clear();
      return;
    }
    const isFailed = (message.kind === "error" && !message.part) || (message.kind === "state" && Object.keys(message.errors).length > 0);
    const isDone = message.kind === "done";
    if (message.kind === "busy") requests.isBusy = true;
    else if (isDone || message.kind === "error" || isFailed) requests.isBusy = isDone && Boolean(message.is_followed);
    if (message.kind === "done") {
      requests.nDone++;
      requests.isPreview = Boolean(message.is_preview);
    }
    this.on.message(message, { isFailed });
    if (!isDone && !isFailed) return;
    // The answer to no message has no number.
    const id = message.id ?? 0;
    for (const [key, sent] of this.unanswered) if (sent.id <= id) this.unanswered.delete(key);
    requests.settle(id, isFailed);
    if (requests.draftId !== null && id >= requests.draftId) this._sendDraft();
  }

  // The draft is answered, or takes too long: the newest one that waits follows.
  _sendDraft() {
    const { requests } = this, next = requests.nextDraft;
    clearTimeout(this.patience);
    requests.draftId = requests.nextDraft = null;
    if (next && this.isOpen) this.set(next.key, next.value, false);
  }

  // Returns the number of the message, or null without a connection.
  /** @param {Change} message */
  send(message) {
    if (!this.isOpen || !this.socket) return null;
    const id = this.requests.next();
    this.socket.send(JSON.stringify({ ...message, id }));
    this.silence ||= setTimeout(() => { this.isSilent = true; this.on.silent(true); }, SILENT_MS);
    return id;
  }

  // The server has sent something.
  _hear() {
    clearTimeout(this.silence);
    this.silence = 0;
    if (!this.isSilent) return;
    this.isSilent = false;
    this.on.silent(false);
  }

  // The photosites of a version are drawn: the server goes on with what takes time.
  /** @param {number} version */
  drawn(version) { this.socket?.send(JSON.stringify({ do: "drawn", version })); }

  // Cancels the present change; this has no answer of its own.
  cancel() { this.socket?.send(JSON.stringify({ do: "cancel" })); }

  // Asks for the data of views, and for pictures of this size, unless they are those of the last time.
  /** @param {string[]} names @param {number} pixels */
  askFor(names, pixels) {
    const views = JSON.stringify({ do: "views", names, pixels });
    if (!this.isOpen || views === this.requests.views) return;
    this.requests.views = views;
    this.requests.pixels = pixels;
    this.send({ do: "views", names, pixels });
  }

  // Sends a frame of the camera: its header with the number of the message, and its pixels. Returns the number, or null.
  /** @param {FrameHeader} header @param {Uint8Array} pixels */
  sendFrame(header, pixels) {
    if (!this.isOpen || !this.socket) return null;
    const id = this.requests.next(), text = new TextEncoder().encode(JSON.stringify({ ...header, id }));
    const message = new Uint8Array(4 + text.length + pixels.length);
    new DataView(message.buffer).setUint32(0, text.length, true);
    message.set(text, 4);
    message.set(pixels, 4 + text.length);
    this.socket.send(message);
    return id;
  }

  // Sets a value. Drafts wait until the one before is answered, and the newest wins; final values are sent at once.
  /** @param {string} key @param {unknown} value @param {boolean} isFinal */
  set(key, value, isFinal) {
    const { requests } = this;
    if (!this.isOpen) {
      if (isFinal) this.unsent.set(key, value);
      return null;
    }
    if (!isFinal && requests.draftId !== null) {
      requests.nextDraft = { key, value };
      return null;
    }
    if (isFinal) requests.nextDraft = null;
    const id = this.send({ do: "set", key, value, final: isFinal });
    if (isFinal && id !== null) this.unanswered.set(key, { id, value });
    requests.draftId = id;
    clearTimeout(this.patience);
    this.patience = setTimeout(() => this._sendDraft(), PATIENCE_MS);
    return id;
  }

  // The newest final value of a setting that is not answered; undefined without one.
  /** @type {(key: string) => any} */
  pending(key) { return this.unsent.get(key) ?? this.unanswered.get(key)?.value; }

  // Removes a value, with its default after that.
  /** @param {string} key */
  remove(key) {
    this.requests.nextDraft = null;
    return this.send({ do: "delete", key });
  }

  get headers() { return { Authorization: "Bearer " + this.token, "X-Session": memory.get("session") || "" }; }

  // Requests an address of the server; returns what read(answer) finds in the answer, or { error }, by default with the problem.
  /** @typedef {{ error: string }} Problem */
  /** @type {<T>(address: string, problem: string, read: (answer: Response) => Promise<T>, options?: object) => Promise<T | Problem>} */
  async _request(address, problem, read, options) {
    try {
      const answer = await fetch(address, { headers: this.headers, ...options });
      if (answer.ok) return await read(answer);
      const { error } = await answer.json().catch(() => ({}));
      return { error: error || problem + " (status " + answer.status + ")" };
    } catch {
      return { error: "The server does not answer" };
    }
  }

  // Sends a file to the server; returns { path } or { error }.
  /** @type {(file: File) => Promise<{ path?: string, error?: string }>} */
  upload(file) {
    return awaited(this._request("/file?name=" + encodeURIComponent(file.name), "The server does not accept " + file.name,
      (answer) => answer.json().catch(() => ({})), { method: "POST", body: file }));
  }

  // Returns the file of the current state as { blob } or { error }.
  /** @type {(what: string) => Promise<{ blob?: Blob, error?: string }>} */
  fetchFile(what) {
    return awaited(this._request("/download?what=" + what, "The file is not available", async (answer) => ({ blob: await answer.blob() })));
  }

  // Returns the contents of the start page, or { error }.
  /** @type {() => Promise<StartContents | Problem>} */
  fetchStart() { return awaited(this._request("/start", "The start page is not available", (answer) => answer.json())); }
}
