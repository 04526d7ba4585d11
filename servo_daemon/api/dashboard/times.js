// Times in the browser's zone, with the date where it is needed.

const two = (n) => String(n).padStart(2, "0");
const DAY_S = 86400;

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
  const text = clock(tick, step < 60);
  return needsDate(min, max) ? `${date(tick).slice(5)} ${text}` : text;
}

const needsDate = (min, max) => date(min) !== date(max) || date(max) !== date(Date.now() / 1000);

/** Pixels from one tick to the next at least, so that their texts do not touch. */
export const tickSpace = (min, max) => (needsDate(min, max) ? (max - min < 600 ? 125 : 105) : 80);
