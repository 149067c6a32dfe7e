// Design rules: their results, and violations on the map.

import { change, make, notice } from "/web/page_parts.js";
import { RulesList } from "/web/rules_list.js";
import { RepairDialog } from "../repair_dialog.js";

export function create(root, { panes: { b }, fly, ask, connection }) {
  const frame = make("div"), repair = make("button", "Repair…"), repaired = make("p", "", "quiet");
  const elements = { select: make("select"), note: make("p", "", "quiet"),
    list: make("ol", undefined, "violations"), more: make("button", "Show more") };
  const list = new RulesList(elements, (i) => {
    const at = list.frameOf(i, b.map);
    if (at) fly(...at);
    else notice("This violation has no position");
  });
  // Whether a report of a repair is awaited.
  let version = 0, isAwaited = false;
  const dialog = new RepairDialog({
    apply: (method) => { isAwaited = true; connection.send({ do: "repair", method }); }, cancel: () => connection.cancel(),
  });
  const openDialog = () => dialog.open(connection.send({ do: "preview_repairs" }));
  repair.type = "button";
  repair.id = "repair";
  repaired.id = "repaired";
  repair.addEventListener("click", openDialog);
  frame.id = "rules";
  elements.select.setAttribute("aria-label", "Design rule");
  elements.more.type = "button";
  frame.append(repair, repaired, ...Object.values(elements));
  root.append(frame);
  list.select.addEventListener("change", () => ask("map"));
  Object.assign(b, {
    drawViolations: (context, map) => list.draw(context, map, b.sites),
    violations: () => [version, list.rule, list.chosen],
    trace: () => list.traceOn(b.sites),
  });
  return {
    list, openDialog, dialog,
    use({ about, arrays, version: newest }) {
      if (!b.sites) return;
      version = newest;
      list.use(about.rules, arrays, b.sites);
      const last = about.repairs.at(-1), report = last ? "Repaired: " + last.text : "";
      if (isAwaited && last) notice(report.replaceAll("\n", "; "));
      isAwaited = false;
      change(repaired, { hidden: !last, textContent: report });
      change(repair, { hidden: !about.rules.length, disabled: about.is_satisfied && !last });
      ask("b");
    },
  };
}
