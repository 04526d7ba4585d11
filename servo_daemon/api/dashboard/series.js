// The points of one chart: bounded in number, ordered in time, with gaps where nothing was known.

const POINTS = 1500; // more than a chart on a wide screen has pixels

export class Series {
  /** @param {number} windowS seconds of time that are kept */
  constructor(windowS) {
    this.windowS = windowS;
    this.spacingS = windowS / POINTS;
    this.gapS = Math.max(3, 5 * this.spacingS);
    this.columns = [[], [], [], [], []]; // time, value, value − 2σ, value + 2σ, truth
  }

  /** A document of the history; buckets may lie farther apart than points that arrive one by one. */
  load(document) {
    this.gapS = Math.max(this.gapS, 2.5 * document.period_s);
    document.time.forEach((time, k) => {
      const value = drawn(document.value[k], document.status?.[k] ?? null);
      this.push(Date.parse(time) / 1000, value, document.std[k], document.truth?.[k] ?? null);
    });
  }

  get lastTime() {
    return this.columns[0].at(-1) ?? -Infinity;
  }

  /** One point; one that is not newer than the last is ignored. The last is replaced while the one before is still close. */
  push(time, value, std = null, truth = null) {
    const [times] = this.columns;
    const n = times.length;
    if (!(time > this.lastTime)) return;
    if (n > 0 && time - times[n - 1] > this.gapS) this.#add([times[n - 1] + 1e-3, null, null, null, null]);
    else if (n > 1 && time - times[n - 2] < this.spacingS) for (const column of this.columns) column.pop();
    const half = value !== null && std !== null ? 2 * std : null;
    this.#add([time, value, half === null ? null : value - half, half === null ? null : value + half, truth]);
    this.#trim(time - this.windowS);
  }

  #add(row) {
    this.columns.forEach((column, k) => column.push(row[k]));
  }

  /** Forget what has left the window, a good many at a time. */
  #trim(oldest) {
    const [times] = this.columns;
    if (times[0] >= oldest - 0.1 * this.windowS) return;
    const keep = times.findIndex((t) => t >= oldest);
    for (const column of this.columns) column.splice(0, keep);
  }
}

/** Values that are the nominal one because nothing is known yet, or that are void, are no line to draw. */
const DRAWN = new Set(["tracking", "unexcited", "at_bound", "fixed"]);
export const drawn = (value, status) => (status === null || DRAWN.has(status) ? value : null);

/** What of the series should be seen: all values and truths, the band where it is not wildly wider than usual. */
export function extent(columns, from, to, extra = []) {
  const [times, values, lows, highs, truths] = columns;
  const widths = [];
  let low = Infinity;
  let high = -Infinity;
  const see = (y) => {
    if (y === null || !Number.isFinite(y)) return;
    low = Math.min(low, y);
    high = Math.max(high, y);
  };
  const first = times.findIndex((t) => t >= from);
  let end = first < 0 ? 0 : times.length;
  while (end > 0 && times[end - 1] > to) end--;
  const start = Math.max(0, first);
  for (let k = start; k < end; k++) {
    see(values[k]);
    see(truths[k]);
    if (highs[k] !== null) widths.push(highs[k] - values[k]);
  }
  extra.forEach(see);
  if (low > high) return null;
  const usual = widths.length ? widths.sort((a, b) => a - b)[widths.length >> 1] : 0;
  for (let k = start; k < end; k++) {
    if (highs[k] === null) continue;
    const width = Math.min(highs[k] - values[k], 3 * usual);
    see(values[k] - width);
    see(values[k] + width);
  }
  const size = Math.max(Math.abs(low), Math.abs(high));
  const span = Math.max(high - low, 1e-4 * size, 1e-12);
  const margin = 0.08 * span + 0.5 * (span - (high - low));
  return [low - margin, high + margin];
}
