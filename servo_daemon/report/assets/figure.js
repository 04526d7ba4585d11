// One figure: uPlot's options from our description, the legend's buttons and values.

const root = document.documentElement;
const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();
const COLOURS = 6;
const shade = (k) => `--c${1 + (k % COLOURS)}`;
/** Size in px and opacity (hexadecimal) of the points of a cloud of n. */
const dot = (n) => (n > 5000 ? [2.5, "78"] : n > 600 ? [3, "80"] : [5, "d0"]);

/** Lines show their samples once these are far enough apart (uPlot's choice), iterations always. */
function pointOptions(kind, stroke) {
  if (kind === "scatter") return { show: false };
  return { size: 5, width: 0, stroke, fill: stroke, ...(kind === "iterations" && { show: true, size: 7 }) };
}

function seriesOptions(entry, k, spec, columns) {
  const name = shade(k);
  const stroke = () => colour(name);
  if (entry.style === "dots") {
    const [size, opacity] = dot(columns[entry.main].reduce((n, y) => n + (y !== null), 0));
    const fill = () => colour(name) + opacity;
    return { paths: () => null, points: { show: true, size, width: 0, stroke: fill, fill } };
  }
  return {
    stroke,
    width: spec.kind === "scatter" ? 2.5 : 1.5,
    dash: entry.style === "dashed" ? [6, 4] : undefined,
    spanGaps: entry.style === "joined" || spec.kind === "scatter",
    paths: entry.style === "steps" ? uPlot.paths.stepped({ align: 1 }) : undefined,
    points: pointOptions(spec.kind, stroke),
  };
}

function allSeries(spec, columns, entries) {
  const edge = { stroke: "transparent", width: 0, points: { show: false } };
  const series = columns.map(() => ({ ...edge }));
  series[0] = {};
  entries.forEach((entry, k) => (series[entry.main] = seriesOptions(entry, k, spec, columns)));
  return series;
}

const WHOLE = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000]; // steps between ticks of an axis of whole numbers
const axisWidth = (_plot, texts) => 12 + 6.4 * Math.max(3, ...(texts ?? []).map((text) => text.length));

function axes(spec) {
  const grid = { stroke: () => colour("--grid"), width: 1 };
  const axis = { stroke: () => colour("--ink-2"), font: font(1), grid, ticks: { show: false }, gap: 4 };
  const texts = (log) => (_plot, ticks, _axis, _space, step) => (log ? logTicks(ticks) : linearTicks(ticks, step));
  return [
    { ...axis, space: 64, size: 20, values: texts(spec.log[0]), ...(spec.kind === "iterations" && { incrs: WHOLE }) },
    { ...axis, space: 28, size: axisWidth, values: texts(spec.log[1]) },
  ];
}

/** What of the visible part is to be seen: every line; bands where they are not wildly wider than usual; levels that
 * do not squeeze the rest to less than half. */
function yRange(plot, entries, levels, log) {
  const [from, to] = plot.series[0].idxs ?? [0, plot.data[0].length - 1];
  let low = Infinity;
  let high = -Infinity;
  const see = (y) => {
    if (y === null || y === undefined) return;
    if (y < low) low = y;
    if (y > high) high = y;
  };
  const shown = entries.filter((entry) => plot.series[entry.main].show);
  for (const entry of shown) for (let k = from; k <= to; k++) see(plot.data[entry.main][k]);
  for (const entry of shown) {
    if (!entry.low) continue;
    const [ys, lows, highs] = [entry.main, entry.low, entry.high].map((c) => plot.data[c]);
    const widths = [];
    for (let k = from; k <= to; k++) if (highs[k] !== null && lows[k] !== null) widths.push(highs[k] - lows[k]);
    const usual = 3 * (widths.sort((a, b) => a - b)[widths.length >> 1] ?? 0);
    for (let k = from; k <= to; k++) {
      if (highs[k] === null || lows[k] === null || highs[k] - lows[k] > usual) continue;
      see(lows[k]);
      see(highs[k]);
    }
  }
  if (low > high) return log ? [0.1, 10] : [-1, 1];
  const size = log ? (a, b) => Math.log(b / a) : (a, b) => b - a;
  const span = size(low, high);
  for (const [at] of levels) if ((at > 0 || !log) && size(Math.min(low, at), Math.max(high, at)) <= 2 * span) see(at);
  const flat = low === high ? Math.abs(low) || 10 : 1e-6 * Math.max(Math.abs(low), Math.abs(high));
  const margin = Math.max(0.06 * size(low, high), 0.1 * flat);
  if (!log) return [low - margin, high + margin];
  const factor = Math.exp(Math.max(0.06 * size(low, high), 0.1));
  return [low / factor, high * factor];
}

class Figure {
  constructor(element, spec) {
    this.element = element;
    this.spec = spec;
    this.box = element.querySelector(".canvas");
    this.legend = [...element.querySelectorAll(".legend button")];
    this.xOutput = element.querySelector(".x-label output");
    const { columns, entries } = spec.kind === "scatter" ? cloudColumns(spec) : lineColumns(spec);
    this.entries = entries;
    this.ends = this.#padded(spec.ends);
    this.onRange = () => {};
    this.plot = new uPlot(this.#options(columns), columns, this.box);
    this.legend.forEach((button, k) => button.addEventListener("click", () => this.#toggle(button, entries[k])));
    this.show(...this.ends);
  }

  get height() {
    const wide = this.box.clientWidth > 600;
    return this.spec.kind === "scatter" ? (wide ? 380 : 280) : wide ? 270 : 220;
  }

  get range() {
    const { min, max } = this.plot.scales.x;
    return [min, max];
  }

  #padded([low, high]) {
    if (this.spec.log[0]) return low < high ? [low, high] : [low / 2, high * 2];
    const part = this.spec.kind === "lines" ? 0 : 0.03;
    const room = low < high ? part * (high - low) : 0.5;
    return [low - room, high + room];
  }

  #options(columns) {
    const { spec } = this;
    const [xLog, yLog] = spec.log;
    const scale = (log, range) => ({ time: false, distr: log ? 3 : 1, range });
    const quiet = (type) => type === "mousemove" || type === "mouseleave" || type === "mouseenter";
    return {
      width: this.box.clientWidth || 600,
      height: this.height,
      padding: [8, 12, 0, 0],
      legend: { show: false },
      scales: {
        x: scale(xLog, (_plot, min, max) => [min, max]),
        y: scale(yLog, (plot) => yRange(plot, this.entries, spec.levels, yLog)),
      },
      axes: axes(spec),
      series: allSeries(spec, columns, this.entries),
      bands: this.entries.flatMap((entry, k) =>
        entry.low ? [{ series: [entry.high, entry.low], fill: () => colour(shade(k)) + "38" }] : [],
      ),
      cursor: {
        drag: { x: true, y: spec.kind === "scatter", uni: 20, dist: 5 },
        points: { show: spec.kind !== "scatter", size: 7 },
        bind: { dblclick: () => () => (this.whole(), null) },
        ...(spec.group && { sync: { key: `group:${spec.group}`, filters: { pub: quiet, sub: quiet } } }),
      },
      hooks: {
        drawClear: [(plot) => drawSpans(plot, spec.spans)],
        draw: [(plot) => drawSpanLabels(plot, spec.spans), (plot) => drawLevels(plot, spec.levels), (plot) => drawMarks(plot, spec.marks)],
        setCursor: [(plot) => this.#pointed(plot)],
        setScale: [(_plot, key) => this.#moved(key)],
      },
    };
  }

  #toggle(button, entry) {
    const show = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", show);
    this.plot.batch(() => {
      for (const k of [entry.main, entry.low, entry.high]) if (k) this.plot.setSeries(k, { show });
    });
  }

  /** The values under the pointer, in the legend. */
  #pointed(plot) {
    const k = plot.cursor.left < 0 ? null : (plot.cursor.idx ?? null);
    const scatter = this.spec.kind === "scatter";
    const step = k === null ? 1 : Math.abs(plot.posToVal(plot.cursor.left + 1, "x") - plot.posToVal(plot.cursor.left, "x"));
    const x = k === null ? null : plot.data[0][k];
    this.xOutput.textContent = k === null ? "" : `at ${numberNear(x, step || 1)}`;
    this.legend.forEach((button, i) => {
      const y = k === null ? null : plot.data[this.entries[i].main][k];
      button.querySelector("output").textContent = k === null || (scatter && y === null) ? "" : number(y, 4);
    });
  }

  /** The visible ranges stand in the document, too: data-x and data-y of the figure. */
  #moved(key) {
    const { min, max } = this.plot.scales[key];
    this.element.dataset[key] = `${min} ${max}`;
    if (key === "x") this.onRange(min, max);
  }

  /** x from min to max, and y (a scatter's) if given; never finer than the numbers are. */
  show(min, max, y = null) {
    const full = this.ends[1] - this.ends[0];
    if (!(max - min > 1e-7 * full)) return;
    const [from, to] = this.range;
    if (from === min && to === max && y === null) return;
    this.plot.batch(() => {
      this.plot.setScale("x", { min, max });
      if (y !== null) this.plot.setScale("y", { min: y[0], max: y[1] });
    });
  }

  whole() {
    const [min, max] = this.ends;
    this.plot.setScale("x", { min, max }); // even if x shows all of it already: a scatter's y follows the data again
  }

  resize(width = this.box.clientWidth) {
    if (width > 0) this.plot.setSize({ width, height: this.height });
  }
}
