// Statistics of the selected photosites.

import { shown } from "/web/colours.js";
import { downloadTable, statisticsRows } from "/web/measure.js";
import { make } from "/web/page_parts.js";

export function create(root, { page, panes, select }) {
  const heading = root.querySelector("h2"), row = make("div", undefined, "row"), table = make("table");
  const save = make("button", "CSV"), clear = make("button", "Clear");
  const note = make("p", "Press S and drag on the photosites to select some of them.", "quiet");
  Object.assign(save, { type: "button", id: "export", disabled: true });
  Object.assign(clear, { type: "button", id: "clear-selection", disabled: true });
  heading.id = "selection-heading";
  table.id = "selection";
  row.append(save, clear);
  root.append(row, note, table);
  save.addEventListener("click", () => downloadTable(panes.b.sites, panes.b.columns, page.selected, "studio"));
  clear.addEventListener("click", () => select(null));
  return {
    onSelection() {
      const { selected } = page, isAny = Boolean(page.rectangle) || selected.length > 0;
      heading.textContent = isAny ? "Selection: " + shown(selected.length) + " photosites" : "Selection";
      note.hidden = isAny;
      save.disabled = !selected.length;
      clear.disabled = !isAny;
      table.replaceChildren(...(selected.length ? statisticsRows(panes.b.columns, selected) : []));
    },
  };
}
