// Talking to the daemon: documents by fetch, the estimates by server-sent events that never give up.

const PREFIX = "api/v1";
const AGAIN_MS = 2000;
const TIMEOUT_MS = 5000;
const DOWNLOAD_TIMEOUT_MS = 30_000; // of a year of curves from a slow disk

/** A document; throws with the problem's own words where there is one. */
export const get = (path) => ask(path, { method: "GET" }, TIMEOUT_MS);

/** The same for what changes something; `body` is sent as JSON. */
export function post(path, body = undefined, timeoutMs = TIMEOUT_MS) {
  const content = body === undefined ? {} : { body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  return ask(path, { method: "POST", ...content }, timeoutMs);
}

/** Saves an answer as a file. */
export async function download(path, accept, name) {
  const response = await answer(path, { headers: { Accept: accept } }, DOWNLOAD_TIMEOUT_MS);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await response.blob());
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), TIMEOUT_MS);
}

const ask = async (path, options, timeoutMs) => (await answer(path, options, timeoutMs)).json();

async function answer(path, options, timeoutMs) {
  const response = await fetch(`${PREFIX}${path}`, { ...options, cache: "no-store", signal: AbortSignal.timeout(timeoutMs) });
  if (response.ok) return response;
  const problem = await response.json().catch(() => ({}));
  throw Object.assign(new Error(problem.detail ?? `HTTP ${response.status}`), { document: problem });
}

export const drivePath = (name) => `/drives/${encodeURIComponent(name)}`;

/** Follows one drive's stream. */
export class Stream {
  /**
   * @param {string} drive
   * @param {{opened: () => void, estimates: (document: object) => void, lost: () => void}} listener
   */
  constructor(drive, listener) {
    this.url = `${PREFIX}${drivePath(drive)}/stream`;
    this.listener = listener;
    this.closed = false;
    this.#connect();
  }

  #connect() {
    if (this.closed) return;
    this.source = new EventSource(this.url);
    this.source.addEventListener("open", () => this.listener.opened());
    this.source.addEventListener("estimates", (event) => this.listener.estimates(JSON.parse(event.data)));
    this.source.addEventListener("error", () => {
      this.listener.lost();
      // The browser tries again by itself after a broken connection, but not after an answer it did not like.
      if (this.source.readyState === EventSource.CLOSED) this.timer = setTimeout(() => this.#connect(), AGAIN_MS);
    });
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    this.source.close();
  }
}
