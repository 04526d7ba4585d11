// A curve of the last 30 days in a line of the table of all drives.

import { drivePath, get } from "./api.js";
import { percent, plain } from "./format.js";
import { drawn } from "./series.js";

const WINDOW = "30d";
const POINTS = 60;
const EVERY_MS = 600_000; // a point of such a curve is half a day
const AGAIN_MS = 20_000; // at least
const [WIDTH, HEIGHT] = [120, 24];
const cache = new Map(); // drive and parameter: {svg, due}
const wanted = new Map(); // by the same key: what is to be asked for
let asking = false;

/** Known values and their times. */
function known({ time, value, status }) {
  const points = time.map((t, k) => [Date.parse(t), drawn(value[k], status?.[k] ?? null)]);
  return points.filter(([, y]) => y !== null);
}

function curve(parameter, points) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  svg.setAttribute("class", "spark");
  svg.setAttribute("role", "img");
  const [times, values] = [0, 1].map((k) => points.map((point) => point[k]));
  const [first, last] = [values[0], values.at(-1)];
  const change = first ? `, ${percent((last - first) / Math.abs(first))}` : "";
  svg.setAttribute("aria-label", `${parameter} over the last 30 days: from ${plain(first)} to ${plain(last)}${change}`);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const span = Math.max(high - low, 0.02 * Math.max(Math.abs(low), Math.abs(high)), 1e-30); // noise of 1 % is no mountain
  const middle = (low + high) / 2;
  const [from, to] = [times[0], Math.max(times.at(-1), times[0] + 1)];
  const at = ([t, y]) => `${(2 + ((WIDTH - 4) * (t - from)) / (to - from)).toFixed(1)},${(HEIGHT / 2 - ((HEIGHT - 4) * (y - middle)) / span).toFixed(1)}`;
  const line = document.createElementNS("http://www.w3.org/2000/svg", "polyline");
  line.setAttribute("points", points.map(at).join(" "));
  svg.append(line);
  return svg;
}

/** When there may be more to draw: a short curve gets its next point when the bucket after its last one begins. */
export function due({ time, period_s }, points) {
  const next = Date.parse(time.at(-1)) + 1000 * period_s || 0;
  const wait = points.length > POINTS / 2 ? EVERY_MS : Math.max(next - Date.now(), AGAIN_MS);
  return Date.now() + Math.min(wait, EVERY_MS);
}

/** Asks for one curve after the other: a table of many drives does not ask for all at once. */
async function pump() {
  asking = true;
  for (const [key, { element, drive, parameter }] of wanted) {
    wanted.delete(key);
    const query = new URLSearchParams({ parameter, window: WINDOW, points: POINTS });
    try {
      const history = await get(`${drivePath(drive)}/history?${query}`);
      const points = known(history);
      const svg = points.length > 1 ? curve(parameter, points) : null;
      cache.set(key, { svg, due: due(history, points) });
      put(element, parameter, svg);
    } catch {
      cache.set(key, { svg: cache.get(key)?.svg ?? null, due: Date.now() + AGAIN_MS });
    }
  }
  asking = false;
}

function put(element, parameter, svg) {
  if (svg && element.lastChild !== svg) element.replaceChildren(`${parameter} `, svg);
}

/** Puts the curve of a drive's parameter into an element, at once where it is known, else when it has come. */
export function sparkline(element, drive, parameter) {
  const key = `${drive} ${parameter}`;
  const kept = cache.get(key);
  put(element, parameter, kept?.svg);
  if (kept && kept.due > Date.now()) return;
  wanted.set(key, { element, drive, parameter });
  if (!asking) pump();
}
