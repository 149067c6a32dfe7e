// Gaze path: a row under the bar of the optical image to record, replay and edit it, and its files.

import { clamp } from "/web/colours.js";
import { $, change, download, find, make, notice, speak } from "/web/page_parts.js";
import { buttonOf, titledButton } from "./elements.js";
import { Film } from "./film.js";
import { GazeMarks } from "./gaze_marks.js";
import { Recording, withChanged, withRow } from "./gaze_rows.js";
import { GazeTable } from "./gaze_table.js";
import { menuOf } from "./menus.js";
import { numberOf } from "./numbers.js";

/** @typedef {import("./gaze_rows.js").GazeRow} GazeRow */

const KEY = "gaze_path";
const NAMES = { back: "One step back on the gaze path", play: "Play the gaze path", pause: "Pause the gaze path",
  forward: "One step forward on the gaze path", slider: "Time on the gaze path" };
// Interval in which the time of a recording is shown, in ms.
const TICK_MS = 100;

export class GazePanel {
  /** @type {GazeRow[]} */ rows = [];
  /** @type {Film | null} */ film = null;
  /** @type {Recording | null} */ recording = null;
  /** @type {FilmAbout | null} */ video = null;
  /** @type {{ of: Recording, n: number, rows: GazeRow[] } | null} */ recorded = null;
  // Elements.
  /** @type {HTMLElement} */ row;
  /** @type {{ [name: string]: HTMLButtonElement }} */ buttons;
  /** @type {HTMLInputElement} */ chosen;
  /** @type {number[] | null} */ timesS = null;
  pictureStep = 1; shortestStep = 1; problem = ""; error = ""; filmKey = ""; isKnown = false; timer = 0;

  // Callbacks: connection(), state(), playing() before the path plays, redraw() of the marks.
  /**
   * @param {HTMLElement} root @param {ImagePane} pane @param {import("./film_row.js").Transport} transport
   * @param {{ connection: () => Connection, state: () => State | null, playing: () => void, redraw: () => void }} on
   */
  constructor(root, pane, transport, on) {
    this.root = root;
    this.transport = transport;
    this.pane = pane;
    this.on = on;
    this.marks = new GazeMarks(pane, {
      moved: (index, row) => this._commit(withChanged(this.rows, index, row)),
      chosen: (index) => this._goTo(this.rows[index][0]),
      redraw: () => on.redraw(),
    });
    pane.path = this.marks;
    this.table = new GazeTable({
      changed: (index, row) => this._commit(withChanged(this.rows, index, row)),
      removed: (index) => this._commit(this.rows.filter((_, k) => k !== index)),
      inserted: () => this._commit(withRow(this.rows, [this.time, ...this.position], this.step)),
    });
    this.buttons = {};
    this._build();
    $("saccades-form").addEventListener("submit", (event) => {
      if (event.submitter?.getAttribute("value") === "create" && !this._create()) event.preventDefault();
    });
  }

  // -- elements -------------------------------------------------------------------------------------------------------------

  _build() {
    const { on } = this, toggle = buttonOf("Gaze path", () => this.open(Boolean(this.row.hidden)), {
      id: "gaze-path", ariaLabel: "Gaze path", title: "Record, replay and edit movements of the gaze",
    });
    $("follow-scene").before(toggle);
    this.row = make("div", undefined, { id: "gaze", role: "group", ariaLabel: "Gaze path" });
    const record = buttonOf("Record", () => (this.recording ? this.finish() : this.start()), {
      className: "record", ariaLabel: "Record",
      title: "Record movements of the gaze: drag the outline, or use the arrow keys on the optical image",
    });
    const table = titledButton("Rows", "Show the rows of the gaze path", () => {
      this.table.root.hidden = !this.table.root.hidden;
      this._show();
    });
    Object.assign(this.buttons, { toggle, record, table });
    this.row.append(record, table, this._menu());
    this.transport.add({ names: NAMES, part: this.row, film: () => (this.row.hidden || this.recording ? null : this.film),
      words: () => this._words(), problem: () => (this.recording ? "" : this.error || this.problem), started: () => on.playing() });
    this.table.root.hidden = true;
    find(this.root, ".stage").append(this.table.root);
  }

  _menu() {
    const { frame, menu } = menuOf("Path", { id: "gaze-menu" });
    this.chosen = make("input", undefined, { type: "file", accept: ".csv,text/csv", className: "unseen", tabIndex: -1, id: "chosen-gaze",
      ariaLabel: "CSV file of a gaze path" });
    this.chosen.addEventListener("change", () => {
      const file = this.chosen.files?.[0];
      if (file) this._openFile(file);
      this.chosen.value = "";
    });
    this.buttons.save = buttonOf("Save CSV", () => this._saveFile());
    this.buttons.clear = buttonOf("Clear", () => this._commit([]));
    menu.append(buttonOf("Saccades…", () => this._ask()), buttonOf("Open CSV…", () => this.chosen.click()), this.buttons.save,
      this.buttons.clear);
    find(this.root, ".bar").append(this.chosen);
    return frame;
  }

  // -- state ----------------------------------------------------------------------------------------------------------------

  get isVideo() { return this.video !== null; }
  // Time step in s: of the frames of a video, the shortest one if they differ, or of a replay over a picture.
  get step() { return this.isVideo && this.timesS ? this.shortestStep : this.video?.frame_s || this.pictureStep; }
  // Time of the first step of a replay; frames of a video begin at 0.
  get begin() { return this.isVideo ? 0 : Math.min(0, this.rows[0]?.[0] ?? 0); }
  // The present time of the path.
  get time() { return this._timeOf((this.isVideo ? this.video : this.film)?.n ?? 0); }
  /** @returns {Point} */
  get position() { return this.on.state()?.settings.gaze_um || [0, 0]; }
  // Where the gaze is during a recording, before the server has answered.
  get recordedAt() { return this.recording?.position; }

  /** @param {number} n */
  _timeOf(n) { return (this.isVideo && this.timesS?.[n]) || this.begin + n * this.step; }

  open(isOpen = true) {
    if (!isOpen) {
      this.finish();
      this.film?.pause();
    }
    this.row.hidden = !isOpen;
    if (!isOpen) this.table.root.hidden = true;
    this._show();
  }

  /** @param {number[] | null} timesS */
  useTimes(timesS) {
    this.timesS = timesS;
    this.shortestStep = timesS ? timesS.slice(1).reduce((least, t, k) => Math.min(least, t - timesS[k]), Infinity) : 1;
    this.filmKey = "";
  }

  /** @param {GazePathMessage} message */
  usePath({ rows, problem, step_s: step }) {
    const isNew = this.isKnown && !this.rows.length && rows.length > 0;
    Object.assign(this, { rows, problem, pictureStep: step, isKnown: true });
    this._useFilm();
    if (isNew) this.open();
    else this._show();
  }

  /** @param {State} state */
  use(state) {
    const before = this.video, video = state.film?.kind === "video" ? state.film : null;
    if (this.recording && Boolean(before) !== Boolean(video)) this.finish();
    this.video = video;
    // While the outline is held, each new frame has its position.
    if (this.recording && video && video.n !== before?.n && this.pane.drag) this.recording.move(this.recording.position, video.n);
    this._useFilm();
    this.error = state.errors[KEY] || "";
    if (this.error) this.table.restore();
    this._show();
  }

  // The film of a replay: frames of the video, or steps of time over a picture.
  _useFilm() {
    const { rows, video, step, begin } = this, last = rows[rows.length - 1]?.[0] ?? 0;
    const count = !rows.length ? 0 : video ? video.n_frames ?? 1 : Math.ceil((last - begin) / step - 1e-6) + 1;
    const key = JSON.stringify([Boolean(video), count, step, begin]), before = this.film;
    if (key !== this.filmKey) {
      const n = video ? video.n : clamp(before?.n ?? 0, 0, Math.max(0, count - 1));
      before?.pause();
      this.filmKey = key;
      this.film = count ? new Film({ count, n, frameS: step, timesS: video ? this.timesS : null, isSkipping: true, settles: true,
        changed: () => this._show(), show: (k, isFinal) => this._follow(k, isFinal) }) : null;
    } else if (before && video && !before.isBusy) before.n = video.n;
  }

  // Shows a step of the path: drafts while it plays, at its end an undo step.
  /** @param {number} n @param {boolean} isFinal */
  _follow(n, isFinal) {
    const connection = this.on.connection();
    return connection.requests.answered(connection.send(this.isVideo ? { do: "frame", n, follows: true, final: isFinal }
      : { do: "follow", t_s: this._timeOf(n), final: isFinal }));
  }

  /** @param {number} t */
  _goTo(t) {
    this.film?.pause();
    const { film } = this;
    let n = Math.round((t - this.begin) / this.step);
    // The frame next to the time.
    if (film?.timesS) n = film.timesS.reduce((best, at, k, all) => (Math.abs(at - t) < Math.abs(all[best] - t) ? k : best), 0);
    film?.go(n, true);
  }

  // Sets the rows: one undo step.
  /** @param {GazeRow[]} rows */
  _commit(rows) {
    this.film?.pause();
    if (rows.length) this.on.connection().set(KEY, rows, true);
    else this.on.connection().remove(KEY);
  }

  // -- recording --------------------------------------------------------------------------------------------------------------

  start() {
    this.film?.pause();
    this.recording = new Recording({ step: this.step, isVideo: this.isVideo, position: this.position,
      timesS: this.isVideo ? this.timesS : null });
    this.timer = setInterval(() => this._show(), TICK_MS);
    speak(() => "recording the gaze");
    this._show();
  }

  // The gaze has moved; returns whether this is recorded: the end of the recording is then the undo step.
  /** @param {Point} position */
  moved(position) {
    if (!this.recording) {
      if (this.film?.isPlaying) this.film.pause();
      return false;
    }
    this.recording.move(position, this.video?.n ?? 0);
    this._show();
    return true;
  }

  // Ends the recording: the path and the last position are one undo step.
  finish() {
    const { recording } = this, connection = this.on.connection();
    if (!recording) return;
    this.recording = null;
    clearInterval(this.timer);
    if (recording.nMoved) {
      const rows = recording.rows(this.rows);
      connection.send({ do: "set", key: "gaze_um", value: recording.position, final: false });
      connection.set(KEY, rows, true);
      speak(() => rows.length + " rows recorded");
    } else notice("No movement of the gaze was recorded");
    this._show();
  }

  // The connection is lost.
  lost() {
    this.film?.pause();
    this.finish();
  }

  // -- files and random paths ---------------------------------------------------------------------------------------------------

  /** @param {File} file */
  async _openFile(file) {
    const connection = this.on.connection(), { path, error } = await connection.upload(file);
    if (error) notice(file.name + ": " + error);
    else connection.send({ do: "gaze_file", path });
  }

  async _saveFile() {
    const { blob, error } = await this.on.connection().fetchFile("csv");
    if (blob) download(blob, document.title.split(" – ")[0] + "_gaze", "csv");
    else notice(error || "The file is not available");
  }

  // Asks for the parameters of a random path; its duration is that of a video.
  _ask() {
    if (this.video?.n_frames) {
      const seconds = (this.timesS?.at(-1) ?? (this.video.n_frames - 1) * this.step) + this.step;
      $("saccades-duration").value = String(Number(seconds.toPrecision(6)));
    }
    $("saccades-dialog").showModal();
  }

  // Asks the server for a random path; returns whether all fields are numbers.
  _create() {
    const values = [...$("saccades-form").querySelectorAll("input")].map((field) => {
      const value = numberOf(field.value, field.dataset.unit);
      field.ariaInvalid = Number.isFinite(value) ? null : "true";
      return [field.name, value];
    });
    if (!values.every(([, value]) => Number.isFinite(value))) return false;
    this.on.connection().send({ do: "saccades", ...Object.fromEntries(values) });
    return true;
  }

  // -- display --------------------------------------------------------------------------------------------------------------------

  _show() {
    const { recording, row, rows, buttons } = this, isOpen = !row.hidden, state = this.on.state();
    const isRecording = Boolean(recording), shown = recording ? this._recorded(recording) : rows;
    buttons.toggle.setAttribute("aria-pressed", String(isOpen));
    this.marks.use(shown, recording?.position ?? this.position, { isShown: isOpen && shown.length > 0, isRecording });
    this.transport.show();
    if (!isOpen || !state) return;
    const isTableShown = !this.table.root.hidden;
    buttons.record.setAttribute("aria-pressed", String(isRecording));
    change(buttons.record, { textContent: isRecording ? "Stop" : "Record",
      ariaLabel: isRecording ? "Stop recording the gaze" : "Record the gaze" });
    buttons.table.setAttribute("aria-pressed", String(isTableShown));
    for (const each of [buttons.save, buttons.clear]) each.disabled = !rows.length;
    this.table.insert.disabled = isRecording;
    if (isTableShown) this.table.use(shown, this.time, this.step);
  }

  // Rows of a recording in progress, the same object until it changes.
  /** @param {Recording} recording */
  _recorded(recording) {
    if (this.recorded?.of !== recording || this.recorded.n !== recording.nMoved) {
      this.recorded = { of: recording, n: recording.nMoved, rows: recording.rows(this.rows) };
    }
    return this.recorded.rows;
  }

  _words() {
    const { recording } = this, [x, y] = recording?.position ?? this.position;
    const t = recording && !this.isVideo ? recording.elapsed : this.time, digits = this.step < 0.01 ? 3 : 2;
    return t.toFixed(digits) + " s · " + x.toFixed(1) + ", " + y.toFixed(1) + " µm";
  }
}
