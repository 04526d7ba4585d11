// One small chart: value with its ±2σ band, the simulated truth dashed, nominal as a thin line, RF+GRNN as diamonds.
/* global uPlot */

import { clock, decimalsFor, fixed } from "./format.js";
import { extent } from "./series.js";

const HEIGHT = 150;
const FONT = "11px system-ui, sans-serif";
const style = getComputedStyle(document.documentElement);
const colour = (name) => () => style.getPropertyValue(name).trim();
export const charts = new Set();

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.forEach((c) => c.plot.redraw()));

/** Ticks on the chart's own scale, with the decimals that their distance needs. */
const tickTexts = (chart) => (_plot, ticks, _axis, _space, step) => {
  const decimals = decimalsFor(step / chart.scale.factor, 1);
  return ticks.map((tick) => fixed(tick / chart.scale.factor, decimals));
};

/** Clock times; not where the edge of the chart would cut the text. */
const timeTexts = (plot, ticks) => {
  const right = plot.bbox.width / uPlot.pxRatio - 20;
  return ticks.map((tick) => (plot.valToPos(tick, "x") < right ? clock(tick) : ""));
};

const axisWidth = (_plot, texts) => 14 + 6.3 * Math.max(3, ...(texts ?? []).map((text) => text.length));

function options(chart, width) {
  const grid = { stroke: colour("--grid"), width: 1 };
  const axis = { stroke: colour("--ink-2"), font: FONT, grid, ticks: { show: false } };
  const line = (name, more) => ({ stroke: colour(name), width: 1.5, points: { show: false }, ...more });
  return {
    width,
    height: HEIGHT,
    padding: [8, 10, 0, 0],
    legend: { show: false },
    cursor: { drag: { x: false, y: false }, points: { size: 5 }, sync: { key: "servo" }, y: false },
    scales: { x: { time: true, auto: false }, y: { auto: false } },
    axes: [
      { ...axis, space: 80, size: 22, gap: 4, values: timeTexts },
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
    hooks: { draw: [(plot) => chart.drawNominal(plot), (plot) => chart.drawMarks(plot)], setCursor: [(plot) => chart.pointed(plot)] },
  };
}

export class Chart {
  /**
   * @param {HTMLElement} element where it is put; its width is followed
   * @param {(time: number|null, row: (number|null)[]) => void} onPoint told what is under the pointer, null when it left
   */
  constructor(element, onPoint = () => {}) {
    this.element = element;
    this.onPoint = onPoint;
    this.scale = { factor: 1, unit: "" };
    this.nominal = null;
    this.marks = [];
    this.plot = new uPlot(options(this, element.clientWidth || 300), [[], [], [], [], []], element);
    this.resizer = new ResizeObserver(([entry]) => {
      const width = Math.floor(entry.contentRect.width);
      if (width > 0 && width !== this.plot.width) this.plot.setSize({ width, height: HEIGHT });
    });
    this.resizer.observe(element);
    charts.add(this);
  }

  /** Show a Series between two times, on this scale. */
  update(series, from, now, scale, nominal = null) {
    this.scale = scale;
    this.nominal = nominal;
    const range = this.#range(series.columns, from) ?? (nominal === null ? [-1, 1] : [nominal * 0.9, nominal * 1.1]);
    range.sort((a, b) => a - b);
    if (range[0] === range[1]) range[1] += scale.factor;
    this.plot.batch(() => {
      this.plot.setData(series.columns, false);
      this.plot.setScale("x", { min: from, max: now });
      this.plot.setScale("y", { min: range[0], max: range[1] });
    });
  }

  /** Nominal is part of the picture unless that would squeeze the estimate to less than half of it. */
  #range(columns, from) {
    const tight = extent(columns, from);
    if (tight === null || this.nominal === null) return tight;
    const wide = extent(columns, from, [this.nominal]);
    return wide[1] - wide[0] <= 2 * (tight[1] - tight[0]) ? wide : tight;
  }

  /** A thin line, or an arrow that says where it would be. */
  drawNominal(plot) {
    if (this.nominal === null) return;
    const { ctx, bbox } = plot;
    const { min, max } = plot.scales.y;
    const ratio = uPlot.pxRatio;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour("--nominal")();
    if (this.nominal >= min && this.nominal <= max) {
      const y = Math.round(plot.valToPos(this.nominal, "y", true)) + 0.5;
      ctx.lineWidth = ratio;
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    } else {
      const above = this.nominal > max;
      ctx.font = `${11 * ratio}px system-ui, sans-serif`;
      ctx.textAlign = "right";
      ctx.textBaseline = above ? "top" : "bottom";
      const y = above ? bbox.top + 3 * ratio : bbox.top + bbox.height - 3 * ratio;
      ctx.fillText(above ? "nominal ↑" : "nominal ↓", bbox.left + bbox.width - 4 * ratio, y);
    }
    ctx.restore();
  }

  /** What the learned model said of its windows: {time, value, std, applied}. */
  drawMarks(plot) {
    const { ctx, bbox, scales } = plot;
    const size = 4 * uPlot.pxRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.setLineDash([]); // as the last line left it
    ctx.strokeStyle = ctx.fillStyle = colour("--learned")();
    for (const mark of this.marks) {
      if (mark.time < scales.x.min) continue;
      const x = plot.valToPos(mark.time, "x", true);
      const at = (value) => plot.valToPos(value, "y", true);
      ctx.globalAlpha = 0.4;
      ctx.lineWidth = uPlot.pxRatio;
      ctx.beginPath();
      ctx.moveTo(x, at(mark.value - 2 * mark.std));
      ctx.lineTo(x, at(mark.value + 2 * mark.std));
      ctx.stroke();
      const y = at(mark.value);
      ctx.globalAlpha = 1;
      ctx.lineWidth = 1.5 * uPlot.pxRatio;
      ctx.beginPath();
      ctx.moveTo(x, y - size);
      ctx.lineTo(x + size, y);
      ctx.lineTo(x, y + size);
      ctx.lineTo(x - size, y);
      ctx.closePath();
      if (mark.applied) ctx.fill();
      else ctx.stroke();
    }
    ctx.restore();
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
