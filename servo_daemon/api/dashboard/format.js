// Numbers as engineers write them: SI prefixes, and as many digits as the standard deviation supports.

const PREFIXES = [[1e-9, "n"], [1e-6, "µ"], [1e-3, "m"], [1, ""], [1e3, "k"], [1e6, "M"]];
const SUPERSCRIPT = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
const MINUS = "−";
export const NOTHING = "–";

const superscript = (n) => [...String(n)].map((c) => SUPERSCRIPT[c]).join("");

/** Whether a prefix may stand before the unit: not before "kg", "°C", "%" or no unit at all. */
const takesPrefix = (unit) => Boolean(unit) && !/^(kg|°C|%|1)/.test(unit);

/**
 * How to show numbers of about this size: divide by `factor`, write `unit` behind.
 * `previous` is kept while it still fits, so that a live number does not flip between two prefixes.
 */
export function scaleFor(unit, magnitude, previous = null) {
  const size = Math.abs(magnitude);
  if (!Number.isFinite(size) || size === 0) return previous ?? { factor: 1, unit };
  if (previous && size >= 0.5 * previous.factor && size < 2000 * previous.factor) return previous;
  if (!takesPrefix(unit)) return powerScale(unit, size);
  const largest = unit.startsWith("rad") ? 1 : 1e6; // nobody says krad/s
  let best = PREFIXES[0];
  for (const prefix of PREFIXES) if (prefix[0] <= size * 1.000001 && prefix[0] <= largest) best = prefix;
  return { factor: best[0], unit: best[1] + unit };
}

/** 9.75 ×10⁻³ kg·m²: powers of a thousand for units without prefixes; none between 0.1 and 10 000. */
function powerScale(unit, size) {
  if (unit === "°C" || unit === "%" || (size >= 0.1 && size < 1e4)) return { factor: 1, unit };
  const exponent = 3 * Math.floor(Math.log10(size) / 3 + 1e-9);
  return { factor: 10 ** exponent, unit: `×10${superscript(exponent)} ${unit}`.trim() };
}

/** Decimals so that `size` has `digits` significant ones. */
export function decimalsFor(size, digits) {
  if (!(size > 0) || !Number.isFinite(size)) return digits - 1;
  return Math.min(9, Math.max(0, digits - 1 - Math.floor(Math.log10(size) + 1e-9)));
}

/** Decimals that show the distance of two ticks as it is: 2.5 takes one more than 2. */
export function stepDecimals(step) {
  const decimals = decimalsFor(step, 1);
  const rest = Math.abs(step * 10 ** decimals - Math.round(step * 10 ** decimals));
  return rest > 1e-6 ? decimals + 1 : decimals;
}

/** A text of the daemon with true minus signs before its numbers, and their units on the same line. */
export const typeset = (text) => text.replace(/(?<![\w.)])-(?=\d)/g, MINUS).replace(/(\d) (?=(s|min|h|%)(\W|$))/g, "$1\u00a0");

/** A number with so many decimals, a true minus sign, and no "−0". */
export function fixed(value, decimals) {
  if (value === null || value === undefined || !Number.isFinite(value)) return NOTHING;
  const text = Math.abs(value).toFixed(decimals);
  return value < 0 && Number(text) !== 0 ? MINUS + text : text;
}

/** Value and std on one scale: std with two significant digits, value with the same decimals. */
export function pair(value, std, scale) {
  const decimals = std > 0 ? decimalsFor(std / scale.factor, 2) : decimalsFor(Math.abs(value) / scale.factor, 4);
  return {
    value: value === null ? NOTHING : fixed(value / scale.factor, decimals),
    std: std > 0 ? `± ${fixed(std / scale.factor, decimals)}` : "",
  };
}

/** A number by itself, four significant digits. */
export const plain = (value) => fixed(value, decimalsFor(Math.abs(value), 4));

/** +12.3 % */
export function percent(ratio) {
  const size = Math.abs(ratio * 100);
  const text = size.toFixed(size < 9.995 ? 2 : size < 99.95 ? 1 : 0);
  return `${Number(text) === 0 ? "±" : ratio < 0 ? MINUS : "+"}${text} %`;
}

/** 1 234 567 with thin spaces. */
export const count = (n) => String(Math.trunc(n)).replace(/\B(?=(\d{3})+$)/g, "\u202f");
