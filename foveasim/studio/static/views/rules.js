// Design rules: their results, and violations on the map.

import { make, notice } from "/web/page_parts.js";
import { RulesList } from "/web/rules_list.js";

export function create(root, { panes: { b }, fly, ask }) {
  const frame = make("div"), elements = { select: make("select"), note: make("p", "", "quiet"),
    list: make("ol", undefined, "violations"), more: make("button", "Show more") };
  const list = new RulesList(elements, (i) => {
    const at = list.frameOf(i, b.map);
    if (at) fly(...at);
    else notice("This violation has no position");
  });
  let version = 0;
  frame.id = "rules";
  elements.select.setAttribute("aria-label", "Design rule");
  elements.more.type = "button";
  frame.append(...Object.values(elements));
  root.append(frame);
  list.select.addEventListener("change", () => ask("map"));
  Object.assign(b, {
    drawViolations: (context, map) => list.draw(context, map, b.sites),
    violations: () => [version, list.rule, list.chosen],
    trace: () => list.traceOn(b.sites),
  });
  return {
    list,
    use({ about, arrays, version: newest }) {
      if (!b.sites) return;
      version = newest;
      list.use(about.rules, arrays, b.sites);
      ask("b");
    },
  };
}
