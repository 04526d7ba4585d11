// Recordings that the daemon keeps: the list, the button that asks for one, and the curves of the page as a table.

import { download, drivePath, get, post } from "./api.js";

const byId = (id) => document.getElementById(id);
const RECORD_S = 60;
const RECORD_TIMEOUT_MS = 35_000;
const POINTS = 20_000;
const SHOWN = 8;
const size = (bytes) => (bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`);
const PERIOD_MS = 1; // times are written in milliseconds

/** Which recording an event is in; undefined: none. */
export function captureOf(event, captures) {
  const time = Date.parse(event.time);
  const holds = ({ start, end }) => Date.parse(start) - PERIOD_MS <= time && time <= Date.parse(end) + PERIOD_MS;
  const holding = captures.filter(holds);
  return holding.find((capture) => capture.kind === event.kind) ?? holding[0];
}

/** @param {string} text of the link */
export function captureLink(capture, text) {
  const link = document.createElement("a");
  link.href = capture.url.replace(/^\//, "");
  link.download = capture.file;
  link.textContent = text;
  link.title = `${capture.file}, ${size(capture.bytes)}`;
  return link;
}

function item(capture) {
  const seconds = Math.round((Date.parse(capture.end) - Date.parse(capture.start)) / 1000);
  const when = new Date(capture.start).toLocaleString("sv-SE");
  const why = capture.kind === "request" ? "recorded by hand" : capture.kind.replaceAll("_", " ");
  const made = document.createElement("li");
  made.append(captureLink(capture, when), ` ${why}, ${seconds} s, ${size(capture.bytes)}`);
  return made;
}

/** One drive's; made anew when another drive is shown. */
export class Recordings {
  /**
   * @param {() => void} changed told when there are others
   * @param {() => {from: number, to: number, names: string[]}} shown what the charts show
   */
  constructor(drive, changed, shown) {
    this.drive = drive;
    this.changed = changed;
    this.captures = [];
    this.closed = false;
    this.record = () => this.#record();
    this.table = () => this.#download(shown());
    byId("record").addEventListener("click", this.record);
    byId("download").addEventListener("click", this.table);
    this.#say("");
    byId("captures").replaceChildren();
  }

  close() {
    this.closed = true;
    byId("record").removeEventListener("click", this.record);
    byId("download").removeEventListener("click", this.table);
  }

  async poll() {
    const { captures, reason } = await get(`${drivePath(this.drive)}/captures`);
    if (this.closed) return;
    byId("record").disabled = reason !== null;
    if (reason) this.#say(`No recordings: ${reason}.`);
    const known = this.captures.map(({ id }) => id).join();
    if (captures.map(({ id }) => id).join() === known) return;
    this.captures = captures;
    byId("captures").replaceChildren(...captures.slice(-SHOWN).reverse().map(item));
    this.changed();
  }

  async #record() {
    byId("record").disabled = true;
    this.#say("Writing…");
    try {
      const capture = await post(`${drivePath(this.drive)}/captures`, { seconds: RECORD_S }, RECORD_TIMEOUT_MS);
      if (this.closed) return;
      this.#say("");
      byId("record-note").append("Recorded: ", captureLink(capture, capture.file));
    } catch (error) {
      if (!this.closed) this.#say(`Not recorded: ${error.message}`);
    }
    byId("record").disabled = false;
    if (!this.closed) await this.poll().catch(() => {});
  }

  async #download({ from, to, names }) {
    const [start, end] = [from, to].map((seconds) => new Date(seconds * 1000).toISOString());
    const query = new URLSearchParams({ parameter: names.join(), start, end, points: POINTS });
    try {
      await download(`${drivePath(this.drive)}/history?${query}`, "text/csv", `${this.drive}.csv`);
      this.#say("");
    } catch (error) {
      this.#say(`Not downloaded: ${error.message}`);
    }
  }

  #say(text) {
    if (byId("record-note").textContent !== text) byId("record-note").textContent = text;
  }
}
