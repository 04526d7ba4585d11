// Following a drive's estimates: by server-sent events that never give up, in as many tabs as a browser has connections for.

import { PREFIX, drivePath, get } from "./api.js";

const AGAIN_MS = 2000;
const ASK_MS = 1000;
const ANSWERED_MS = 100; // within which the other tabs tell that they are there
const GONE_MS = 3 * ASK_MS; // a tab that says nothing for so long has crashed
// Browsers open six connections to a host (HTTP/1.1), all tabs together, and a stream keeps its own: two remain for documents.
const MOST_STREAMS = 4;

/** A place among the tabs of this browser: those that came first may keep a connection open. */
class Place {
  constructor() {
    this.mine = { id: crypto.getRandomValues(new Uint32Array(1))[0], since: Date.now() };
    this.others = new Map();
    this.channel = new BroadcastChannel("servo-daemon streams");
    this.channel.onmessage = ({ data }) => this.#hear(data);
    this.say();
  }

  /** Told once a second: who is silent is taken for gone. */
  say(gone = false) {
    this.channel.postMessage({ ...this.mine, gone });
  }

  get granted() {
    const now = performance.now();
    const before = ({ since, id, heard }) =>
      now - heard < GONE_MS && (since < this.mine.since || (since === this.mine.since && id < this.mine.id));
    return [...this.others.values()].filter(before).length < MOST_STREAMS;
  }

  release() {
    this.say(true);
    this.channel.close();
  }

  #hear({ id, since, gone }) {
    if (gone) {
      this.others.delete(id);
      return;
    }
    if (!this.others.has(id)) this.say();
    this.others.set(id, { id, since, heard: performance.now() });
  }
}

/** Follows one drive: by a stream, without a place for one by a question a second, and not at all in a hidden tab. */
export class Stream {
  /**
   * @param {string} drive
   * @param {{opened: () => void, estimates: (document: object) => void, lost: () => void}} listener
   */
  constructor(drive, listener) {
    this.path = drivePath(drive);
    this.listener = listener;
    this.closed = false;
    this.place = null;
    this.source = null;
    this.asked = false;
    this.look = () => this.#look();
    this.rest = () => this.#rest();
    document.addEventListener("visibilitychange", this.look);
    window.addEventListener("pageshow", this.look);
    window.addEventListener("pagehide", this.rest);
    this.#look();
  }

  close() {
    this.closed = true;
    document.removeEventListener("visibilitychange", this.look);
    window.removeEventListener("pageshow", this.look);
    window.removeEventListener("pagehide", this.rest);
    this.#rest();
  }

  #look() {
    clearTimeout(this.timer);
    if (this.closed) return;
    if (document.hidden) {
      this.#rest();
      return;
    }
    this.timer = setTimeout(() => this.#turn(), this.place === null ? ANSWERED_MS : ASK_MS);
    this.place ??= new Place();
  }

  /** Once a second. */
  async #turn() {
    this.place.say();
    if (this.place.granted) {
      if (this.source === null) this.#connect();
    } else {
      this.#disconnect();
      await this.#ask();
    }
    this.#look();
  }

  #connect() {
    this.asked = false;
    this.source = new EventSource(`${PREFIX}${this.path}/stream`);
    this.source.addEventListener("open", () => this.listener.opened());
    this.source.addEventListener("estimates", (event) => this.listener.estimates(JSON.parse(event.data)));
    this.source.addEventListener("error", () => {
      this.listener.lost();
      // The browser tries again by itself after a broken connection, but not after an answer it did not like.
      if (this.source?.readyState === EventSource.CLOSED) this.again = setTimeout(() => this.#disconnect(), AGAIN_MS);
    });
  }

  #disconnect() {
    clearTimeout(this.again);
    this.source?.close();
    this.source = null;
  }

  async #ask() {
    try {
      const estimates = await get(`${this.path}/estimates`);
      if (this.closed) return;
      if (this.asked) this.listener.estimates(estimates);
      else this.listener.opened();
      this.asked = true;
    } catch {
      this.asked = false;
      if (!this.closed) this.listener.lost();
    }
  }

  #rest() {
    clearTimeout(this.timer);
    this.#disconnect();
    this.asked = false;
    this.place?.release();
    this.place = null;
  }
}
