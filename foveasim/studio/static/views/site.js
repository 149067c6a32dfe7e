// Values of the photosite under the mouse, or the pinned one.

import { siteHeading, siteRows } from "/web/shell.js";
import { change, make } from "/web/page_parts.js";

export function create(root, { page, panes }) {
  const heading = root.querySelector("h2"), list = make("dl", undefined, "table");
  heading.id = "site-heading";
  list.id = "site";
  root.append(list);
  return {
    onSite() {
      const { sites, columns } = panes.b, site = page.hovered >= 0 ? page.hovered : page.pinned;
      if (!sites) return;
      change(heading, { textContent: siteHeading(site, page.pinned) });
      list.replaceChildren(...siteRows(sites, columns, site, 4).flatMap(([label, text]) => [make("dt", label), make("dd", text)]));
    },
  };
}
