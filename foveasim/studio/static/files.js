// Files and links: dropped and chosen files, the menu, texts of the state, and links that restore it.

import { $, download, downloadText, make, notice } from "/web/page_parts.js";
import { fragmentOf, settingsOf, stateOf } from "./links.js";
import { confirmed, copyText, listenToMenu, showText } from "./menus.js";
import { awaited } from "./pending.js";
import { isVideo } from "./sources.js";

// Of several files, the one that names or describes the others.
const isIndex = ({ name }) => /\.(hdr|ya?ml)$/i.test(name);

// Parameters in lines "name: value", whose values are JSON or words.
/** @type {(text: string, names: string[], required: string[]) => { found: { [name: string]: any }, problem: string }} */
function parametersOf(text, names, required) {
  /** @type {{ [name: string]: any }} */
  const found = {};
  for (const line of text.split("\n").map((each) => each.trim()).filter(Boolean)) {
    const [, name = "", value = ""] = /^(\w+)\s*[:=]\s*(.*)$/.exec(line) || [];
    if (!names.includes(name)) return { found, problem: "Not a parameter: " + (name || line) };
    if (!value) continue;
    try { found[name] = JSON.parse(value); } catch { found[name] = value; }
  }
  const missing = required.filter((name) => !(name in found));
  return { found, problem: missing.length ? "Required: " + missing.join(", ") : "" };
}

export class Files {
  connection; on; wantsToken = false;
  // Parameters of files, by the label of their section.
  /** @type {Map<string, string>} */ typed = new Map();

  // Callbacks: busy(text) while a file is sent, with null at its end; dropped(transfer) returns whether it takes the files.
  constructor(connection, on) {
    Object.assign(this, { connection, on });
    this._listenToDrops();
    $("chosen-file").addEventListener("change", () => {
      const file = $("chosen-file").files?.[0];
      if (file) this.upload(file);
      $("chosen-file").value = "";
    });
    listenToMenu($("file"), $("file-menu"));
    $("file-menu").addEventListener("click", (event) => {
      const button = /** @type {Element} */ (event.target).closest("button");
      if (button) this._choose(button.dataset);
    });
    $("save-form").addEventListener("submit", (event) => {
      if (event.submitter?.getAttribute("value") === "save") connection.send({ do: "save", name: $("save-name").value });
    });
    $("link-form").addEventListener("submit", async (event) => {
      const text = $("link-text").value;
      $("link-text").value = "";
      if (event.submitter?.getAttribute("value") !== "open") return;
      if (!(await awaited(this.openLink(text)))) notice("The text is not a link of the studio");
    });
    addEventListener("hashchange", () => { if (connection.isOpen) awaited(this.openLink(location.hash)); });
  }

  _listenToDrops() {
    const hasFile = (event) => [...(event.dataTransfer?.types || [])].includes("Files");
    let depth = 0;
    document.addEventListener("dragenter", (event) => {
      if (hasFile(event)) { depth++; $("drop").hidden = false; event.preventDefault(); }
    });
    document.addEventListener("dragleave", (event) => { if (hasFile(event) && --depth <= 0) { depth = 0; $("drop").hidden = true; } });
    document.addEventListener("dragover", (event) => { if (hasFile(event)) event.preventDefault(); });
    document.addEventListener("drop", (event) => {
      depth = 0;
      $("drop").hidden = true;
      const { dataTransfer } = event;
      if (!dataTransfer || !hasFile(event)) return;
      event.preventDefault();
      const [file] = dataTransfer.files;
      if (!this.on.dropped(dataTransfer) && file) this.upload(file);
    });
  }

  /** @param {DOMStringMap} data */
  async _choose({ do: action, copy, file, extension }) {
    const { connection } = this;
    if (action === "open") $("chosen-file").click();
    else if (action === "open-link") $("link-dialog").showModal();
    else if (action === "link" || action === "share") {
      this.wantsToken = action === "link";
      connection.send({ do: "text", what: "link" });
    }
    else if (action === "save") {
      $("save-dialog").showModal();
      $("save-name").select();
    }
    else if (action === "diff" || action === "log") connection.send({ do: "text", what: action });
    else if (copy) connection.send({ do: "text", what: copy });
    else if (file) {
      const { blob, error } = await connection.fetchFile(file);
      if (error) notice(error);
      else download(blob, document.title.split(" – ")[0], extension ?? "txt");
    }
  }

  // Sends a file; returns its path, or null after a notice.
  async _sent(file) {
    this.on.busy("sending " + file.name + "…");
    const { path, error } = await this.connection.upload(file);
    if (path) return path;
    this.on.busy(null);
    notice(file.name + ": " + error);
    return null;
  }

  async upload(file) {
    const path = await this._sent(file);
    if (path) this.connection.send(isVideo(file.name) ? { do: "video", path } : { do: "file", path });
  }

  // Lets the user choose a file for a setting, with those that it names; returns its path, or null.
  /** @type {() => Promise<string | null>} */
  choose() {
    const input = make("input");
    input.type = "file";
    input.multiple = true;
    return new Promise((resolve) => {
      input.addEventListener("cancel", () => resolve(null));
      input.addEventListener("change", () => resolve(awaited(this._sentAll([...input.files || []]))));
      input.click();
    });
  }

  // Returns a section with a file and parameters that the user chooses, or null.
  /** @type {(choice: Choice) => Promise<any>} */
  async chooseSection({ label, value, file, required = [], optional = [] }) {
    const path = await this.choose(), names = [...required, ...optional];
    if (!path) return null;
    if (!names.length) return { ...value, [String(file)]: path };
    const form = $("parameters-form"), field = $("parameters-text");
    $("parameters-title").textContent = label.replaceAll("_", " ") + ": " + path.split("/").pop();
    $("parameters-names").textContent = "Parameters: " + names.join(", ");
    field.value = this.typed.get(label) ?? required.map((name) => name + ": ").join("\n");
    $("parameters-error").textContent = "";
    $("parameters-dialog").returnValue = "";
    $("parameters-dialog").showModal();
    return new Promise((resolve) => {
      const end = new AbortController(), { signal } = end;
      form.addEventListener("submit", (event) => {
        if (event.submitter?.getAttribute("value") !== "use") return;
        const { found, problem } = parametersOf(field.value, names, required);
        $("parameters-error").textContent = problem;
        if (problem) event.preventDefault();
        else {
          this.typed.set(label, field.value);
          end.abort();
          resolve({ ...value, ...found, [String(file)]: path });
        }
      }, { signal });
      $("parameters-dialog").addEventListener("close", () => { end.abort(); resolve(null); }, { signal });
    });
  }

  async _sentAll(files) {
    const first = files.find(isIndex) ?? files[0];
    /** @type {string | null} */
    let found = null;
    for (const file of files) {
      const path = await this._sent(file);
      if (!path) return null;
      if (file === first) found = path;
    }
    this.on.busy(null);
    return found;
  }

  // Asks before saved settings are replaced.
  /** @param {Exists} message */
  async askToReplace({ name, file }) {
    if (await confirmed(file + " exists. Replace it?", "Replace")) this.connection.send({ do: "save", name, may_replace: true });
  }

  async receiveText({ what, text, files }) {
    if (what === "link") {
      await copyText(location.origin + location.pathname + "#"
        + (await fragmentOf(text, this.wantsToken ? this.connection.token : "")), "Link");
      if (files.length) notice("The link contains only the names of uploaded files: " + files.join(", "));
    } else if (what === "diff") showText("Differences", text || "The settings are those at the start.");
    else if (what === "log") showText("Changes of this session", text || "Nothing was changed.");
    else if (what === "sweep") {
      downloadText(text, document.title.split(" – ")[0] + "_sweep", "yaml", "application/yaml");
      if (files.length) notice("The sweep requires these uploaded files next to it: " + files.join(", "));
    } else copyText(text, what === "yaml" ? "YAML" : "Python");
  }

  // Restores the settings of a link, which is then removed from the address; the server checks them. Returns whether it is one.
  async openLink(link) {
    const compressed = stateOf(link);
    if (compressed === null) return false;
    if (link === location.hash) history.replaceState(null, "", "#" + this.connection.token);
    const { settings, error } = await settingsOf(compressed);
    if (error) notice(error);
    else this.connection.send({ do: "restore", settings });
    return true;
  }
}
