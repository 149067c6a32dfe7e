// Values of the photosites: colours of the map.

import { titleOf } from "/web/legend.js";
import { $, change, setChoices } from "/web/page_parts.js";

export function create(root, { page, panes, editor, recolour, showSelection, ask, drawAsked }) {
  function fillColumns(columns) {
    const select = $("colouring");
    setChoices(select, columns.map((column) => [column.key, titleOf(column)]));
    if (!columns.some((column) => column.key === page.key)) page.key = columns[0].key;
    change(select, { value: page.key });
  }
  // Columns with the values of sites; null if they are those of others.
  function columnsOf({ about, arrays }, sites) {
    const valuesOf = ({ of, array }) => (of === "area" ? sites.area : of === "size" ? sites.sizes : arrays[array]);
    const columns = about.columns.map((column) => ({ ...column, values: valuesOf(column) }));
    return columns.some((column) => column.values && column.values.length !== sites.n) ? null : columns;
  }
  const filterOf = ({ about, arrays }) => (about.filter ? arrays[about.filter] : null);

  return {
    // The colours of the map, while the server computes the views that are shown with it.
    prepare(part) {
      const { b } = panes, sites = page.held.parts.findLast((each) => each.part === "sites")?.sites ?? b.sites;
      part.columns = sites && columnsOf(part, sites);
      if (!sites || !part.columns || page.frozen) return;
      const column = part.columns.find(({ key }) => key === page.key) ?? part.columns[0];
      if (column.values) b.prepareColours(sites, column, filterOf(part), page);
    },
    use(part) {
      const { b } = panes, { sites } = b;
      if (!sites) return;
      const columns = part.columns ?? columnsOf(part, sites);
      // Values of another layout: its outlines follow.
      if (!columns || columns.some((column) => column.values && column.values.length !== sites.n)) return;
      b.useColumns(columns, filterOf(part));
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
