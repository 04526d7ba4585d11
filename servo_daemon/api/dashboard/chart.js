// One small chart: value with its 95 % band (± 2 σ), the simulated truth dashed, and what is drawn over them.
/* global uPlot */

import { fixed, stepDecimals } from "./format.js";
import { colour, drawEvents, drawLines, drawMarks } from "./overlays.js";
import { extent } from "./series.js";
import { STEPS_S, tickSpace, tickText } from "./times.js";

const LEAST_HEIGHT = 100;
const NEAR = 8; // pixels from an event's mark at which a click means it
const LEAST_DRAG = 8; // pixels that the pointer is pulled before it is meant as a span of time
const FONT = "11px system-ui, sans-serif";
export const charts = new Set();

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.forEach((c) => c.plot.redraw()));

/** Ticks on the chart's own scale, with the decimals that their distance needs. */
const tickTexts = (chart) => (_plot, ticks, _axis, _space, step) => {
  const decimals = stepDecimals(step / chart.scale.factor);
  return ticks.map((tick) => fixed(tick / chart.scale.factor, decimals));
};

/** Times; not where the edge of the chart would cut the text. */
const timeTexts = (plot, ticks, _axis, _space, step) => {
  const { min, max } = plot.scales.x;
  const right = plot.bbox.width / uPlot.pxRatio - tickSpace(min, max) / 4;
  return ticks.map((tick) => (plot.valToPos(tick, "x") < right ? tickText(tick, step, min, max) : ""));
};

const axisWidth = (_plot, texts) => 14 + 6.3 * Math.max(3, ...(texts ?? []).map((text) => text.length));

function options(chart, width) {
  const grid = { stroke: colour("--grid"), width: 1 };
  const axis = { stroke: colour("--ink-2"), font: FONT, grid, ticks: { show: false } };
  const line = (name, more) => ({ stroke: colour(name), width: 1.5, points: { show: false }, ...more });
  return {
    width,
    height: chart.height,
    padding: [8, 10, 0, 0],
    legend: { show: false },
    cursor: {
      drag: { x: true, y: false, setScale: false, dist: LEAST_DRAG },
      bind: { dblclick: () => () => chart.onZoom(null) },
      points: { size: 5 },
      sync: { key: "servo", filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
      y: false,
    },
    scales: { x: { time: true, auto: false }, y: { auto: false } },
    axes: [
      { ...axis, incrs: STEPS_S, space: (_plot, _axis, min, max) => tickSpace(min, max), size: 22, gap: 4, values: timeTexts },
      { ...axis, space: 24, size: axisWidth, gap: 4, values: tickTexts(chart) },
    ],
    series: [
      {},
      line("--estimate", { width: 2 }),
      line("--band-edge", { width: 0 }),
      line("--band-edge", { width: 0 }),
      line("--truth", { dash: [5, 4] }),
    ],
    bands: [{ series: [3, 2], fill: colour("--band") }],
    hooks: {
      draw: [(plot) => drawLines(plot, chart.lines), (plot) => drawMarks(plot, chart.marks), (plot) => drawEvents(plot, chart.events)],
      setCursor: [(plot) => chart.pointed(plot)],
      setSelect: [(plot) => chart.selected(plot)],
    },
  };
}

export class Chart {
  /**
   * @param {HTMLElement} element where it is put; its width is followed
   * @param {(time: number|null, row: (number|null)[]) => void} onPoint told what is under the pointer, null when it left
   * @param {(span: {from: number, to: number}|null) => void} onZoom told what span has been drawn up, null to go back
   * @param {(event: object) => void} onEvent told which event's mark was clicked
   */
  constructor(element, onPoint, onZoom, onEvent) {
    this.element = element;
    this.onPoint = onPoint;
    this.onZoom = onZoom;
    this.scale = { factor: 1, unit: "" };
    this.lines = [];
    this.marks = [];
    this.events = []; // {time: s since 1970, event}
    this.plot = new uPlot(options(this, element.clientWidth || 300), [[], [], [], [], []], element);
    this.resizer = new ResizeObserver(([entry]) => {
      const width = Math.floor(entry.contentRect.width);
      if (width > 0 && (width !== this.plot.width || this.height !== this.plot.height)) this.plot.setSize({ width, height: this.height });
    });
    this.resizer.observe(element);
    let pressed = 0;
    this.plot.over.addEventListener("mousedown", ({ clientX }) => (pressed = clientX));
    this.plot.over.addEventListener("click", ({ clientX, offsetX }) => {
      if (Math.abs(clientX - pressed) < LEAST_DRAG) this.#clicked(offsetX, onEvent);
    });
    charts.add(this);
  }

  get height() {
    return Math.max(LEAST_HEIGHT, this.element.clientHeight);
  }

  #clicked(x, onEvent) {
    const distance = ({ time }) => Math.abs(this.plot.valToPos(time, "x") - x);
    const near = this.events.filter((mark) => distance(mark) < NEAR).sort((a, b) => distance(a) - distance(b));
    if (near.length) onEvent(near[0].event);
  }

  /**
   * Show a Series between two times, on this scale.
   * @param {{name: string, value: number, colour: string, dash?: number[], must?: boolean}[]} lines `must`: to be seen
   */
  update(series, from, to, scale, lines = []) {
    this.scale = scale;
    this.lines = lines;
    const range = this.#range(series.columns, from, to);
    if (range[0] === range[1]) range[1] += scale.factor;
    this.plot.batch(() => {
      this.plot.setData(series.columns, false);
      this.plot.setScale("x", { min: from, max: to });
      this.plot.setScale("y", { min: range[0], max: range[1] });
    });
  }

  /** A line is part of the picture unless that would squeeze the estimate to less than half of it. */
  #range(columns, from, to) {
    const seen = this.lines.filter((line) => line.must).map((line) => line.value);
    let range = extent(columns, from, to, seen);
    for (const { value, must } of this.lines) {
      if (must) continue;
      if (range === null) {
        range = [value * 0.9, value * 1.1].sort((a, b) => a - b);
        continue;
      }
      const wide = extent(columns, from, to, [...seen, value]);
      if (wide[1] - wide[0] > 2 * (range[1] - range[0])) continue;
      range = wide;
      seen.push(value);
    }
    return range ?? [-1, 1];
  }

  selected(plot) {
    const { left, width } = plot.select;
    if (width < LEAST_DRAG) return;
    const [from, to] = [left, left + width].map((x) => plot.posToVal(x, "x"));
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.onZoom({ from, to });
  }

  pointed(plot) {
    const k = plot.cursor.idx;
    const times = plot.data[0];
    if (k === null || k === undefined || plot.cursor.left < 0 || times[k] === undefined) this.onPoint(null, []);
    else this.onPoint(times[k], plot.data.map((column) => column[k]));
  }

  destroy() {
    charts.delete(this);
    this.resizer.disconnect();
    this.plot.destroy();
  }
}
