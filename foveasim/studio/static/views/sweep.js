// Sweep: results over one or two settings, with charts and a table whose points can be applied.

import { brief } from "/web/colours.js";
import { around, change, make, notice } from "/web/page_parts.js";
import { addFiles } from "../chart_files.js";
import { CurveChart, listenToPoints } from "../charts.js";
import { buttonOf, selectOf } from "../elements.js";
import { presentOf } from "../number_settings.js";
import { HINT, HeatMap, ParetoChart } from "../sweep_charts.js";
import { SweepForm } from "../sweep_form.js";
import { SweepPoints } from "../sweep_points.js";
import { SweepTable } from "../sweep_table.js";

// Largest number of curves of a family.
const MOST_CURVES = 6;
const START = "Choose settings and results, then Run. The settings of the page stay as they are.";
const RUNNING = "Later changes of the settings do not affect this sweep.";

// At most a number of items, evenly distributed, with the first and the last.
/** @type {<T>(items: T[], most: number) => T[]} */
const some = (items, most) => (items.length <= most ? items
  : Array.from({ length: most }, (_, i) => items[Math.round((i * (items.length - 1)) / (most - 1))]));

// Curves of a result: one, or one for each of some values of the second setting.
function curvesOf(points, j) {
  const [first, second] = points.axes, { subject, unit } = points.measures[j], values = points.result(j);
  const n = second?.values.length ?? 1;
  const at = (row) => first.values.map((_, i) => values[i * n + row] ?? NaN);
  const curve = (label, row) => ({ label, name: "curve-" + row, unit_x: first.unit, unit_y: unit === "fraction" ? "" : unit,
    x: first.values, y: at(row), points: first.values.map((_, i) => i * n + row) });
  if (!second) return [curve(subject, 0)];
  return some([...second.values.keys()], MOST_CURVES).map((row) =>
    curve(second.label + " " + brief(second.values[row]) + (second.unit ? " " + second.unit : ""), row));
}

export function create(root, studio) {
  const form = new SweepForm(studio, { changed: () => chart?.draw() });
  const text = make("p", START, { className: "quiet", id: "sweep-text", role: "status" });
  const bar = make("progress", undefined, { ariaLabel: "Points of the sweep", hidden: true });
  const frame = make("div", undefined, { className: "chart", id: "sweep" }), display = selectOf([], "Chart");
  const stop = buttonOf("Cancel", () => studio.connection.send({ do: "stop_sweep" }), { ariaLabel: "Cancel the sweep" });
  const file = buttonOf("Sweep file", () => studio.connection.send({ do: "sweep_file" }),
    { title: "YAML file for the command foveasim sweep, which gives the same results" });
  const row = around("div", { className: "condition", hidden: true }, display, stop, file);
  root.append(around("div", "sweep-panel", form.root, around("div", "sweep-results", text, bar, row, frame)));
  /** @type {any} */
  let chart = null;
  /** @type {SweepPoints | null} */
  let points = null;
  // What is shown, and of which sweep.
  const current = { what: "", sweep: "" };
  /** @type {number | null} */
  let asked = null;

  const present = () => (points && studio.state ? points.axes.map(({ key }) => {
    const row = [...studio.controls.rows.values()].find(({ control }) => control.key === key);
    return presentOf(studio.state, { key, default: row?.control.default });
  }) : []);
  const choose = (k) => {
    if (points) studio.connection.send({ do: "assign", values: points.axes.map(({ key }, i) => ({ key, value: points?.settings(k)[i] })) });
  };

  // Curves with marks at the points; the lines mark the present settings.
  function createCurves(where, j) {
    const [first] = points?.axes ?? [];
    const found = new CurveChart(where, { nameX: first?.label, nameY: points?.measures[j].label, label: "Sweep",
      log: first?.is_log ? "x" : "", hasZero: false });
    found.canvas.classList.add("choosable");
    listenToPoints(found, choose);
    const use = () => {
      const curves = curvesOf(points, j), n = points?.axes[1]?.values.length ?? 1;
      /** @type {any} */
      const marks = curves.flatMap(({ name, x, y, points: of }) =>
        x.map((v, i) => ({ x: v, y: y[i], name, kind: points?.saturated?.[of[i]] ? "open" : "point" })));
      /** @type {any} */
      const lines = [{ x: present()[0], label: "", of: "" }];
      found.use(curves, { marks: marks.filter((mark) => Number.isFinite(mark.y)), lines,
        note: (n > curves.length ? curves.length + " of " + n + " values. " : "")
          + (points?.saturated?.some(Boolean) ? "Rings: some photosites are saturated. " : "") + HINT });
    };
    use();
    return { use, draw: () => found.draw(), rows: () => points?.rows() ?? [], paint: (target) => found.paint(target) };
  }

  function createChart(where, what) {
    const [kind, j] = what.split("-");
    if (kind === "curves") return createCurves(where, Number(j));
    if (!points) return null;
    const Kind = kind === "map" ? HeatMap : ParetoChart;
    const made = new Kind(where, { points, present: present(), choose, result: Number(j), isSmaller: () => form.isSmaller });
    made.draw();
    return { use: () => made.use(points, present()), draw: () => made.draw(), rows: () => made.rows(),
      paint: (target) => made.paint(target) };
  }

  // The table has the drawing of the first chart as its picture.
  function createTable() {
    const table = new SweepTable(frame, choose), use = () => table.use(points);
    use();
    return { use, draw: () => {}, rows: () => points?.rows() ?? [],
      paint: (target) => createChart(make("div"), display.options[0].value)?.paint(target) };
  }

  function list() {
    const { axes = [], measures = [] } = points ?? {}, kinds = axes.length === 2 ? ["map", "curves"] : ["curves"];
    const charts = measures.flatMap(({ subject }, j) =>
      kinds.map((kind) => [kind + "-" + j, (kind === "map" ? "Map: " : "Curves: ") + subject]));
    const all = [...charts, ...(measures.length === 2 ? [["pareto", "Pareto chart"]] : []), ["table", "Table"]], chosen = display.value;
    display.replaceChildren(...all.map(([value, label]) => new Option(label, value)));
    display.value = all.some(([value]) => value === chosen) ? chosen : all[0][0];
  }

  function show(isNew) {
    if (!points) return;
    if (isNew || current.what !== display.value) {
      current.what = display.value;
      frame.replaceChildren();
      chart = current.what === "table" ? createTable() : createChart(frame, current.what);
    } else chart.use();
  }

  // Shows the sweep of the server with its results so far.
  /** @param {SweepMessage} message */
  function receive(message) {
    const { id, axes, results: wanted } = message, sweep = JSON.stringify([id, axes, wanted]), isNew = sweep !== current.sweep;
    current.sweep = sweep;
    points = new SweepPoints(message);
    if (isNew) list();
    show(isNew);
    tell(message);
  }

  /** @param {SweepMessage} message */
  function tell({ state, n_points: n, points: done, problem, n_failed: nFailed, isLost }) {
    const missing = nFailed ? " " + nFailed + " without a result: " + problem : "";
    const part = done.length + " of " + n + " points.";
    const lost = "The session ended after " + part;
    const words = { running: RUNNING, stopped: "Cancelled after " + part, lost, done: n + " points." };
    // Screen readers announce changes of this text, not each point.
    change(text, { textContent: words[state] + missing });
    change(bar, { hidden: state !== "running", max: n, value: done.length });
    change(stop, { hidden: state !== "running" });
    bar.title = done.length + " of " + n + " points";
    row.hidden = false;
    file.hidden = Boolean(isLost); // the server does not know the sweep
  }

  form.run.addEventListener("click", () => {
    const { settings, results: wanted, problem } = form.read();
    if (problem) { notice(problem); return; }
    asked = studio.connection.send({ do: "sweep", settings, results: wanted });
  });
  display.addEventListener("change", () => show(false));
  addFiles(root, "Sweep", () => chart);
  // The measures are those of the requirements.
  studio.views.need("requirements", true);
  return {
    form,
    get points() { return points; },
    draw: () => chart?.draw(),
    onState() {
      form.follow(studio.controls, studio.state, studio.views.parts.requirements?.about.measures);
      if (!points && studio.page.sweep) receive(studio.page.sweep);
      else chart?.use();
    },
    show: receive,
    // Explains why the sweep was not accepted.
    fail(message) { if (message.id === asked && asked !== null) text.textContent = message.text; },
  };
}
