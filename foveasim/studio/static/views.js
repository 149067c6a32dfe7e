// Views: the server lists them; each is a module in views/, which is imported when its view is first needed.

import { $, around, find, make, notice } from "/web/page_parts.js";
import { buttonOf } from "./elements.js";
import { lasting } from "./memory.js";
import { load } from "./modules.js";
import { showRows } from "./splitters.js";

// From this width, more tiles are shown at first.
const WIDE = 1800;

// A module exports create(root, studio), which adds elements to its tile and returns an object with any of these methods:
// use(part, before) for data of the server and those of variant A or null, prepare(part) for work while the server computes,
// draw() after a change of size or theme, onShown(isShown), and, only while the tile is shown, onState() after new settings,
// onValues() after the colours of the map, onSite() after the photosite under the mouse, onSelection(), onMap() when the map is
// drawn, onMarks(marks). Data are requested unless wantsData is false.
// Views of the map of the photosites.
const OF_MAP = ["sites", "columns", "signals"];
const FOLLOWED = ["onState", "onValues", "onSite", "onSelection", "onMap", "draw"];

export class Views {
  nLoading = 0;
  /** @type {ViewAbout[]} */ list = [];
  // Modules and data by the names of views; null for a module that is loading.
  /** @type {{ [name: string]: any }} */ made = {};
  /** @type {{ [name: string]: Part }} */ parts = {};
  /** @type {Set<string>} */ shown = new Set();
  /** @type {Set<string>} */ needed = new Set();

  // changed() is called when other views are shown.
  /** @param {any} studio @param {() => void} changed */
  constructor(studio, changed) {
    this.studio = studio;
    this.changed = changed;
  }

  // Uses the list of the server.
  /** @param {ViewAbout[]} list */
  describe(list) {
    // A server that was started again counts from the beginning.
    for (const part of Object.values(this.parts)) part.version = -1;
    if (this.list.length) {
      this._load();  // what could not be loaded without a server
      return;
    }
    this.list = list;
    const chosen = lasting.read("tiles");
    /** @type {(view: ViewAbout) => boolean} */
    const isFirst = innerWidth >= WIDE ? (view) => view.is_wide : (view) => view.is_first;
    const tiles = list.filter((each) => each.is_tile), groups = new Map(tiles.map(({ group: name }) =>
      [name, around("div", { role: "group", ariaLabel: name }, make("span", name, "quiet"))]));
    $("tabs").replaceChildren(...groups.values());
    for (const view of tiles) {
      const button = buttonOf(view.label, () => this.show(view.name, !this.shown.has(view.name)));
      button.dataset.tile = view.name;
      // Tiles scroll, also by keys.
      $("tiles").append(around("section", { className: "tile", id: "tile-" + view.name, tabIndex: 0, ariaLabel: view.label },
        make("h2", view.label)));
      groups.get(view.group)?.append(button);
      if (Array.isArray(chosen) ? chosen.includes(view.name) : isFirst(view)) this.shown.add(view.name);
      this._mark(view.name);
    }
    for (const view of list.filter((each) => !each.is_tile && !each.is_lazy)) this.needed.add(view.name);
    this._load();
  }

  // Names of the data that the page needs.
  get wanted() {
    return this.list.filter(({ name, has_data: hasData }) => hasData && this._isNeeded(name)
      && this.made[name]?.wantsData !== false).map(({ name }) => name);
  }

  /** @param {string} name */
  _isNeeded(name) { return this.needed.has(name) || this.shown.has(name); }

  // Resolves when the view is loaded.
  /** @type {(name: string, isShown: boolean) => Promise<void>} */
  show(name, isShown) {
    if (isShown === this.shown.has(name)) return Promise.resolve();
    if (isShown) this.shown.add(name);
    else this.shown.delete(name);
    lasting.set("tiles", JSON.stringify([...this.shown]));
    this._mark(name);
    showRows();
    if (this.made[name]) this._refresh(name);
    const loaded = this._load();
    this.changed();
    if (isShown) $("tile-" + name).scrollIntoView({ block: "nearest", inline: "nearest" });
    return loaded;
  }

  // Data that are needed although their tile is hidden.
  /** @param {string} name @param {boolean} isNeeded */
  need(name, isNeeded) {
    if (isNeeded) this.needed.add(name);
    else this.needed.delete(name);
    this._load();
    this.studio.sendViews();
  }

  /** @param {string} name */
  _mark(name) {
    $("tile-" + name).hidden = !this.shown.has(name);
    find(document, `#tabs button[data-tile="${name}"]`).ariaPressed = String(this.shown.has(name));
    this._call(name, "onShown", this.shown.has(name));
  }

  async _load() {
    const names = this.list.map(({ name }) => name).filter((name) => this._isNeeded(name) && this.made[name] === undefined);
    for (const name of names) this.made[name] = null;
    this.nLoading++;
    const modules = await Promise.allSettled(names.map((name) => load("./views/" + name + ".js")));
    this.nLoading--;
    names.forEach((name, i) => {
      const result = modules[i], root = document.getElementById("tile-" + name);
      try {
        if (result.status === "rejected") {
          delete this.made[name];  // until the next connection
          throw result.reason;
        }
        this.made[name] = result.value.create(root, this.studio);
      } catch (error) {
        this._explain(name, error);
        return;
      }
      if (root) this._call(name, "onShown", this.shown.has(name));
      this._refresh(name);
    });
  }

  /** @param {string} name @param {unknown} error */
  _explain(name, error) {
    const label = this.list.find((view) => view.name === name)?.label, why = error instanceof Error ? error.message : error;
    const text = label + " cannot be shown: " + why;
    console.error(text);
    notice(text);
  }

  // Calls a method of a view if it has that; an error in one view leaves the others.
  /** @param {string} name @param {string} method @param {unknown[]} values */
  _call(name, method, ...values) {
    const view = this.made[name];
    if (!view?.[method]) return;
    try { view[method](...values); } catch (error) { this._explain(name, error); }
  }

  /** @param {string} method @param {unknown[]} values */
  tell(method, ...values) { for (const name of this.shown) this._call(name, method, ...values); }

  /** @param {string} name */
  _refresh(name) {
    if (this.parts[name]) this._use(this.parts[name]);
    if (this.shown.has(name) && this.studio.state) for (const method of FOLLOWED) this._call(name, method);
  }

  // Shows all again, after variant A came or went.
  refresh() { for (const { name } of this.list) if (!OF_MAP.includes(name)) this._refresh(name); }

  /** @param {Part} part */
  prepare(part) { this._call(part.part, "prepare", part); }

  /** @param {Part} part */
  use(part) {
    if (this.parts[part.part]?.version > part.version) return;
    this.parts[part.part] = part;
    this._use(part);
  }

  /** @param {Part} part */
  _use(part) {
    const before = this.studio.page.frozen?.parts?.[part.part];
    this._call(part.part, "use", part, before && before !== part ? before : null);
  }
}
