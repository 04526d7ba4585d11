// Talking to the daemon: documents by fetch.

export const PREFIX = "api/v1";
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
