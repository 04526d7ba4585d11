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

/** Parameters of which the same is said, in one line: "R, L, K: no trend". */
function groups(names, parameters, isNear) {
  const said = new Map();
  for (const name of names) {
    const { text, remark } = parameters[name];
    const rest = text.startsWith(`${name}: `) ? text.slice(name.length) : null;
    const key = JSON.stringify([rest ?? text, remark, isNear(name)]);
    const group = said.get(key);
    if (group && rest !== null) group.names.push(name);
    else said.set(key, { names: [name], rest, text, remark, near: isNear(name) });
  }
  return [...said.values()];
}

/** Those whose limit is near first; the others as they are. */
function items({ parameters, near }) {
  const isNear = (name) => near.includes(name);
  const names = Object.keys(parameters).sort((a, b) => isNear(b) - isNear(a));
  const told = ({ names: alike, rest, text }) => (alike.length > 1 ? alike.join(", ") + rest : text);
  return groups(names, parameters, isNear).map((group) => item(told(group), group.remark, group.near));
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
