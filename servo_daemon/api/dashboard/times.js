// Times in the browser's zone, with the date where it is needed.

const two = (n) => String(n).padStart(2, "0");
const DAY_S = 86400;

/** Distances of two ticks, s; none more than 2.5 times the one before, so that a small chart has two of them. */
export const STEPS_S = [
  ...[0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30],
  ...[1, 2, 3, 5, 10, 15, 30].map((minutes) => 60 * minutes),
  ...[1, 2, 3, 4, 6, 8, 12].map((hours) => 3600 * hours),
  ...[1, 2, 3, 5, 7, 10, 15, 30, 60, 90, 180, 365, 730, 1825].map((days) => DAY_S * days),
];

/** 14:02:31 */
export function clock(seconds, withSeconds = true) {
  const t = new Date(seconds * 1000);
  return `${two(t.getHours())}:${two(t.getMinutes())}${withSeconds ? `:${two(t.getSeconds())}` : ""}`;
}

/** 2026-11-21 */
export function date(seconds) {
  const t = new Date(seconds * 1000);
  return `${t.getFullYear()}-${two(t.getMonth() + 1)}-${two(t.getDate())}`;
}

/** With the date unless it is today's. */
export const moment = (seconds) =>
  date(seconds) === date(Date.now() / 1000) ? clock(seconds) : `${date(seconds)} ${clock(seconds)}`;

/** What a tick of an axis says: `step` seconds between two ticks, the axis from `min` to `max`. */
export function tickText(tick, step, min, max) {
  if (step >= 300 * DAY_S) return date(tick).slice(0, 4);
  if (step >= 27 * DAY_S) return date(tick).slice(0, 7);
  if (step >= DAY_S) return date(tick);
  const text = clock(tick, step < 60) + (step < 1 ? `.${Math.floor((tick % 1) * 10 + 1e-6)}` : "");
  return needsDate(min, max) ? `${date(tick).slice(5)} ${text}` : text;
}

/** Of an axis that spans days, or of another day than today. */
const needsDate = (min, max) => date(min) !== date(max) || date(max) !== date(Date.now() / 1000);

/** Pixels from one tick to the next at least, so that their texts do not touch. */
export const tickSpace = (min, max) => (needsDate(min, max) ? (max - min < 600 ? 125 : 105) : 80);
