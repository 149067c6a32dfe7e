// Start page: presets with thumbnails, a form of new sensors, and recent files.

import { shown } from "/web/colours.js";
import { $, make, notice } from "/web/page_parts.js";
import { numberOf } from "./numbers.js";
import { awaited } from "./pending.js";

// Storage of the choice not to show the page at start.
const STORED = "foveasim-studio-start", NEVER = "never";
const OWN_SIZE = "own";
const MM_PER_UM = 1e-3;

const stored = {
  get isNever() { try { return localStorage.getItem(STORED) === NEVER; } catch { return false; } },
  set isNever(isNever) {
    try { isNever ? localStorage.setItem(STORED, NEVER) : localStorage.removeItem(STORED); } catch { /* shown again */ }
  },
};

// A button of a preset; its picture is loaded when it becomes visible.
/** @param {StartPreset} preset */
function cardOf({ name, label, text, picture }) {
  const card = make("button", undefined, "card"), image = make("img");
  Object.assign(image, { alt: "", loading: "lazy", width: 400, height: 300, src: "/static/presets/" + picture });
  card.type = "button";
  card.dataset.preset = name;
  card.append(image, make("b", label), make("span", text));
  return card;
}

/** @param {RecentFile} file */
function recentOf({ name, path, directory, time_s }) {
  const item = make("li"), button = make("button");
  button.type = "button";
  button.dataset.path = path;
  const time = new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "short" }).format(new Date(1000 * time_s));
  button.append(make("span", name), make("span", time + ", " + directory));
  item.append(button);
  return item;
}

/** @type {(id: string, choices: { name: string, label: string }[], chosen: string) => void} */
function fill(id, choices, chosen) {
  $(id).replaceChildren(...choices.map(({ name, label }) => new Option(label, name, name === chosen, name === chosen)));
}

export class StartPage {
  /** @type {StartContents | null} */ contents = null;

  // newest() returns the last state that the server sent.
  /** @param {import("./connection.js").Connection} connection @param {() => State | null | undefined} newest */
  constructor(connection, newest) {
    this.connection = connection;
    this.newest = newest;
    this.root = $("start");
    $("start-skip").addEventListener("click", () => this.root.close());
    $("start-never").addEventListener("change", () => { stored.isNever = $("start-never").checked; });
    this.root.addEventListener("click", ({ target }) => {
      const { preset, path } = (target instanceof Element && target.closest("button")?.dataset) || {};
      if (preset) this._choose({ do: "preset", name: preset });
      else if (path) this._choose({ do: "file", path, as: "settings" });
    });
    // While typing, not when a field is left: the page must not move below a click.
    $("start-form").addEventListener("input", () => this._showHints());
    $("start-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this._create();
    });
  }

  // Opens the page, and then reads its contents: files may have changed. At start, the user may have chosen not to show it.
  async open({ isAtStart = false, problem = "" } = {}) {
    if (isAtStart && stored.isNever) return;
    $("start-never").checked = stored.isNever;
    $("start-problem").textContent = problem;
    if (!this.root.open) this.root.showModal();
    const contents = await awaited(this._read());
    if (contents) this._use(contents);
    else $("start-recent-note").textContent = "The server does not answer.";
  }

  /** @returns {Promise<StartContents | null>} */
  async _read() {
    try {
      const answer = await fetch("/start", { headers: this.connection.headers });
      return answer.ok ? await answer.json() : null;
    } catch {
      return null;
    }
  }

  /** @param {StartContents} contents */
  _use(contents) {
    if (!this.contents) this._describe(contents);
    const { recent } = this.contents = contents;
    $("start-recent").replaceChildren(...(recent || []).map(recentOf));
    $("start-recent-note").textContent = recent === null
      ? "Start the studio with --out DIR to keep settings files, which are then listed here."
      : recent.length ? "" : "No settings files yet: File, Save settings on the server, keeps them here.";
    this._showHints();
  }

  // Shows presets and choices, which remain.
  /** @param {StartContents} contents */
  _describe({ presets, generators, formats, mosaics, electronics, initial }) {
    for (const [id, wanted] of [["start-shots", "shot"], ["start-layouts", "layout"]]) {
      $(id).replaceChildren(...presets.filter(({ kind }) => kind === wanted).map(cardOf));
    }
    fill("start-generator", generators, initial.generator);
    fill("start-format", [...formats, { name: OWN_SIZE, label: "own size" }], initial.format);
    fill("start-filters", [{ name: "", label: "none" }, ...mosaics], initial.filters);
    fill("start-electronics", electronics, initial.electronics);
    $("start-sites").value = String(initial.n_sites);
  }

  get _format() { return this.contents?.formats.find(({ name }) => name === $("start-format").value); }

  // What the choices mean.
  _showHints() {
    if (!this.contents) return;
    const { generators, electronics } = this.contents, format = this._format;
    const generator = generators.find(({ name }) => name === $("start-generator").value);
    const shorter = shown(Math.min(...this._size()));
    const place = generator?.fills_format ? "Fills the format."
      : "Inscribed in the shorter side of the format" + (Number(shorter) > 0 ? ": " + shorter + " × " + shorter + " mm." : ".");
    $("start-own").hidden = Boolean(format);
    $("start-generator-hint").textContent = generator ? generator.text + " " + place : "";
    $("start-format-hint").textContent = format ? "Source: " + format.source + "." : "";
    $("start-filters-hint").textContent = $("start-filters").value && !generator?.has_mosaic
      ? "This layout has no rows for a mosaic: red, green and blue are assigned so that neighbours differ." : "";
    const found = electronics.find(({ name }) => name === $("start-electronics").value);
    $("start-electronics-hint").textContent = found ? found.scaling + " Source: " + found.source + "." : "";
  }

  // Width and height of the chosen format in mm.
  _size() {
    const format = this._format;
    if (format) return format.size_um.map((length) => MM_PER_UM * length);
    return [$("start-width"), $("start-height")].map(({ value }) => numberOf(value, "mm"));
  }

  _problem() {
    const n = numberOf($("start-sites").value), most = this.contents?.max_sites ?? Infinity;
    if (!this._size().every((length) => length > 0)) return "Width and height must be positive numbers.";
    return Number.isInteger(n) && n >= 1 && n <= most ? "" : "Photosites must be an integer from 1 to " + shown(most) + ".";
  }

  async _create() {
    const problem = this._problem();
    $("start-problem").textContent = problem;
    if (problem || !this.contents) return;
    const wanted = numberOf($("start-sites").value), before = JSON.stringify(this.newest()?.settings);
    const isDone = await this._choose({
      do: "new_sensor", generator: $("start-generator").value, size_um: this._size().map((length) => length / MM_PER_UM),
      n_sites: wanted, filters: $("start-filters").value || null, electronics: $("start-electronics").value,
    });
    const state = this.newest(), n = state?.summary.n_sites;
    if (!isDone) this.open({ problem: Object.values(state?.errors || {})[0] || "The server does not answer." });
    else if (n && JSON.stringify(state.settings) !== before) {
      notice(shown(n) + " photosites" + (n === wanted ? "" : ", the nearest possible number to " + shown(wanted)));
    }
  }

  // Sends a choice, whose result the table shows.
  /** @param {Change} message */
  _choose(message) {
    this.root.close();
    return this.connection.requests.answered(this.connection.send(message));
  }
}
