// Statistics of the selected photosites.

import { shown } from "/web/colours.js";
import { downloadTable, statisticsRows } from "/web/measure.js";
import { make } from "/web/page_parts.js";
import { percent } from "../problems.js";

const HINT = "Press S and drag on the photosites to select some of them.";

export function create(root, { page, panes, select }) {
  const heading = root.querySelector("h2"), row = make("div", undefined, "row"), table = make("table");
  const save = make("button", "CSV"), clear = make("button", "Clear");
  const note = make("p", HINT, "quiet");
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
      const code = panes.b.columns.find(({ key }) => key === "code")?.values, white = 2 ** (page.state?.summary.bits ?? 0) - 1;
      const nSaturated = code ? selected.filter((site) => code[site] === white).length : 0;
      note.hidden = isAny && !nSaturated;
      note.textContent = isAny ? percent(nSaturated / selected.length) + " of them are saturated; their signals are clipped." : HINT;
      save.disabled = !selected.length;
      clear.disabled = !isAny;
      table.replaceChildren(...(selected.length ? statisticsRows(panes.b.columns, selected) : []));
    },
  };
}
