// One drive on the page: loads its history, follows its stream, fills the gap after a lost connection, and draws.

import { drivePath, get } from "./api.js";
import { renderAlarms, ringing } from "./alarms.js";
import { ParameterCard, StateCard } from "./cards.js";
import { DiagnosisPanel } from "./diagnosis.js";
import { Recordings } from "./captures.js";
import { openEvent, renderEvents, renderFacts, renderNote } from "./facts.js";
import { Scope } from "./scope.js";
import { Stream } from "./stream.js";
import { TrendCard } from "./trend.js";
import { POINTS, Zoom } from "./zoom.js";

const WARNING = new Set(["alarm", "margin_low", "limit_near"]); // whose marks are red
const LEAST_S = 15; // charts show at least so much time, also of a drive that has just started
const DRAW_MS = 200; // numbers that change faster cannot be read
export const POLL_MS = 2000; // what must be seen sooner is in the stream
const CAPTURED_WITHIN_MS = 40_000; // after an event its recording is written: half a minute and the writing
const CAPTURED_WITHIN = CAPTURED_WITHIN_MS / POLL_MS; // polls
const ASK_EVERY = 5; // of these

export class DriveView {
  /** @param {(live: boolean) => void} onLink told when the stream runs and when it is lost */
  constructor(name, windowS, onLink) {
    this.name = name;
    this.windowS = windowS;
    this.onLink = onLink;
    this.cards = new Map();
    const changed = () => (this.dirty = this.document !== null);
    this.zoom = new Zoom(name, this.cards, changed, () => this.#span());
    this.diagnosis = new DiagnosisPanel(name);
    this.trend = new TrendCard(name);
    this.scope = new Scope(name);
    this.recordings = new Recordings(name, () => this.#showEvents(), () => ({ ...this.#span(), names: [...this.cards.keys()] }));
    this.document = null;
    this.truth = {};
    this.limits = [];
    this.events = [];
    this.lastEvent = null;
    this.now = null;
    this.pending = null; // documents that arrive while history is loading
    this.drawnAt = 0;
    this.dirty = false;
    this.closed = false; // answers may still arrive then
    this.eventMarks = [];
    this.captureSoon = ASK_EVERY; // polls within which there may be new recordings; at first only those there are
    this.frame = requestAnimationFrame((time) => this.#draw(time));
    this.stream = new Stream(name, {
      opened: () => this.#opened(),
      estimates: (document) => (this.pending ? this.pending.push(document) : this.#receive(document)),
      lost: () => !this.closed && onLink(false),
    });
  }

  close() {
    this.closed = true;
    this.diagnosis.close();
    this.trend.close();
    this.scope.close();
    this.recordings.close();
    this.zoom.close();
    this.stream.close();
    cancelAnimationFrame(this.frame);
    this.cards.forEach((card) => card.destroy());
    this.cards.clear();
    renderAlarms([], [], []);
  }

  /** What the stream does not carry: truth, diagnosis, events. */
  async poll() {
    const drive = await get(drivePath(this.name));
    if (this.closed) return drive;
    this.truth = drive.truth ?? {};
    this.limits = drive.limits;
    document.getElementById("truth-key").hidden = drive.truth === undefined;
    document.getElementById("simulated").hidden = drive.truth === undefined;
    document.getElementById("limit-key").hidden = drive.limits.length === 0;
    await this.diagnosis.poll(drive.last_event !== this.lastEvent, drive.model);
    if (drive.last_event !== this.lastEvent) {
      const { events } = await get(`${drivePath(this.name)}/events`);
      if (this.closed) return drive;
      this.events = events;
      this.lastEvent = drive.last_event;
      this.#showEvents();
      if (Date.parse(drive.time) - Date.parse(drive.last_event) < CAPTURED_WITHIN_MS) this.captureSoon = CAPTURED_WITHIN;
    }
    if (this.captureSoon > 0 && this.captureSoon-- % ASK_EVERY === 0) await this.recordings.poll();
    return drive;
  }

  #showEvents() {
    renderEvents(this.events, this.recordings.captures);
    const marks = this.events.map((event) => ({ time: Date.parse(event.time) / 1000, warns: WARNING.has(event.kind), event }));
    this.cards.forEach((card) => (card.chart.events = marks));
    this.eventMarks = marks;
    this.dirty = this.document !== null;
  }

  /** History first: of the whole window, or after a lost connection of what was missed. */
  async #opened() {
    if (this.pending) return;
    this.pending = [];
    try {
      const drive = await this.poll();
      const estimates = await get(`${drivePath(this.name)}/estimates`);
      this.#match(estimates);
      await Promise.all(drive.history.names.map((name) => this.#load(name)));
      this.#receive(estimates);
    } catch (error) {
      console.info(`history of ${this.name}: ${error.message}`);
    } finally {
      const pending = this.pending;
      this.pending = null;
      pending.forEach((document) => this.#receive(document));
      if (!this.closed) this.onLink(true);
    }
  }

  async #load(name) {
    const card = this.cards.get(name);
    if (!card) return;
    const last = card.series.lastTime;
    const since = Number.isFinite(last) ? { start: new Date(last * 1000 + 1).toISOString() } : { window: `${this.windowS}s` };
    const query = new URLSearchParams({ parameter: name, ...since, points: POINTS });
    const history = await get(`${drivePath(this.name)}/history?${query}`);
    if (this.closed) return;
    card.series.load(history);
    renderNote(history.note);
  }

  #receive(estimates) {
    if (this.closed) return;
    this.document = estimates;
    this.#match(estimates);
    const time = estimates.time === null ? null : Date.parse(estimates.time) / 1000;
    if (time !== null) this.now = time;
    for (const [name, parameter] of Object.entries(estimates.parameters)) {
      this.cards.get(name).receive(time, parameter, this.truth[name] ?? null);
    }
    if (time !== null) this.#learn(time, estimates.estimators.grnn);
    for (const [name, value] of Object.entries(estimates.state)) this.cards.get(name).receive(time, value);
    this.dirty = true;
  }

  /** A new window of the learned model becomes a mark on the curves. */
  #learn(time, grnn) {
    if (grnn === undefined) return;
    const { window_end_s: end = null, applied = 0 } = grnn.detail;
    const before = this.window; // undefined: the last window ended before this page was opened, nobody knows when
    this.window = { end, applied };
    if (before === undefined || end === null || end === before.end) return;
    const entered = applied > before.applied;
    for (const [name, parameter] of Object.entries(grnn.parameters)) {
      if (parameter.value !== null) this.cards.get(name)?.learned(time, parameter, entered);
    }
    document.getElementById("learned-key").hidden = false;
  }

  /** Cards follow the model: effects may be added while the daemon runs. */
  #match(estimates) {
    if (this.closed) return;
    const wanted = new Map([
      ...Object.keys(estimates.parameters).map((name) => [name, ParameterCard]),
      ...Object.keys(estimates.state).map((name) => [name, StateCard]),
    ]);
    for (const [name, card] of this.cards) {
      if (wanted.has(name)) continue;
      card.destroy();
      this.cards.delete(name);
    }
    for (const [name, Kind] of wanted) {
      if (this.cards.has(name)) continue;
      const card = new Kind(name, this.windowS);
      card.attach(document.getElementById(Kind === StateCard ? "state" : "parameters"), (span) => this.zoom.show(span), openEvent);
      card.chart.events = this.eventMarks;
      this.cards.set(name, card);
    }
  }

  /** What the charts show: what was drawn up, else the window up to now, as far as anything is known. */
  #span() {
    const now = this.now ?? Date.now() / 1000;
    const first = Math.min(...[...this.cards.values()].map((card) => card.series.columns[0][0] ?? now));
    return this.zoom.span ?? { from: Math.max(now - this.windowS, Math.min(first, now - LEAST_S)), to: now };
  }

  #draw(time) {
    this.frame = requestAnimationFrame((next) => this.#draw(next));
    if (!this.dirty || time - this.drawnAt < DRAW_MS) return;
    this.dirty = false;
    this.drawnAt = time;
    renderFacts(this.document);
    const alarms = ringing(this.document);
    renderAlarms(alarms, this.events, this.limits);
    const { from, to } = this.#span();
    for (const card of this.cards.values()) {
      card.warn?.(this.limits, alarms);
      card.draw(from, to);
    }
  }
}
