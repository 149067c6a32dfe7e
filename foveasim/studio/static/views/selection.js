// Statistics of the selected photosites.

import { shown } from "/web/colours.js";
import { downloadTable, statisticsRows } from "/web/measure.js";
import { around, make } from "/web/page_parts.js";
import { buttonOf } from "../elements.js";
import { percent } from "../problems.js";

const HINT = "Press S and drag on the photosites to select some of them.";

export function create(root, { page, panes, select }) {
  const heading = root.querySelector("h2"), note = make("p", HINT, "quiet"), table = make("table", undefined, { id: "selection" });
  const save = buttonOf("CSV", () => downloadTable(panes.b.sites, panes.b.columns, page.selected, "studio"),
    { id: "export", disabled: true });
  const clear = buttonOf("Clear", () => select(null), { id: "clear-selection", disabled: true });
  heading.id = "selection-heading";
  root.append(around("div", "row", save, clear), note, table);
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
