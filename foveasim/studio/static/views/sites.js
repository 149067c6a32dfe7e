// Outlines of the photosites on their map.

import { $ } from "/web/page_parts.js";
import { Sites } from "/web/sites.js";
import { boundaryOf } from "../boundary.js";

export function create(root, { page, panes, editor, ask }) {
  const { b, scene } = panes;
  const prepare = (part) => {
    part.sites = new Sites(part.arrays, part.about);
    part.boundary = boundaryOf(part.sites, part.arrays.boundary);
    if (!page.frozen) b.prepareSites(part.sites);
  };
  return {
    prepare,
    use(part) {
      if (!part.sites) prepare(part);
      const { sites } = part;
      if (!b.map) $("views").classList.add("loaded");
      b.useSites(sites, part.about.palette);
      page.boundary = part.boundary;
      page.hovered = -1;
      if (page.pinned >= sites.n) page.pinned = -1;
      page.kept = page.kept.filter((site) => site < sites.n);
      page.selected = page.rectangle && !editor.isOn ? b.sitesIn(page.rectangle) : editor.useSites(sites);
      // Frames of the layout move with it.
      if (scene.bounds) scene.frame = part.about.bounds_um;
      ask("map");
    },
  };
}
