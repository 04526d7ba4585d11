// Numbers on axes and in legends.

const MINUS = "−";
const SUPERSCRIPT = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
const powerOfTen = (n) => `10${[...String(n)].map((c) => SUPERSCRIPT[c]).join("")}`;
const exponentOf = (size) => (size > 0 ? Math.floor(Math.log10(size) + 1e-9) : 0);

function fixed(value, decimals) {
  const text = Math.abs(value).toFixed(Math.min(Math.max(decimals, 0), 20));
  return value < 0 && Number(text) !== 0 ? MINUS + text : text;
}

/** So many significant digits; powers of ten outside 0.001 … 100 000. */
function number(value, digits = 5) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const exponent = exponentOf(Math.abs(value));
  if (value === 0 || (exponent >= -3 && exponent < 6)) return fixed(value, digits - 1 - exponent);
  return `${fixed(value / 10 ** exponent, digits - 1)}×${powerOfTen(exponent)}`;
}

/** A value between neighbours `step` apart: enough digits to tell them from each other, a tenth of the step. */
const numberNear = (value, step) =>
  number(value, Math.min(12, Math.max(3, exponentOf(Math.abs(value)) - exponentOf(step) + 2)));

/** Decimals that write a step of 1, 2, 2.5 or 5 times a power of ten exactly. */
function decimalsOf(step) {
  const decimals = Math.max(0, -exponentOf(step));
  const scaled = step * 10 ** decimals;
  return decimals + (Math.abs(scaled - Math.round(scaled)) > 1e-6 * scaled ? 1 : 0);
}

/** Ticks of a linear axis, all with the decimals that their distance needs and one power of ten. */
function linearTicks(ticks, step) {
  const size = Math.max(...ticks.map(Math.abs));
  const exponent = exponentOf(size);
  const common = size > 0 && (exponent < -3 || exponent > 5) ? exponent : 0;
  const decimals = decimalsOf(step / 10 ** common);
  return ticks.map((tick) => {
    const text = fixed(tick / 10 ** common, decimals);
    return common === 0 || tick === 0 ? text : `${text}×${powerOfTen(common)}`;
  });
}

/** Ticks of a logarithmic axis, all as powers of ten or all written out; those that uPlot leaves out are null. */
function logTicks(ticks) {
  const plain = ticks.every((tick) => tick === null || (tick > 0.9e-3 && tick < 1.1e4));
  return ticks.map((tick) => {
    if (tick === null) return "";
    const exponent = exponentOf(tick);
    const mantissa = Math.round(tick / 10 ** exponent);
    if (plain) return fixed(tick, -exponent);
    return mantissa === 1 ? powerOfTen(exponent) : `${mantissa}×${powerOfTen(exponent)}`;
  });
}
