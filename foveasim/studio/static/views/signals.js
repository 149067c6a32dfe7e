// Electrons and signal-to-noise ratios of the photosites, which the server sends when the page shows them.

export function create(root, { page, panes, views, recolour, tellSite, showSelection, ask }) {
  return {
    use({ arrays, version }) {
      const { b } = panes;
      // Those of an earlier capture.
      if (version < (views.parts.columns?.version ?? 0)) return;
      for (const column of b.columns) if (arrays[column.key]?.length === b.sites?.n) column.values = arrays[column.key];
      if (arrays[page.key]) {
        recolour();
        ask("maps");
      }
      tellSite();
      if (page.selected.length) showSelection();
    },
  };
}
