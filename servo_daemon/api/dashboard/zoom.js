// A span of time that the user has drawn up in one of the charts, shown in all of them until it is reset.

import { drivePath, get } from "./api.js";
import { Series } from "./series.js";
import { moment } from "./times.js";

const byId = (id) => document.getElementById(id);
export const POINTS = 1500; // of a series that are asked for
const LEAST_S = 0.1; // one row of the history
const BACK_S = 20 * 31_557_600; // as long as anything is kept
/** What the buttons make of the span shown: the share by which it is moved, the factor by which it is stretched. */
const MOVES = { back: [-0.5, 1], on: [0.5, 1], in: [0, 0.5], out: [0, 2] };

/** A span moved by `by` of its length and stretched around its middle; null where it reaches the present: the live window. */
function moved({ from, to }, by, factor) {
  const now = Date.now() / 1000;
  const half = Math.min(BACK_S, (to - from) * factor) / 2;
  const middle = (from + to) / 2 + by * (to - from);
  if (by > 0 && middle + half >= now) return null;
  return { from: middle - half, to: Math.min(middle + half, Math.max(now, to)) };
}

export class Zoom {
  /**
   * @param {Map<string, object>} cards whose `zoomed` series is set here
   * @param {() => void} changed told when there is something else to draw
   * @param {() => {from: number, to: number}} shown what the charts show now
   */
  constructor(drive, cards, changed, shown) {
    this.drive = drive;
    this.cards = cards;
    this.changed = changed;
    this.span = null;
    this.reset = () => this.show(null);
    this.key = (event) => event.key === "Escape" && this.reset();
    byId("unzoom").addEventListener("click", this.reset);
    document.addEventListener("keydown", this.key);
    this.move = ({ currentTarget }) => this.show(moved(shown(), ...MOVES[currentTarget.dataset.move]));
    this.buttons = [...document.querySelectorAll("[data-move]")];
    this.buttons.forEach((button) => button.addEventListener("click", this.move));
  }

  close() {
    this.show(null);
    byId("unzoom").removeEventListener("click", this.reset);
    document.removeEventListener("keydown", this.key);
    this.buttons.forEach((button) => button.removeEventListener("click", this.move));
  }

  /** @param {{from: number, to: number}|null} span s since 1970; null: back to the window up to now */
  async show(span) {
    if (span !== null && span.to - span.from < LEAST_S) return;
    this.span = span;
    this.cards.forEach((card) => (card.zoomed = null));
    byId("zoomed").hidden = span === null;
    if (span !== null) byId("zoom-text").textContent = `${moment(span.from)} – ${moment(span.to)}`;
    this.changed();
    if (span === null) return;
    await Promise.all([...this.cards].map(([name, card]) => this.#load(name, card, span)));
    this.changed();
  }

  /** More detail than the window has; what is there already is shown until then. */
  async #load(name, card, span) {
    const [start, end] = [span.from, span.to].map((seconds) => new Date(seconds * 1000).toISOString());
    const query = new URLSearchParams({ parameter: name, start, end, points: POINTS });
    const series = new Series(span.to - span.from);
    try {
      series.load(await get(`${drivePath(this.drive)}/history?${query}`));
    } catch (error) {
      console.info(`history of ${name}: ${error.message}`);
      return;
    }
    if (this.span === span && series.columns[0].length > 0) card.zoomed = series;
  }
}
