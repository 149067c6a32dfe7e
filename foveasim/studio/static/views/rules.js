// Design rules: their results, and violations on the map.

import { around, change, make, notice } from "/web/page_parts.js";
import { RulesList } from "/web/rules_list.js";
import { buttonOf, selectOf } from "../elements.js";
import { RepairDialog } from "../repair_dialog.js";

export function create(root, { panes: { b }, fly, ask, connection }) {
  const openDialog = () => dialog.open(connection.send({ do: "preview_repairs" }));
  const repair = buttonOf("Repair…", openDialog, { id: "repair" }), repaired = make("p", "", { className: "quiet", id: "repaired" });
  const elements = { select: selectOf([], "Design rule"), note: make("p", "", "quiet"),
    list: make("ol", undefined, "violations"), more: make("button", "Show more", { type: "button" }) };
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
  root.append(around("div", { id: "rules" }, repair, repaired, ...Object.values(elements)));
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
