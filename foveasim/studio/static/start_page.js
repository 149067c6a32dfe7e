// Start page: presets with thumbnails, a form of new sensors, and recent files.

import { shown } from "/web/colours.js";
import { $, around, make, notice } from "/web/page_parts.js";
import { lasting } from "./memory.js";
import { numberOf, quantity, unitText } from "./numbers.js";

// The choice not to show the page at start.
const NEVER = "never";
// Choices of the format: none, and an own one.
const ANY_SIZE = "any", OWN_SIZE = "own";
// Requirements that may be left open, with their names in messages of the page, and factors to the units of the server.
/** @type {[string, string, string, number][]} */
const REQUIREMENTS = [["start-smallest", "Smallest site", "min_size_um", 1], ["start-angle", "Sites per degree", "sites_per_deg", 1],
  ["start-rate", "Data rate", "pixels_per_s", 1e6], ["start-frames", "Frames per second", "frames_per_s", 1]];
const MM_PER_UM = 1e-3;

/** @type {(id: string, name: string) => number} */
const givenOf = (id, name) => numberOf($(id).value, name.endsWith("_um") ? "µm" : "");

// A button of a preset; its picture is loaded when it becomes visible.
/** @param {StartPreset} preset */
function cardOf({ name, label, text, picture }) {
  const image = make("img", undefined, { alt: "", loading: "lazy", width: 400, height: 300, src: "/static/presets/" + picture });
  const card = around("button", { type: "button", className: "card" }, image, make("b", label), make("span", text));
  card.dataset.preset = name;
  return card;
}

/** @param {RecentFile} file */
function recentOf({ name, path, directory, time_s }) {
  const time = new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "short" }).format(new Date(1000 * time_s));
  const button = around("button", { type: "button" }, make("span", name), make("span", time + ", " + directory));
  button.dataset.path = path;
  return around("li", {}, button);
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
    $("start-never").addEventListener("change", () => lasting.set("start", $("start-never").checked ? NEVER : ""));
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
    const isNever = lasting.get("start") === NEVER;
    if (isAtStart && isNever) return;
    $("start-never").checked = isNever;
    $("start-problem").textContent = problem;
    if (!this.root.open) this.root.showModal();
    const contents = await this.connection.fetchStart();
    if ("error" in contents) $("start-recent-note").textContent = contents.error + ".";
    else this._use(contents);
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
    const others = [{ name: OWN_SIZE, label: "own size" }, { name: ANY_SIZE, label: "follows from the requirements" }];
    fill("start-format", [...formats, ...others], initial.format);
    fill("start-filters", [{ name: "", label: "none" }, ...mosaics], initial.filters);
    fill("start-electronics", electronics, initial.electronics);
    $("start-sites").placeholder = shown(initial.n_sites);
    $("start-frames").placeholder = shown(initial.frames_per_s);
    for (const id of ["start-smallest", "start-angle", "start-rate"]) $(id).placeholder = "not set";
  }

  get _format() { return this.contents?.formats.find(({ name }) => name === $("start-format").value); }

  // What the choices mean.
  _showHints() {
    if (!this.contents) return;
    const { generators, electronics } = this.contents, format = this._format;
    const generator = generators.find(({ name }) => name === $("start-generator").value);
    const shorter = shown(Math.min(...(this._size() ?? [NaN])));
    const place = generator?.fills_format ? "Fills the format."
      : "Inscribed in the shorter side of the format" + (Number(shorter) > 0 ? ": " + shorter + " × " + shorter + " mm." : ".");
    $("start-own").hidden = $("start-format").value !== OWN_SIZE;
    $("start-generator-hint").textContent = generator ? generator.text + " " + place : "";
    $("start-format-hint").textContent = format ? "Source: " + format.source + "." : "";
    $("start-filters-hint").textContent = $("start-filters").value && !generator?.has_mosaic
      ? "This layout has no rows for a mosaic: red, green and blue are assigned so that neighbours differ." : "";
    const found = electronics.find(({ name }) => name === $("start-electronics").value);
    $("start-electronics-hint").textContent = found ? unitText(found.scaling + " Source: " + found.source + ".") : "";
  }

  // Width and height of the chosen format in mm; null if they follow.
  _size() {
    const format = this._format;
    if ($("start-format").value === ANY_SIZE) return null;
    if (format) return format.size_um.map((length) => MM_PER_UM * length);
    return [$("start-width"), $("start-height")].map(({ value }) => numberOf(value, "mm"));
  }

  _problem() {
    const text = $("start-sites").value.trim(), n = numberOf(text), most = this.contents?.max_sites ?? Infinity;
    const isGiven = $("start-format").value !== ANY_SIZE;
    if (isGiven && !this._size()?.every((length) => length > 0)) return "Width and height must be positive numbers.";
    if (text && !(Number.isInteger(n) && n >= 1 && n <= most)) return "Photosites must be an integer from 1 to " + shown(most) + ".";
    const wrong = REQUIREMENTS.find(([id, , name]) => $(id).value.trim() && !(givenOf(id, name) > 0));
    return wrong ? wrong[1] + " must be a positive number." : "";
  }

  async _create() {
    const problem = this._problem();
    $("start-problem").textContent = problem;
    if (problem || !this.contents) return;
    const wanted = numberOf($("start-sites").value), before = JSON.stringify(this.newest()?.settings);
    const given = REQUIREMENTS.filter(([id]) => $(id).value.trim()).map(([id, , name, factor]) => [name, factor * givenOf(id, name)]);
    const isDone = await this._choose({
      do: "new_sensor", generator: $("start-generator").value, size_um: this._size()?.map((length) => length / MM_PER_UM) ?? null,
      n_sites: Number.isFinite(wanted) ? wanted : null, ...Object.fromEntries(given),
      filters: $("start-filters").value || null, electronics: $("start-electronics").value,
    });
    const state = this.newest(), n = state?.summary.n_sites;
    if (!isDone) this.open({ problem: Object.values(state?.errors || {})[0] || "The server does not answer." });
    else if (n && JSON.stringify(state.settings) !== before) {
      notice(shown(n) + " photosites" + (Number.isFinite(wanted) && n !== wanted ? ", the nearest possible number to " + shown(wanted)
        : ", the smallest of " + quantity(state.summary.min_size_um, "µm", 3)));
    }
  }

  // Sends a choice, whose result the table shows.
  /** @param {Change} message */
  _choose(message) {
    this.root.close();
    return this.connection.requests.answered(this.connection.send(message));
  }
}
