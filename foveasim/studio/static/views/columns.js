// Values of the photosites: colours of the map.

import { titleOf } from "/web/legend.js";
import { $ } from "/web/page_parts.js";

export function create(root, { page, panes, editor, recolour, showSelection, ask, drawAsked }) {
  function fillColumns(columns) {
    const select = $("colouring"), text = columns.map((column) => column.key + titleOf(column)).join();
    if (select.dataset.columns !== text) {
      select.dataset.columns = text;
      select.replaceChildren(...columns.map((column) => new Option(titleOf(column), column.key)));
    }
    if (!columns.some((column) => column.key === page.key)) page.key = columns[0].key;
    select.value = page.key;
  }
  return {
    use({ about, arrays }) {
      const { b } = panes, { sites } = b;
      if (!sites) return;
      const valuesOf = ({ of, array }) => (of === "area" ? sites.area : of === "size" ? sites.sizes : arrays[array]);
      const columns = about.columns.map((column) => ({ ...column, values: valuesOf(column) }));
      // Values of another layout: its outlines follow.
      if (columns.some((column) => column.values.length !== sites.n)) return;
      b.useColumns(columns, about.filter ? arrays[about.filter] : null);
      fillColumns(columns);
      editor.useColumns();
      recolour();
      if (page.selected.length) showSelection();
      // Photosites are drawn at once: they are in the next frame together with the controls.
      ask("maps");
      drawAsked();
    },
  };
}
