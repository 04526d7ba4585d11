// The arrays of the data block (encode.py): base64 of little-endian floats around an offset, gaps apart.

function decode({ data, offset, wide = false, gaps = [] }) {
  const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
  const values = Array.from(wide ? new Float64Array(bytes.buffer) : new Float32Array(bytes.buffer), (v) => v + offset);
  for (let k = 0; k < gaps.length; k += 2) values.fill(null, gaps[k], gaps[k + 1]);
  return values;
}

/** Lines over one x: columns for uPlot, and for each series where its columns are. */
function lineColumns(spec) {
  const columns = [decode(spec.x)];
  const entries = spec.series.map((series) => {
    const entry = { ...series, main: columns.push(decode(series.y)) - 1 };
    if (series.low) {
      entry.low = columns.push(decode(series.low)) - 1;
      entry.high = columns.push(decode(series.high)) - 1;
    }
    return entry;
  });
  return { columns, entries };
}

/** Clouds and curves with an x each: one row for every point, in the order of x, the other series empty there. */
function cloudColumns(spec) {
  const rows = [];
  spec.series.forEach((series, k) => {
    const xs = decode(series.x);
    const ys = decode(series.y);
    xs.forEach((x, i) => x === null || rows.push([x, k + 1, ys[i]]));
  });
  rows.sort((a, b) => a[0] - b[0]);
  const columns = [rows.map((row) => row[0]), ...spec.series.map(() => new Array(rows.length).fill(null))];
  rows.forEach(([, k, y], i) => (columns[k][i] = y));
  return { columns, entries: spec.series.map((series, k) => ({ ...series, main: k + 1 })) };
}
