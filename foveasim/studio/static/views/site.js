// Values of the photosite under the mouse, the pinned one, or the one nearest to the centre of the layout.

import { siteHeading, siteRows } from "/web/shell.js";
import { change, make } from "/web/page_parts.js";
import { buttonOf } from "../elements.js";

// Index of the site nearest to the centre of the layout, found once for each.
/** @type {WeakMap<object, number>} */
const known = new WeakMap();

function nearest(sites) {
  let found = known.get(sites);
  if (found === undefined) {
    const [x0, y0, x1, y1] = sites.bounds, x = 0.5 * (x0 + x1), y = 0.5 * (y0 + y1);
    let least = Infinity;
    for (let i = 0; i < sites.n; i++) {
      const [cx, cy] = sites.centre(i), distance = (cx - x) ** 2 + (cy - y) ** 2;
      if (distance < least) { least = distance; found = i; }
    }
    known.set(sites, found ??= 0);
  }
  return found;
}

export function create(root, { page, panes, keep }) {
  const heading = root.querySelector("h2"), list = make("dl", undefined, { className: "table", id: "site" });
  const compare = buttonOf("Compare in charts", () => keep(Number(compare.dataset.site)), { id: "compare-site" });
  heading.id = "site-heading";
  root.append(list, compare);
  return {
    onSite() {
      const { sites, columns } = panes.b, chosen = page.hovered >= 0 ? page.hovered : page.pinned;
      if (!sites) return;
      const site = chosen >= 0 ? chosen : nearest(sites);
      change(heading, { textContent: siteHeading(site, page.pinned, chosen >= 0 ? [] : ["nearest to the centre"]) });
      const isKept = page.kept.includes(site);
      compare.dataset.site = String(site);
      change(compare, { textContent: isKept ? "Remove from charts" : "Compare in charts", ariaPressed: String(isKept) });
      list.replaceChildren(...siteRows(sites, columns, site, 4).flatMap(([label, text]) => [make("dt", label), make("dd", text)]));
    },
  };
}
