// Sources of the scene: photographs, videos, folders of pictures, the camera, test charts.

import { $, make, notice } from "/web/page_parts.js";
import { Camera, FIRST_SIZE, SIZES } from "./camera.js";
import { buttonOf, selectOf, titledButton } from "./elements.js";
import { Film, Rate } from "./film.js";
import { menuOf } from "./menus.js";
import { awaited } from "./pending.js";

const VIDEO = /\.(mp4|m4v|mov|avi|mkv|webm|mpe?g|ogv|wmv|gif)$/i;
const PICTURE = /\.(bmp|exr|hdr|jp2|jpe?g|png|ppm|tga|tiff?|webp)$/i;
// Pictures that browsers can show.
const SHOWN = /\.(bmp|jpe?g|png|webp)$/i;
const MAX_PICTURES = 500;
const STOP = "Stop the camera; its last frame stays the scene";
const NAMES = { back: "One frame back", play: "Play", pause: "Pause", forward: "One frame forward", slider: "Frame" };

export const isVideo = (name) => VIDEO.test(name);

/** @typedef {{ file: File, path: string | null, address: string | null }} PictureFile */

export class Sources {
  /** @type {Film | null} */ film = null;
  /** @type {PictureFile[] | null} */ folder = null;
  /** @type {"video" | "camera" | "folder" | null} */ kind = null;
  /** @type {FilmAbout | null} */ about = null;
  // Times of the frames of a video, if they are not at equal steps.
  /** @type {number[] | null} */ timesS = null;
  /** @type {Rate} */ rate;
  // Elements.
  /** @type {{ [name: string]: HTMLButtonElement }} */ buttons;
  /** @type {HTMLElement} */ menu;
  /** @type {HTMLInputElement} */ directory;
  /** @type {HTMLElement} */ row;
  /** @type {HTMLElement} */ strip;
  /** @type {HTMLSelectElement} */ size;

  // Callbacks: connection(), state(), charts() (choices of the scene), choose() (a file), playing() before a film plays.
  constructor(pane, transport, on) {
    this.pane = pane;
    this.transport = transport;
    this.on = on;
    this.camera = new Camera();
    this._build();
  }

  // -- elements -------------------------------------------------------------------------------------------------------------

  _build() {
    const title = "Photograph, video, folder, camera or test chart as the scene";
    const { frame, menu } = menuOf("Source", { id: "source", title }, () => this._fillMenu());
    this.menu = menu;
    this.menu.id = "source-menu";
    this.directory = make("input", undefined, { type: "file", webkitdirectory: true, multiple: true, className: "unseen", tabIndex: -1,
      id: "chosen-folder", ariaLabel: "Folder of pictures" });
    frame.append(this.directory);
    $("follow-scene").before(frame);
    this.row = make("div", undefined, { id: "film" });
    this.strip = make("div", undefined, { className: "strip", id: "strip", hidden: true, role: "group",
      ariaLabel: "Pictures of the folder" });
    this.pane.querySelector(".bar").after(this.transport.root, this.strip);
    this.buttons = {
      close: titledButton("✕", "Close", () => this._close()),
      camera: titledButton("Stop", STOP, () => this._switchCamera()),
    };
    this.size = selectOf(SIZES.map((size) => [String(size), size + " px"]), "Longer side of camera frames");
    this.size.value = String(FIRST_SIZE);
    this.size.addEventListener("change", () => { this.camera.size = Number(this.size.value); });
    this.row.append(this.buttons.camera, this.size, this.buttons.close);
    this.transport.add({ names: NAMES, part: this.row, film: () => (this._isCamera ? null : this.film), words: () => this._words(),
      started: () => this.on.playing() });
    this.directory.addEventListener("change", () => {
      this.openFolder([...this.directory.files || []].filter((file) => file.webkitRelativePath.split("/").length <= 2));
      this.directory.value = "";
    });
  }

  _fillMenu() {
    const { on } = this, charts = on.charts().filter(({ label }) => label !== "picture");
    this.menu.replaceChildren(
      buttonOf("Photograph or video…", () => on.choose()), buttonOf("Folder of pictures…", () => this.directory.click()),
      buttonOf(this.camera.isOn ? "Stop the camera" : "Camera", () => this._switchCamera()),
      make("hr"), make("h3", "Test charts"),
      ...charts.map(({ label, value }) => buttonOf(label[0].toUpperCase() + label.slice(1),
        () => on.connection().send({ do: "set", key: "scene", value, final: true }))),
    );
  }

  // -- answers of the server --------------------------------------------------------------------------------------------------

  _shown(id) { return this.on.connection().requests.answered(id); }

  lost() {
    this.film?.pause();
    if (this.camera.isOn) this.stopCamera();
  }

  /** @param {State} state */
  use({ film, settings }) {
    const before = this.film, picture = settings.scene?.picture;
    const k = this.folder ? this.folder.findIndex(({ path }) => path && path === picture) : -1;
    if (film?.kind === "video") {
      if (this.kind !== "video" || this.shownName !== film.name || before?.count !== film.n_frames) {
        before?.pause();
        this.film = new Film({ count: film.n_frames ?? 1, n: film.n, frameS: film.frame_s, timesS: this.timesS,
          isSkipping: true,
          show: (n) => this._shown(this.on.connection().send({ do: "frame", n })), changed: () => this._show() });
      } else if (!before.isBusy) before.n = film.n;
      this.shownName = film.name;
    } else if (film?.kind === "camera") {
      this.film?.pause();
      this.film = null;
    } else if (k >= 0) {
      if (this.kind !== "folder" || !before) this.film = this._folderFilm(k);
      else if (!before.isBusy) before.n = k;
    } else if (this.film && !(this.kind === "folder" && this.film.isBusy)) {
      this.film.pause();
      this.film = null;
    }
    this.kind = film?.kind || (this.film && this.folder ? "folder" : null);
    this.about = film;
    if (this.camera.isOn && this.isLive && film?.kind !== "camera") this.stopCamera();
    this._show();
  }

  // -- display ------------------------------------------------------------------------------------------------------------------

  get _isCamera() { return this.kind === "camera" || this.camera.isOn; }

  _show() {
    const { film, kind, camera, _isCamera: isCamera, buttons: { camera: stop } } = this;
    this.row.hidden = !film && !isCamera;
    this.strip.hidden = !(this.folder && (kind === "folder"));
    for (const each of [stop, this.size]) each.hidden = !isCamera;
    this.transport.root.classList.toggle("live", camera.isOn);
    if (isCamera) {
      stop.textContent = camera.isOn ? "Stop" : "Start";
      stop.title = stop.ariaLabel = camera.isOn ? STOP : "Start the camera again";
    } else if (film && kind === "folder") [...this.strip.children].forEach((cell, k) => {
      const isCurrent = k === film.n;
      if (isCurrent && cell.getAttribute("aria-current") !== "true") cell.scrollIntoView({ block: "nearest", inline: "nearest" });
      cell.setAttribute("aria-current", String(isCurrent));
    });
    this.transport.show();
  }

  // The frame, or the size of the camera, with the rate.
  _words() {
    const { film, camera, about, _isCamera: isCamera } = this, rate = (isCamera ? this.rate : film?.rate)?.perS ?? NaN;
    const perS = Number.isFinite(rate) && (film?.isPlaying || camera.isOn) ? rate.toFixed(rate < 10 ? 1 : 0) + " frames/s" : "";
    const size = about?.kind === "camera" ? about.width + " × " + about.height : "";
    if (isCamera) return camera.isOn ? ["live", size, perS].filter(Boolean).join(" · ") : "camera stopped, last frame";
    const total = String(film?.count);
    return film ? String(film.n + 1).padStart(total.length, "\u2007") + " / " + total + (perS ? " · " + perS : "") : "";
  }

  // Closes the row; the current frame stays the scene.
  _close() {
    this.stopCamera();
    this.film?.pause();
    this.film = this.kind = null;
    if (this.folder) this._forgetFolder();
    this._show();
    $("source").focus();
  }

  // -- folders --------------------------------------------------------------------------------------------------------------------

  // Uses files of a drop that are more than one, or in a folder; returns whether it does.
  dropped(transfer) {
    const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
    const directory = entries.find((entry) => entry.isDirectory);
    if (directory) {
      awaited(filesOf(directory)).then((files) => this.openFolder(files), () => notice("The folder cannot be read"));
      return true;
    }
    const files = [...transfer.files];
    if (files.length < 2 || !files.every(({ name }) => PICTURE.test(name))) return false;
    this.openFolder(files);
    return true;
  }

  openFolder(files) {
    const pictures = files.filter(({ name }) => PICTURE.test(name)
      && !name.startsWith(".")).sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
    if (!pictures.length) { notice("The folder contains no pictures"); return; }
    if (pictures.length > MAX_PICTURES) notice("The first " + MAX_PICTURES + " of " + pictures.length + " pictures are used");
    this._forgetFolder();
    this.film?.pause();
    /** @type {PictureFile[]} */
    const folder = pictures.slice(0, MAX_PICTURES).map((file) => ({ file, path: null, address: null }));
    this.folder = folder;
    this.strip.replaceChildren(...folder.map((item, k) => {
      const { name } = item.file, cell = titledButton("", name, () => { this.film?.pause(); this.film?.go(k); });
      if (SHOWN.test(name)) {
        item.address = URL.createObjectURL(item.file);
        cell.append(make("img", undefined, { loading: "lazy", decoding: "async", alt: "", src: item.address }));
      } else cell.append(make("span", name.split(".").at(-1)));
      return cell;
    }));
    const film = this._folderFilm(0);
    this.film = film;
    this.kind = "folder";
    film.go(0);
  }

  _folderFilm(n) {
    return new Film({ count: this.folder?.length ?? 0, n, isSkipping: false, show: (k, isFinal) => this._showPicture(k, isFinal),
      changed: () => this._show() });
  }

  async _showPicture(k, isFinal) {
    const item = this.folder?.[k], connection = this.on.connection();
    if (!item) return false;
    if (!item.path) {
      const answer = await connection.upload(item.file);
      if (answer.error) { notice(item.file.name + ": " + answer.error); return false; }
      item.path = answer.path;
    }
    // The first picture makes the scene a photograph; the next ones replace it.
    const { scene } = this.on.state().settings, isOfFolder = this.folder?.some(({ path }) => path && path === scene.picture);
    return this._shown(connection.send(isOfFolder ? { do: "set", key: "scene.picture", value: item.path, final: isFinal }
      : { do: "file", path: item.path, as: "scene" }));
  }

  _forgetFolder() {
    for (const { address } of this.folder || []) if (address) URL.revokeObjectURL(address);
    this.folder = null;
    this.strip.replaceChildren();
  }

  // -- camera ---------------------------------------------------------------------------------------------------------------------

  _switchCamera() { return this.camera.isOn ? this.stopCamera() : this.startCamera(); }

  async startCamera() {
    if (this.camera.isOn || this.isStarting) return;
    this.isStarting = true;
    const problem = await awaited(this.camera.start(() => { this.stopCamera(); notice("The camera was disconnected"); }));
    this.isStarting = false;
    if (problem) { notice(problem); return; }
    this.film?.pause();
    this.rate = new Rate();
    this.isLive = false;
    this._show();
    // The camera may be stopped and started again while a frame is simulated.
    const { stream } = this.camera;
    let isFirst = true;
    while (this.camera.stream === stream) {
      if (document.hidden) {
        await new Promise((resolve) => { document.addEventListener("visibilitychange", resolve, { once: true }); });
        continue;
      }
      const frame = this.camera.frame();
      if (!frame) break;
      const { width, height, pixels } = frame;
      const isShown = await this._shown(this.on.connection().sendFrame({ width, height, is_first: isFirst }, pixels));
      if (!isShown) break;
      this.isLive = true;
      isFirst = false;
      this.rate.count();
      this._show();
    }
    if (this.camera.stream === stream) this.stopCamera();
  }

  stopCamera() {
    if (!this.camera.isOn) return;
    this.camera.stop();
    this.isLive = false;
    this._show();
  }
}

// Returns the files of a dropped directory, without those of directories in it.
async function filesOf(directory) {
  const reader = directory.createReader(), found = [];
  for (;;) {
    const entries = await new Promise((resolve, reject) => { reader.readEntries(resolve, reject); });
    if (!entries.length) break;
    found.push(...entries.filter((entry) => entry.isFile));
  }
  return Promise.all(found.map((entry) => new Promise((resolve, reject) => { entry.file(resolve, reject); })));
}
