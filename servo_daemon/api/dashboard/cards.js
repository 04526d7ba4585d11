// The cards: one for each parameter, one for each state channel.

import { Chart } from "./chart.js";
import { decimalsFor, fixed, pair, percent, plain, scaleFor } from "./format.js";
import { fullScreen } from "./fullscreen.js";
import { Series, drawn } from "./series.js";
import { signalUnit, signalWords } from "./signals.js";
import { moment } from "./times.js";

const PARAMETER_WORDS = {
  R: "resistance", L: "inductance", K: "torque constant", J: "inertia", B: "viscous friction", J_d: "load inertia",
  Tc: "Coulomb friction", TL: "load torque", Tg: "gravity torque", Ts: "static friction", R_th: "thermal resistance",
  C_th: "heat capacity",
};
const BADGES = {
  tracking: "● tracking", estimating: "◔ estimating", unexcited: "◌ unexcited", at_bound: "▲ at bound",
  fixed: "■ fixed", invalid: "✕ invalid",
};

const copy = (id) => document.getElementById(id).content.firstElementChild.cloneNode(true);
function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Why a parameter is not tracked, and for how long it has not been. */
function heldSince(p) {
  if (!p.reason) return "";
  return p.age_s >= 1 ? `${p.reason} (last known ${Math.round(p.age_s)} s ago)` : p.reason;
}

/** J_d as J with a subscript. */
function symbol(name) {
  const [letter, ...below] = name.split("_");
  if (below.length === 0) return [letter];
  const sub = document.createElement("sub");
  sub.textContent = below.join(" ");
  return [letter, sub];
}

class Card {
  constructor(template, name, windowS) {
    this.name = name;
    this.element = copy(template);
    this.element.dataset.name = name;
    this.series = new Series(windowS);
    this.zoomed = null; // the series of a span of time that was drawn up
    this.scale = null;
    this.pointed = null;
    this.chart = null; // made when the card is in the page and has a width
  }

  find(selector) {
    return this.element.querySelector(selector);
  }

  get shown() {
    return this.zoomed ?? this.series;
  }

  attach(grid, onZoom, onEvent) {
    grid.append(this.element);
    fullScreen(this.find(".full"), this.element, this.find("h3").textContent.trim());
    const onPoint = (time, row) => {
      this.pointed = time === null ? null : { time, row };
      this.render();
    };
    this.find(".chart").setAttribute("aria-label", `${this.name} over time; nothing known yet`);
    this.chart = new Chart(this.find(".chart"), onPoint, onZoom, onEvent);
  }

  destroy() {
    this.chart?.destroy();
    this.element.remove();
  }
}

export class ParameterCard extends Card {
  constructor(name, windowS) {
    super("parameter-card", name, windowS);
    this.latest = null;
    this.truth = null;
    this.windowS = windowS;
    this.marks = [];
    this.limits = []; // of [drive.limits], those of this parameter
    this.alarm = null; // the name of the limit whose alarm rings
    this.find(".symbol").replaceChildren(...symbol(name));
    write(this.find(".words"), PARAMETER_WORDS[name] ?? "");
  }

  receive(time, parameter, truth) {
    this.latest = parameter;
    this.truth = truth;
    if (time !== null) this.series.push(time, drawn(parameter.value, parameter.status), parameter.std, truth);
  }

  /** Its limits, and the names of all alarms that ring. */
  warn(limits, names) {
    this.limits = limits.filter((limit) => limit.parameter === this.name);
    this.alarm = this.limits.find((limit) => names.includes(limit.name))?.name ?? null;
  }

  /** The learned model's estimate of a window that ended at `time`. */
  learned(time, { value, std }, applied) {
    this.marks.push({ time, value, std: std ?? 0, applied });
    while (this.marks.length && this.marks[0].time < time - this.windowS) this.marks.shift();
  }

  draw(from, to) {
    if (this.latest === null) return;
    this.render();
    this.chart.marks = this.marks;
    this.chart.update(this.shown, from, to, this.scale, this.#lines());
    const label = `${this.name} over time; now ${this.find(".value").textContent.replace(/\s+/g, " ").trim()}`;
    this.find(".chart").setAttribute("aria-label", label);
  }

  #lines() {
    const { nominal } = this.latest;
    const lines = this.limits.map(({ name, value }) => ({
      name, value, colour: "--bad", dash: [6, 3], must: name === this.alarm,
    }));
    return nominal === null ? lines : [{ name: "nominal", value: nominal, colour: "--nominal" }, ...lines];
  }

  render() {
    const p = this.latest;
    if (p === null) return;
    const value = p.value ?? p.nominal;
    this.scale = scaleFor(p.unit, value ?? 0, this.scale);
    const shown = pair(p.value, p.std, this.scale);
    write(this.find(".number"), shown.value);
    write(this.find(".std"), shown.std);
    write(this.find(".unit"), this.scale.unit);
    this.#compare(p);
    const badge = this.find(".badge");
    badge.dataset.status = p.status;
    this.element.dataset.status = p.status;
    this.element.classList.toggle("alarm", this.alarm !== null);
    write(badge, this.alarm ? `▲ alarm ${this.alarm}` : (BADGES[p.status] ?? p.status));
    write(this.find(".reason"), this.pointed ? this.#pointedText() : heldSince(p));
  }

  #compare(p) {
    const number = (value) => plain(value / this.scale.factor); // on the scale, and in the unit, of the large number
    write(this.find(".nominal"), p.nominal === null ? "no nominal value" : `nominal ${number(p.nominal)}`);
    const known = p.value !== null && p.nominal !== null && p.nominal !== 0 && p.status !== "estimating";
    write(this.find(".deviation"), known ? percent((p.value - p.nominal) / Math.abs(p.nominal)) : "");
    write(this.find(".true"), this.truth === null ? "" : `true ${number(this.truth)}`);
  }

  #pointedText() {
    const { time, row } = this.pointed;
    const std = row[3] === null || row[1] === null ? null : (row[3] - row[1]) / 2;
    const shown = row[1] === null ? { value: "no value", std: "" } : pair(row[1], std, this.scale);
    return `${moment(time)}: ${shown.value} ${shown.std} ${row[1] === null ? "" : this.scale.unit}`;
  }
}

export class StateCard extends Card {
  constructor(name, windowS) {
    super("state-card", name, windowS);
    this.unit = signalUnit(name);
    this.value = null;
    this.largest = 0;
    write(this.find(".words"), signalWords(name));
  }

  receive(time, value) {
    this.value = value;
    if (time !== null) this.series.push(time, value);
  }

  draw(from, to) {
    const values = this.shown.columns[1];
    this.largest = values.reduce((most, v) => Math.max(most, Math.abs(v ?? 0)), 0);
    this.render();
    this.chart.update(this.shown, from, to, this.scale);
    const name = this.find(".words").textContent;
    this.find(".chart").setAttribute("aria-label", `${name} over time; now ${this.find(".number").textContent}`);
  }

  /** The scale follows the largest value in the window, so the digits of a moving value stay where they are. */
  render() {
    this.scale = scaleFor(this.unit, this.largest, this.scale);
    const value = this.pointed ? this.pointed.row[1] : this.value;
    const decimals = decimalsFor(this.largest / this.scale.factor, 4);
    write(this.find(".number"), value === null ? fixed(null) : fixed(value / this.scale.factor, decimals));
    write(this.find(".unit"), this.scale.unit + (this.pointed ? ` at ${moment(this.pointed.time)}` : ""));
  }
}
