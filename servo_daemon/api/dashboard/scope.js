// The scope: the last samples, each of them, on request or again and again, up to now or about a trigger.
/* global uPlot */

import { drivePath, get } from "./api.js";
import { charts } from "./chart.js";
import { fixed, stepDecimals } from "./format.js";
import { colour } from "./overlays.js";
import { signalUnit, signalWords } from "./signals.js";

const byId = (id) => document.getElementById(id);
const HEIGHT = 150;
const AXIS = 48; // the same in all plots, so that their times stand above each other
const EVERY_MS = 400; // between two looks while it runs
const FONT = "11px system-ui, sans-serif";
const BEFORE = 0.2; // share of the picture before the trigger

/** Seconds on an axis whose whole span is `span`. */
function timeTicks(ticks, step) {
  const decimals = stepDecimals(step * 1e3);
  return ticks.map((tick) => fixed(tick * 1e3, decimals));
}

function options(width, title, level) {
  const grid = { stroke: colour("--grid"), width: 1 };
  const axis = { stroke: colour("--ink-2"), font: FONT, grid, ticks: { show: false }, gap: 4 };
  const texts = (_plot, ticks, _axis, _space, step) => ticks.map((tick) => fixed(tick, stepDecimals(step)));
  return {
    width,
    height: HEIGHT,
    title,
    padding: [4, 10, 0, 0],
    legend: { show: false },
    cursor: { y: false, drag: { x: true, y: false }, sync: { key: "scope" } },
    scales: { x: { time: false } },
    axes: [
      { ...axis, size: 20, values: (_plot, ticks, _axis, _space, step) => timeTicks(ticks, step) },
      { ...axis, space: 24, size: AXIS, values: texts },
    ],
    series: [{}, { stroke: colour("--estimate"), width: 1.5, points: { size: 4 } }],
    hooks: { draw: [(plot) => drawTrigger(plot, level)] },
  };
}

/** The moment of the trigger, and in its channel the level. */
function drawTrigger(plot, level) {
  if (level === undefined) return;
  const { ctx, bbox } = plot;
  const line = (x0, y0, x1, y1) => {
    ctx.beginPath();
    ctx.moveTo(x0, y0);
    ctx.lineTo(x1, y1);
    ctx.stroke();
  };
  ctx.save();
  ctx.strokeStyle = colour("--truth")();
  ctx.setLineDash([4, 4]);
  const x = plot.valToPos(0, "x", true);
  line(x, bbox.top, x, bbox.top + bbox.height);
  const { min, max } = plot.scales.y;
  const y = level === null || level < min || level > max ? null : plot.valToPos(level, "y", true);
  if (y !== null) line(bbox.left, y, bbox.left + bbox.width, y);
  ctx.restore();
}

/** One drive's; made anew when another drive is shown. */
export class Scope {
  constructor(drive) {
    this.drive = drive;
    this.form = byId("scope-form").elements;
    this.closed = false;
    this.running = false;
    this.plots = [];
    this.take = (event) => {
      event.preventDefault();
      this.#run(false);
      this.#look(null);
    };
    this.run = () => this.#run(!this.running);
    this.changed = () => this.#enable();
    byId("scope-form").addEventListener("submit", this.take);
    byId("scope-run").addEventListener("click", this.run);
    byId("scope-form").addEventListener("change", this.changed);
    this.resizer = new ResizeObserver(() => this.plots.forEach((plot) => plot.setSize({ width: this.#width, height: HEIGHT })));
    this.resizer.observe(byId("scope-plots"));
    this.form.trigger.length = 1;
    this.form.trigger.value = "";
    this.#clear();
    this.#say("");
    this.#enable();
    get(`${drivePath(drive)}/samples?seconds=0.001`).then((found) => this.#offer(found), () => {});
  }

  close() {
    this.closed = true;
    this.#run(false);
    this.resizer.disconnect();
    byId("scope-form").removeEventListener("submit", this.take);
    byId("scope-run").removeEventListener("click", this.run);
    byId("scope-form").removeEventListener("change", this.changed);
    this.#clear();
  }

  get #width() {
    return Math.max(200, byId("scope-plots").clientWidth);
  }

  #clear() {
    this.plots.forEach((plot) => {
      charts.delete(plot.entry);
      plot.destroy();
    });
    this.plots = [];
    byId("scope-plots").hidden = true;
  }

  #say(text) {
    if (byId("scope-note").textContent !== text) byId("scope-note").textContent = text;
  }

  #enable() {
    const { trigger, level, edge } = this.form;
    level.disabled = edge.disabled = trigger.value === "";
    byId("scope-unit").textContent = signalUnit(trigger.value);
    this.since = null;
  }

  /** The channels that there are, as triggers. */
  #offer({ signals }) {
    const { trigger } = this.form;
    const names = Object.keys(signals);
    if (this.closed || names.length === 0 || names.length === trigger.length - 1) return;
    trigger.length = 1;
    trigger.append(...names.map((name) => new Option(signalWords(name), name)));
  }

  #run(on) {
    this.running = on;
    this.since = null;
    clearTimeout(this.timer);
    byId("scope-run").setAttribute("aria-pressed", on);
    byId("scope-run").textContent = on ? "Stop" : "Run";
    if (on) this.#again();
  }

  async #again() {
    await this.#look(this.since);
    if (this.running) this.timer = setTimeout(() => this.#again(), EVERY_MS);
  }

  /** @param {number|null} since device time of the last trigger that was shown, s */
  async #look(since) {
    const { seconds, trigger, level, edge } = this.form;
    const query = new URLSearchParams({ seconds: seconds.value });
    if (trigger.value) {
      for (const [key, value] of Object.entries({ trigger: trigger.value, level: level.value || "0", edge: edge.value, before: BEFORE })) query.set(key, value);
      if (since !== null) query.set("since", since);
    }
    try {
      const found = await get(`${drivePath(this.drive)}/samples?${query}`);
      if (!this.closed) this.#show(found);
    } catch (error) {
      this.#say(`No snapshot: ${error.message}`);
    }
  }

  #show(found) {
    this.#offer(found);
    const { time_s: times, trigger } = found;
    if (times.length === 0) {
      const waits = trigger && found.last_s !== null;
      this.#say(waits ? "No such crossing in the last ten seconds." : "No samples are kept (ring_s = 0), or none have come yet.");
      return;
    }
    this.since = trigger?.time_s ?? null;
    const zero = trigger?.time_s ?? times.at(-1);
    const shown = times.map((time) => time - zero);
    this.#draw(shown, found.signals, trigger);
    const rate = times.length > 1 ? (times.length - 1) / (times.at(-1) - times[0]) : 0;
    const cut = found.shortened ? "; more samples than a snapshot holds, cut short" : "";
    this.#say(`${times.length} samples at ${fixed(rate, rate < 100 ? 1 : 0)} Hz; ms from ${trigger ? "the trigger" : "the last sample"}${cut}`);
  }

  /** Plots are kept while the channels stay, so that a running picture does not flicker. */
  #draw(times, signals, trigger) {
    const key = JSON.stringify([Object.keys(signals), trigger?.channel, trigger?.level]);
    const box = byId("scope-plots");
    box.hidden = false;
    if (this.key !== key || this.plots.length === 0) {
      this.#clear();
      box.hidden = false;
      this.key = key;
      this.plots = Object.keys(signals).map((name) => {
        const level = trigger ? (trigger.channel === name ? trigger.level : null) : undefined;
        const plot = new uPlot(options(this.#width, `${signalWords(name)}, ${signalUnit(name)}`, level), [[], []], box);
        plot.entry = { plot }; // drawn anew when the colours change
        charts.add(plot.entry);
        return plot;
      });
    }
    Object.values(signals).forEach((values, k) => this.plots[k].setData([times, values]));
    box.setAttribute("aria-label", `${Object.keys(signals).map(signalWords).join(", ")} over ${fixed((times.at(-1) - times[0]) * 1e3, 0)} ms`);
  }
}
