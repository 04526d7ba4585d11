// What a diagnosis found missing in the balance of torques: its size, and its course over the speed.

import { decimalsFor, fixed, scaleFor } from "./format.js";
import { colour } from "./overlays.js";

const HEIGHT = 150;
const FONT = "11px system-ui, sans-serif";
/* global uPlot */

const short = (value) => fixed(value, decimalsFor(Math.abs(value), 2));
const sized = (value, unit) => {
  const scale = scaleFor(unit, value);
  return `${short(value / scale.factor)} ${scale.unit}`;
};

/** In words; "" where the diagnosis is silent about it. */
export function unmodelledText(missing) {
  const [name, row] = Object.entries(missing ?? {})[0] ?? [];
  if (typeof row?.before_rms !== "number") return "";
  const share = row.working_rms > 0 ? `, ${short((100 * row.before_rms) / row.working_rms)} % of what the motor works with` : "";
  const rest = typeof row.after_rms === "number" ? `; with what was found ${sized(row.after_rms, row.unit)}` : "";
  return `Unmodelled ${name}: ${sized(row.before_rms, row.unit)} rms${share}${rest}.`;
}

/** Curves over one x: a row for each point, in the order of x. */
function columns(curves) {
  const rows = curves.flatMap(({ speed, value }, k) => speed.map((x, i) => [x, k, value[i]])).sort((a, b) => a[0] - b[0]);
  const made = [rows.map(([x]) => x), ...curves.map(() => new Array(rows.length).fill(undefined))];
  rows.forEach(([, k, y], i) => (made[k + 1][i] = y));
  return made;
}

/** Draws it; the plot, to be destroyed, or null where there is nothing to draw. */
export function drawUnmodelled(element, missing) {
  const [name, row] = Object.entries(missing ?? {})[0] ?? [];
  const { before, after, unit } = row?.over_speed ?? {};
  if (!before) return null;
  const curves = [before, after].filter(Boolean);
  const scale = scaleFor(row.unit, row.before_rms);
  const data = columns(curves).map((column, k) => (k ? column.map((y) => (typeof y === "number" ? y / scale.factor : y)) : column));
  const grid = { stroke: colour("--grid"), width: 1 };
  const values = (_plot, ticks, _axis, _space, step) => ticks.map((tick) => fixed(tick, decimalsFor(step, 1)));
  const axis = { values, stroke: colour("--ink-2"), font: FONT, labelFont: FONT, grid, ticks: { show: false }, labelSize: 16 };
  const line = (name, dash) => ({ stroke: colour(name), width: 2, dash, points: { show: false } });
  element.setAttribute("role", "img");
  element.setAttribute("aria-label", `${unmodelledText(missing)} Over the speed, solid: the model as it is${after ? "; dashed: with what was found" : ""}`);
  return new uPlot({
    width: Math.max(200, element.clientWidth),
    height: HEIGHT,
    legend: { show: false },
    cursor: { show: false },
    scales: { x: { time: false } },
    axes: [
      { ...axis, size: 22, label: `speed, ${unit}` },
      { ...axis, size: 44, label: `${name}, ${scale.unit}` },
    ],
    series: [{}, line("--truth"), ...(after ? [line("--estimate", [5, 4])] : [])],
  }, data, element);
}
