// How the parameters age, in the daemon's own sentences.

import { drivePath, get } from "./api.js";

const byId = (id) => document.getElementById(id);
const EVERY_MS = 60_000; // the daemon finds trends every hour; a page that is opened early has the first in a minute

function item(text, note, near) {
  const made = document.createElement("li");
  made.textContent = text;
  if (near) made.className = "near";
  if (note) made.append(Object.assign(document.createElement("p"), { className: "quiet", textContent: note }));
  return made;
}

/** Those whose limit is near first; the others as they are. */
function items({ parameters, near }) {
  const isNear = (name) => near.includes(name);
  const names = Object.keys(parameters).sort((a, b) => isNear(b) - isNear(a));
  return names.map((name) => item(parameters[name].text, parameters[name].remark, isNear(name)));
}

/** One drive's card; made anew when another drive is shown. */
export class TrendCard {
  constructor(drive) {
    this.drive = drive;
    this.closed = false;
    byId("trend").hidden = true;
    this.#poll();
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
  }

  async #poll() {
    try {
      const trend = await get(`${drivePath(this.drive)}/trend`);
      if (this.closed) return;
      byId("trend").hidden = false;
      byId("trends").replaceChildren(...items(trend));
      byId("trend-why").textContent = trend.reason ? `No trends yet: ${trend.reason}.` : "";
    } catch (error) {
      console.info(`trend of ${this.drive}: ${error.message}`);
    }
    if (!this.closed) this.timer = setTimeout(() => this.#poll(), EVERY_MS);
  }
}
