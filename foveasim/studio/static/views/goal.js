// Goal seek: the value of a setting at which a result meets a condition, with the curve of results.

import { make, notice } from "/web/page_parts.js";
import { addFiles } from "../chart_files.js";
import { CurveChart } from "../charts.js";
import { ConditionForm } from "../condition_form.js";
import { buttonOf } from "../elements.js";
import { percent } from "../problems.js";
import { SettingSelect, isWide } from "../number_settings.js";
import { figure } from "./requirements.js";

export function create(root, studio) {
  const form = new ConditionForm(studio.page), setting = new SettingSelect("Setting to change"), solve = buttonOf("Solve", seek);
  const text = make("p", "Choose a setting and the result that it must give.", { className: "quiet", id: "goal-text", role: "status" });
  const frame = make("div", undefined, { className: "chart", id: "goal" });
  form.root.prepend(setting.root);
  form.root.append(solve);
  root.append(form.root, text, frame);
  addFiles(root, "Goal seek", () => chart);
  /** @type {CurveChart | null} */
  let chart = null;
  // Number of the last message, until it is answered.
  /** @type {number | null} */
  let asked = null;
  form.value.addEventListener("keydown", (event) => { if (event.key === "Enter") seek(); });
  function seek() {
    const { requirement, problem } = form.read();
    if (problem) { notice(problem); return; }
    text.textContent = "seeking…";
    asked = studio.connection.send({ do: "seek", key: setting.root.value, requirement });
  }
  // The measures are those of the requirements.
  studio.views.need("requirements", true);
  return {
    form,
    draw: () => chart?.draw(),
    onState() {
      setting.follow(studio.controls);
      const about = studio.views.parts.requirements?.about;
      if (about) form.use(about.measures);
      if (asked === null || (studio.state.id ?? 0) < asked) return;
      text.textContent = studio.state.id === asked ? Object.values(studio.state.errors)[0] || "Cancelled." : "";
      asked = null;
    },
    // Shows the answer of the server.
    show(found) {
      asked = null;
      text.textContent = (found.is_present ? "Already met: " : "") + found.label + " of " + figure(found.value, found.unit) + ": "
        + found.subject + " " + figure(found.result, found.result_unit)
        + (found.saturated_fraction ? " (" + percent(found.saturated_fraction) + " saturated)" : "");
      const points = found.curve.filter((point) => Number.isFinite(point[1])), xs = points.map((point) => point[0]);
      frame.replaceChildren();
      const isLog = isWide(xs[0], xs[xs.length - 1]);
      chart = new CurveChart(frame, { nameX: found.label, nameY: found.measure, label: "Goal seek", log: isLog ? "x" : "" });
      const curve = { label: found.subject, name: "", unit_x: found.unit, unit_y: found.result_unit, x: xs,
        y: points.map((point) => point[1]) };
      /** @type {any} */
      const marks = [{ x: found.value, y: found.result, name: "", kind: "dot" }];
      const limits = found.limits.flatMap((limit, k) => (limit === null ? [] : [{ ...curve, label: ["at least", "at most"][k],
        x: [xs[0], xs[xs.length - 1]], y: [limit, limit], isLimit: true }]));
      chart.use([curve, ...limits], { marks });
    },
  };
}
